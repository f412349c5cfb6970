"""Two limiters that protect the ear: of the peaks of an output, and of its bands.

The limit of the peaks is the same for every ear. The limit of a band is below the uncomfortable
level of the ear, and aids have it only with ``limit_to_ear``.
"""

import torch
from torch import Tensor
from torch.nn.functional import pad

from compensators.filter_bank import filter_centres, filter_leakage, filter_powers, level_db
from compensators.smoothing import follow_peaks
from hlsim.audiogram.prescription import highest_band_levels
from hlsim.calibration import PASCAL_SPL

EXPONENT = 8.0
"""Exponent of the curve. The higher it is, the closer the curve is to clipping."""

LIMITED = 2.0 ** (-1.0 / EXPONENT)
"""Output for an input exactly at the limit, as a ratio to the limit."""

HIGHEST_RATIO = 1e4
"""Ratio of a sample to the limit from which all samples have the same output.

Its eighth power fits into float32.
"""

MARGIN_DB = 4.0
"""Distance in dB of the highest level of a band from the uncomfortable level of the ear.

A third of an octave, and a tone between two bands, may have the power of two bands.
"""

RELEASE = 0.1
"""Time constant in seconds with which a band's gain recovers after it was limited to the ear."""


def soft_limit(waveform: Tensor, limit_spl: float) -> Tensor:
    """Limit the magnitude of samples by a smooth curve: x / (1 + |x / limit|^8)^(1/8).

    Up to half of the limit, samples are attenuated by less than 0.005 dB.

    Args:
        waveform: Samples in pascals, float32 or float64. Any shape.
        limit_spl: Limit of the magnitude of each sample of the result, in dB relative to 20
            micropascals.

    >>> soft_limit(torch.tensor([0.1, 2.0, 100.0]), limit_spl=100.0)  # 2 pascals
    tensor([0.1000, 1.8318, 1.9953])
    """
    peak = 10.0 ** ((limit_spl - PASCAL_SPL) / 20.0)
    bounded = waveform.clamp(-HIGHEST_RATIO * peak, HIGHEST_RATIO * peak)
    return bounded * (1.0 + (bounded / peak).abs() ** EXPONENT) ** (-1.0 / EXPONENT)


def find_highest_levels(limits: Tensor, bands: int) -> Tensor:
    """Compute the level that each band of the output stays below.

    Args:
        limits: Levels of tones in dB HL at ``FREQUENCIES`` that bands stay below.
        bands: Number of bands of an aid, at ``filter_centres``.

    Returns:
        Highest level of each band in dB SPL: ``MARGIN_DB`` below the limit of a tone at the centre
        of the band or of a neighbour, whichever is lower.

    Shape: (items, 8) -> (items, bands).

    >>> find_highest_levels(torch.full((1, 8), 100.0), bands=4).shape
    torch.Size([1, 4])
    """
    levels = highest_band_levels(limits, filter_centres(bands)) - MARGIN_DB
    # A tone is in two bands, so each band has the lowest limit of itself and its neighbours.
    return pad(levels, (1, 1), value=float("inf")).unfold(-1, 3, 1).amin(-1)


def limit_gains(
    gains_db: Tensor, powers: Tensor, highest_levels: Tensor, memory: Tensor
) -> tuple[Tensor, Tensor]:
    """Limit the gain of each band so that the output stays below its highest level.

    A band's gain is limited for the sounds in the band, and for those in distant bands that its
    filter attenuates: a high gain would bring them above the highest level of their own band.

    Args:
        gains_db: Gains in dB.
        powers: Power spectrum in Pa^2 of each frame of the input.
        highest_levels: Highest level of each band in dB SPL, from ``find_highest_levels``.
        memory: Memory of the levels of earlier frames, as ``follow_peaks`` returns it.

    Returns:
        The limited gains in dB, and the memory after the last frame.

    Shape: (items, frames, bands), (items, frames, FRAME / 2 + 1), (items, bands), (items, 3, bands)
        -> (items, frames, bands), (items, 3, bands).

    >>> loud, none = torch.ones(1, 1, 129), torch.zeros(1, 3, 4)
    >>> limit_gains(torch.zeros(1, 1, 4), loud, torch.full((1, 4), 200.0), none)[0].tolist()
    [[[0.0, 0.0, 0.0, 0.0]]]
    """
    band_powers = filter_powers(powers, gains_db.shape[-1])
    neighbours = pad(band_powers, (1, 1)).unfold(-1, 3, 1).sum(-1)
    # The window of a frame spreads a tone over its band and the next ones.
    levels, memory = follow_peaks(level_db(0.5 * (band_powers + neighbours)), memory, 0.0, RELEASE)
    # Sounds are in the rows of the matrix, and filters are in its columns.
    power_ratios = 10.0 ** ((levels - highest_levels.unsqueeze(1)) / 10.0)
    passed_ratios = power_ratios @ filter_leakage(gains_db.shape[-1], like=levels)
    return torch.minimum(gains_db, -10.0 * passed_ratios.log10()), memory
