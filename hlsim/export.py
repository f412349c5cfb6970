"""Simulators as ``torch.export`` programs and ONNX files, for one length and batch."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.extras import require
from hlsim.neuro import NeuroMSBG


class _Call(nn.Module):
    """A simulator as a function of two tensors, without what looks at their values."""

    def __init__(self, simulator: NeuroMSBG) -> None:
        super().__init__()
        self.simulator = simulator

    def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
        return self.simulator._simulate(waveform, thresholds)
