"""Neuro-MSBG: neural networks that emulate the hearing-loss model MSBG, and their parts."""

from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.model import NeuroMSBG, load_pretrained

__all__ = ["NeuroConfig", "NeuroMSBG", "load_pretrained"]
