"""Prescriptions of gains: NAL-R with compression, and gains that restore loudness."""

from __future__ import annotations

import torch
from torch import Tensor

from compensators.filter_bank import centres, speech_levels
from compensators.nalr import nalr_gains_db
from hlsim.audiogram.thresholds import interpolate
from hlsim.torchtools import constant

CATCH_UP_SPL = 105.0
"""Level in dB SPL at which MSBG's recruitment ends."""

NO_GAIN_SPL = 100.0
"""Level of a band in dB SPL from which on the restoring gain is 0."""

SOFTEST_SPL = 20.0
"""Level of a band in dB SPL below which the restoring gain does not rise."""


def losses(thresholds: Tensor, count: int) -> Tensor:
    """Return the hearing loss at the centres of bands. Shape: (..., 8) dB HL -> (..., count).

    >>> losses(torch.full((8,), 40.0), 4)
    tensor([40., 40., 40., 40.])
    """
    return interpolate(thresholds, centres(count))


def prescribed_gains(thresholds: Tensor, count: int) -> Tensor:
    """Return NAL-R's gain at the centres of bands. Shape: (..., 8) dB HL -> (..., count) dB.

    >>> prescribed_gains(torch.full((8,), 40.0), 4).round()
    tensor([ 1., 11., 17., 16.])
    """
    return interpolate(nalr_gains_db(thresholds), centres(count))


def compression_ratios(loss: Tensor) -> Tensor:
    """Return the ratio of input to output level in dB for a hearing loss. Any shape.

    It is 1 up to 10 dB HL, rises by 1 per 40 dB, and is 3 at most.

    >>> compression_ratios(torch.tensor([0.0, 50.0, 120.0]))
    tensor([1., 2., 3.])
    """
    return 1.0 + ((loss - 10.0) / 40.0).clamp(0.0, 2.0)


def above_speech(levels: Tensor) -> Tensor:
    """Return levels relative to those of average speech at 65 dB SPL in the same bands.

    Shape: (..., bands) in dB SPL -> (..., bands) in dB.

    >>> above_speech(torch.tensor(speech_levels(4)) + 10.0)
    tensor([10., 10., 10., 10.])
    """
    speech = constant(speech_levels, levels.shape[-1], dtype=levels.dtype, device=levels.device)
    return levels - speech


def compressive_gains(levels: Tensor, prescribed: Tensor, ratios: Tensor, knee: float) -> Tensor:
    """Return the gain of a static curve, the prescribed one for average speech at 65 dB SPL.

    It is lower for higher levels and higher for lower levels.

    Args:
        levels: Levels of the bands relative to average speech in dB.
        prescribed: Prescribed gains in dB.
        ratios: Compression ratios.
        knee: Relative level in dB below which the gain is constant.

    Shape: (items, frames, bands), (items, bands) twice -> (items, frames, bands), 0 dB or more.

    >>> levels = torch.tensor([[[-10.0], [0.0], [10.0]]])
    >>> gains = compressive_gains(levels, torch.tensor([[20.0]]), torch.tensor([[2.0]]), -20.0)
    >>> gains.flatten()
    tensor([25., 20., 15.])
    """
    slope = (1.0 / ratios - 1.0).unsqueeze(1)
    return torch.clamp(prescribed.unsqueeze(1) + slope * levels.clamp_min(knee), min=0.0)


def restoring_gains(levels: Tensor, loss: Tensor) -> Tensor:
    """Return the gain that inverts MSBG's recruitment.

    In MSBG, a level ``loss`` dB below 105 dB SPL is perceived 105 dB below it. The bands here are
    wider than MSBG's, and louder than each part of them: of 95, 100, 105 and 110 dB SPL as the
    level that needs no gain, 100 came closest to normal hearing of speech.

    Shape: (items, frames, bands) dB SPL, (items, bands) dB HL -> (items, frames, bands), 0 dB or
        more.

    >>> levels = torch.tensor([[[40.0], [80.0], [110.0]]])
    >>> restoring_gains(levels, torch.tensor([[52.5]])).flatten()
    tensor([30., 10.,  0.])
    """
    share = (loss.clamp_min(0.0) / CATCH_UP_SPL).unsqueeze(1)
    return share * (NO_GAIN_SPL - levels.clamp_min(SOFTEST_SPL)).clamp_min(0.0)
