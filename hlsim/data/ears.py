"""Random ears that vary like measured ones."""

import math

import torch
from torch import Tensor

from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, STANDARD

MILDER = ("NH", "N1", "N2", "S1")
"""Standard ears that evaluations add, because most measured ears are moderate or severe."""

_SERIES = (("NH", "N1", "N2", "N3", "N4", "N5", "N6"), ("NH", "S1", "S2", "S3"))
"""Series of standard ears by increasing loss: flat or gently sloping, and steeply sloping."""

_TILT = (1.0, 0.9, 0.6, 0.2, 0.0, 0.0, 0.0, 0.0)
"""Random shift of the threshold at each of ``FREQUENCIES``, relative to that at 250 Hz."""

_CORRELATION = 0.8
"""Correlation of the random deviations at neighbouring frequencies, as among measured ears."""


def draw_thresholds(count: int, generator: torch.Generator | None = None) -> Tensor:
    """Draw random ears that resemble measured ones, from no loss to severe.

    Each ear starts between two neighbours in one of Bisgaard's series (NH, N1 ... N6 or NH, S1 ...
    S3). Its thresholds from 250 to 2000 Hz are shifted together, by up to 20 dB up or down at 250
    Hz and less at higher frequencies. Gaussian deviations are added, with a standard deviation of
    2.4 to 8 dB and a correlation between neighbouring frequencies. Three in four ears are rounded
    to 5 dB, as in audiometry. By MSBG's definition, about 27 % have no loss, 19 % a mild one, 19 %
    a moderate one and 36 % a severe one.

    Args:
        count: Number of ears.
        generator: Source of the random numbers; by default the global one of torch.

    Returns:
        Hearing thresholds from -10 to 100 dB HL at ``FREQUENCIES``, with shape (count, 8).

    >>> draw_thresholds(3).shape
    torch.Size([3, 8])
    """
    uniform = torch.rand(count, 5, generator=generator)
    ears = torch.empty(count, 8)
    is_gentle = uniform[:, 0] < 0.65
    for names, is_chosen in zip(_SERIES, (is_gentle, ~is_gentle), strict=True):
        table = torch.tensor([STANDARD[name] for name in names], dtype=torch.float32)
        # The exponent makes mild losses more frequent than severe ones.
        position = uniform[:, 1] ** 1.8 * (len(names) - 1)
        lower = position.long().clamp(max=len(names) - 2)
        weight = (position - lower).unsqueeze(-1)
        interpolated = table[lower] + (table[lower + 1] - table[lower]) * weight
        ears = torch.where(is_chosen.unsqueeze(-1), interpolated, ears)
    ears = ears + (40.0 * uniform[:, 4:] - 20.0) * torch.tensor(_TILT)
    deviations = torch.randn(count, 8, generator=generator)
    for i in range(1, 8):
        innovation = math.sqrt(1 - _CORRELATION**2) * deviations[:, i]
        deviations[:, i] = _CORRELATION * deviations[:, i - 1] + innovation
    ears = ears + 8.0 * deviations * (0.3 + 0.7 * uniform[:, 3:4])
    ears = torch.where(uniform[:, 2:3] < 0.75, 5.0 * (ears / 5.0).round(), ears)
    return ears.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)
