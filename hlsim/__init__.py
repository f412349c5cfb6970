"""Hear through an impaired ear, and backpropagate through it."""

from hlsim.audiogram import Audiogram
from hlsim.loss import HearingLossLoss
from hlsim.msbg import MSBG, estimate_delay
from hlsim.neuro import NeuroMSBG
from hlsim.pretrained import load_pretrained

__version__ = "0.1.0"

__all__ = ["MSBG", "Audiogram", "HearingLossLoss", "NeuroMSBG", "estimate_delay", "load_pretrained"]
