"""Gains that follow from ear and level alone: NAL-R for average speech with compression about it, and normal loudness."""

from __future__ import annotations

import torch
from torch import Tensor

from compensators.filter_bank import centres, speech_levels
from compensators.nalr import nalr_gains_db
from hlsim.audiogram.thresholds import interpolate
from hlsim.torchtools import constant

_CATCH_UP, _NO_GAIN, _SOFTEST = 105.0, 100.0, 20.0  # dB SPL


def losses(thresholds: Tensor, count: int) -> Tensor:
    """Hearing loss at the bands' centres. Shape: (..., 8) dB HL -> (..., count)."""
    return interpolate(thresholds, centres(count))


def prescribed_gains(thresholds: Tensor, count: int) -> Tensor:
    """NAL-R's gain at the bands' centres. Shape: (..., 8) dB HL -> (..., count) dB."""
    return interpolate(nalr_gains_db(thresholds), centres(count))


def compression_ratios(loss: Tensor) -> Tensor:
    """Ratio of input to output level in dB: 1 up to 10 dB HL, 1 more for every 40 dB, 3 at most. Any shape."""
    return 1.0 + ((loss - 10.0) / 40.0).clamp(0.0, 2.0)


def above_speech(levels: Tensor) -> Tensor:
    """Level over that of average speech of 65 dB SPL in the same band. Shape: (..., bands) dB SPL -> the same."""
    speech = constant(speech_levels, levels.shape[-1], dtype=levels.dtype, device=levels.device)
    return levels - speech


def compressive_gains(levels: Tensor, prescribed: Tensor, ratios: Tensor, knee: float) -> Tensor:
    """Static curve: the prescribed gain at average speech of 65 dB SPL, less above it and more below it.

    Args:
        levels: above those of that speech, in dB.
        knee: level, of that scale, below which the gain stays.

    Shape: (items, frames, bands), (items, bands) twice -> (items, frames, bands).
    """
    slope = (1.0 / ratios - 1.0).unsqueeze(1)
    return torch.clamp(prescribed.unsqueeze(1) + slope * levels.clamp_min(knee), min=0.0)


def restoring_gains(levels: Tensor, loss: Tensor) -> Tensor:
    """Gain that undoes recruitment as MSBG has it: what lies ``loss`` under 105 dB SPL is heard 105 dB under it.

    Bands here are wider than MSBG's, and what they hold is louder than each part of it: of 95, 100, 105 and 110 dB SPL as
    the level that needs no gain, 100 came nearest to normal hearing of speech.

    Shape: (items, frames, bands) dB SPL, (items, bands) dB HL -> (items, frames, bands) dB, 0 or more.
    """
    share = (loss.clamp_min(0.0) / _CATCH_UP).unsqueeze(1)
    return share * (_NO_GAIN - levels.clamp_min(_SOFTEST)).clamp_min(0.0)
