"""Neuro-MSBG: neural networks that emulate MSBG, and their parts."""

from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.model import NeuroMSBG

__all__ = ["NeuroConfig", "NeuroMSBG"]
