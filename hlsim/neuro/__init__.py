"""Neuro-MSBG and its parts."""

from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.model import NeuroMSBG

__all__ = ["NeuroConfig", "NeuroMSBG"]
