"""Random ears with the variety of measured ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL, STANDARD

MILDER = ("NH", "N1", "N2", "S1")
"""Standard ears that join measured ones in validation, since those are mostly moderate and severe."""


def draw_thresholds(count: int, generator: torch.Generator | None = None) -> Tensor:
    """Random ears that look like measured ones, from no loss to severe.

    Each lies between two neighbours of one of Bisgaard's series (NH, N1 ... N6 or NH, S1 ... S3), is tilted by up to
    20 dB at 250 Hz, and moved by Gaussian noise with a deviation of 2.4 to 8 dB that is alike at neighbouring frequencies
    (correlation 0.8, as among measured ears). Three of four are rounded to 5 dB, as audiologists do. In MSBG's sense
    27 % have no loss, 18 % a mild, 19 % a moderate and 36 % a severe one.

    Returns: (count, 8) dB HL, -10 to 100.
    """
    uniform = torch.rand(count, 5, generator=generator)
    ears = torch.empty(count, 8)
    for series, members in enumerate(
        (("NH", "N1", "N2", "N3", "N4", "N5", "N6"), ("NH", "S1", "S2", "S3"))
    ):
        table = torch.tensor([STANDARD[name] for name in members], dtype=torch.float32)
        # the power favours the mild end, where more ears are
        place = uniform[:, 1] ** 1.8 * (len(members) - 1)
        low = place.long().clamp(max=len(members) - 2)
        between = table[low] + (table[low + 1] - table[low]) * (place - low).unsqueeze(-1)
        ears = torch.where(((uniform[:, 0] < 0.65) == (series == 0)).unsqueeze(-1), between, ears)
    tilt = torch.tensor([1.0, 0.9, 0.6, 0.2, 0.0, 0.0, 0.0, 0.0])
    ears = ears + (40.0 * uniform[:, 4:] - 20.0) * tilt
    noise = torch.randn(count, 8, generator=generator)
    for i in range(1, 8):
        noise[:, i] = 0.8 * noise[:, i - 1] + math.sqrt(1 - 0.8**2) * noise[:, i]
    ears = ears + 8.0 * noise * (0.3 + 0.7 * uniform[:, 3:4])
    ears = torch.where(uniform[:, 2:3] < 0.75, 5.0 * (ears / 5.0).round(), ears)
    return ears.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)
