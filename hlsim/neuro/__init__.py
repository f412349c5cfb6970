"""Neuro-MSBG: neural networks that emulate MSBG, and their parts."""

from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.model import NeuroMSBG, load_pretrained

__all__ = ["NeuroConfig", "NeuroMSBG", "load_pretrained"]
