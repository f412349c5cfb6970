"""Gains of published prescriptions for an ear: NAL-R, NAL-RP and CAMFIT.

- NAL-R: Byrne and Dillon 1986, Ear and Hearing 7(4), with the gain for severe losses of Byrne,
  Parkinson and Newall 1990, Ear and Hearing 11(1), as in pyclarity.
- NAL-RP: the same, and the correction for profound losses of Byrne, Parkinson and Newall 1990 and
  1991 (The Vanderbilt Hearing-Aid Report II, York Press), as in Dillon 2012, Hearing Aids.
- CAMFIT: Moore, Alcantara, Stone and Glasberg 1999, British Journal of Audiology 33(4), on the
  Cambridge formula of Moore and Glasberg 1998, British Journal of Audiology 32(5).
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.published import (
    CAMBRIDGE_INTERCEPTS,
    FREE_FIELD_THRESHOLD_SPL,
    PRESCRIPTION_TABLES,
)
from hlsim.audiogram.scale import FREQUENCIES, interpolate_over_log
from hlsim.torchtools import constant

Frequencies = tuple[float, ...]

NALRP_FREQUENCIES = (250.0, 500.0, 1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0)
"""Frequencies in Hz of the formula of NAL-RP."""

NALRP_END = 10000.0
"""Frequency in Hz at which the gain of NAL-RP is 0."""

PROFOUND_FROM = 90.0
"""Threshold in dB HL at 2 kHz above which NAL-RP corrects its gains for a profound loss."""

SPEECH_RANGE_DB = 38.0
"""Range in dB below the level of average speech at 65 dB SPL that CAMFIT makes audible.

At its lower end are the softest parts of speech at 45 dB SPL.
"""

LOWEST_CAMFIT_SLOPE = 13.0 / SPEECH_RANGE_DB - 1.0
"""Lowest slope of CAMFIT's gain over the level in dB per dB: a compression ratio of 38 / 13."""

CAMFIT_LIMIT_SPL = 100.0
"""Level in dB SPL beyond which CAMFIT amplifies no band."""


class CompressiveGains(NamedTuple):
    """Gain of each band of a compressive prescription, a straight line over the band's level.

    ``compressed_gains_db`` computes the gain for a level. Shape of both attributes: (..., bands).

    >>> CompressiveGains(torch.tensor([20.0]), torch.tensor([-0.5])).slope
    tensor([-0.5000])
    """

    at_speech_level: Tensor
    """Gain in dB at the level of the band in average speech at 65 dB SPL."""

    slope: Tensor
    """Change of the gain in dB per dB of the level, 0 or less: negative for compression."""


def nalr_gains_db(thresholds: Tensor) -> Tensor:
    """Compute the gains that NAL-R prescribes at the eight frequencies of an audiogram.

    The formula is for 250, 500, 1000, 2000, 4000 and 6000 Hz. As in pyclarity, the gain at 3 kHz is
    the mean of those at 2 and 4 kHz, and that at 8 kHz is the gain at 6 kHz, so that the thresholds
    at 3 and 8 kHz have no influence. An ear without any loss has no gain.

    Args:
        thresholds: Thresholds in dB HL at ``hlsim.audiogram.FREQUENCIES``.

    Shape: (..., 8) -> (..., 8) in dB, 0 or more.

    >>> nalr_gains_db(torch.tensor([20.0, 20.0, 25.0, 35.0, 40.0, 45.0, 50.0, 50.0])).round()
    tensor([ 0.,  2., 13., 14., 15., 16., 18., 18.])
    """
    losses = torch.cat((thresholds[..., :4], thresholds[..., 5:7]), -1)  # without 3 and 8 kHz
    gains = _nal_gains(losses, losses[..., 1:4], _table("nalr_bias", like=losses))
    low, high = gains[..., :4], gains[..., 4:]
    at_3_khz = 0.5 * (low[..., -1:] + high[..., :1])
    return torch.cat((low, at_3_khz, high, high[..., -1:]), -1)


def nalrp_gains_db(
    thresholds: Tensor, points: Frequencies = FREQUENCIES, frequencies: Frequencies = FREQUENCIES
) -> Tensor:
    """Compute the gains that NAL-RP prescribes, at any frequencies.

    NAL-RP has NAL-R's formula, with additional constants for 1500 and 3000 Hz, and a correction for
    profound losses: if the threshold at 2 kHz is above 90 dB HL, low frequencies get more gain and
    high ones less. The published table of this correction, in steps of 5 dB, is interpolated
    linearly.

    The formula is for 250 to 6000 Hz. Below 250 Hz the gain is constant; above 6000 Hz it falls to
    0 at 10 kHz. Thresholds and gains are interpolated over log frequency. An ear without any loss
    has no gain.

    Args:
        thresholds: Thresholds in dB HL.
        points: Frequencies of the gains in Hz.
        frequencies: Frequencies of the thresholds in Hz.

    Shape: (..., frequencies) -> (..., points) in dB, 0 or more.

    >>> nalrp_gains_db(torch.tensor([75.0, 80.0, 85.0, 100.0, 95.0, 100.0, 100.0, 100.0])).round()
    tensor([31., 40., 46., 46., 43., 45., 45., 20.])
    """
    losses = _interpolate_over_log(thresholds, frequencies, NALRP_FREQUENCIES)
    at_2_khz = losses[..., 4:5]
    table = _table("nalrp_corrections", like=losses)
    row = (at_2_khz - PROFOUND_FROM) / 5.0 - torch.arange(len(table)).to(losses)
    weights = (1.0 - row.abs()).clamp_min(0.0)
    correction = (weights.unsqueeze(-1) * table).sum(-2)
    bias = _table("nalrp_bias", like=losses)
    gains = _nal_gains(losses, losses[..., [1, 2, 4]], bias, correction)
    gains = torch.cat((gains, torch.zeros_like(at_2_khz)), -1)
    return _interpolate_over_log(gains, (*NALRP_FREQUENCIES, NALRP_END), points)


def camfit_gains(
    thresholds: Tensor,
    speech_levels: Tensor,
    points: Frequencies = FREQUENCIES,
    frequencies: Frequencies = FREQUENCIES,
) -> CompressiveGains:
    """Compute the gains that CAMFIT prescribes for bands, as lines over the level of each band.

    The line of a band goes through two points. A band of average speech at 65 dB SPL gets the gain
    of the Cambridge formula, 0.48 of the loss plus a constant, at least 0 dB. A band that is 38 dB
    softer is amplified to the threshold. If the compression ratio would be below 1 or above 2.92,
    the line goes through the second point only, with the nearer of these ratios.
    ``compressed_gains_db`` computes the gain for a level, and limits it.

    Args:
        thresholds: Thresholds in dB HL, which are interpolated over log frequency.
        speech_levels: Level in dB SPL of each band in average speech at 65 dB SPL.
        points: Centre frequencies of the bands in Hz.
        frequencies: Frequencies of the thresholds in Hz.

    Shape: (..., frequencies), (points,) -> (..., points) twice.

    >>> ear = torch.tensor([35.0, 35.0, 40.0, 50.0, 55.0, 60.0, 65.0, 65.0])
    >>> speech = torch.full((2,), 50.0)
    >>> camfit_gains(ear, speech, points=(1000.0, 4000.0)).at_speech_level
    tensor([19.2000, 28.8000])
    """
    losses = _interpolate_over_log(thresholds, frequencies, points)
    softest = speech_levels - SPEECH_RANGE_DB
    gain_for_softest = losses + _free_field_threshold(points, like=losses) - softest
    middle_gain = (0.48 * losses + _cambridge_intercepts(points, like=losses)).clamp_min(0.0)
    slope = ((middle_gain - gain_for_softest) / SPEECH_RANGE_DB).clamp(LOWEST_CAMFIT_SLOPE, 0.0)
    return CompressiveGains(gain_for_softest + slope * SPEECH_RANGE_DB, slope)


def compressed_gains_db(
    gains: CompressiveGains,
    levels: Tensor,
    speech_levels: Tensor,
    range_db: float = SPEECH_RANGE_DB,
    limit_spl: float = CAMFIT_LIMIT_SPL,
) -> Tensor:
    """Compute the gain of each band at its level, from the lines of a compressive prescription.

    Args:
        gains: Gain of each band as a line over its level.
        levels: Level of each band in dB SPL.
        speech_levels: Level in dB SPL of each band in average speech at 65 dB SPL.
        range_db: Distance in dB below ``speech_levels`` from which on softer sounds get no more
            gain.
        limit_spl: Highest level in dB SPL to which a band is amplified; a band above it gets no
            gain.

    Returns:
        Gains in dB, 0 or more, in the common shape of the arguments.

    >>> line = CompressiveGains(torch.tensor([20.0]), torch.tensor([-0.5]))
    >>> compressed_gains_db(line, torch.tensor([[40.0], [60.0], [95.0]]), torch.tensor([50.0])).T
    tensor([[25., 15.,  0.]])
    """
    above_speech = levels - speech_levels
    amplified = gains.at_speech_level + gains.slope * above_speech.clamp_min(-range_db)
    highest_gains = (limit_spl - levels).clamp_min(0.0)
    return torch.minimum(amplified.clamp_min(0.0), highest_gains)


def highest_band_levels(uncomfortable_levels: Tensor, points: Frequencies) -> Tensor:
    """Convert uncomfortable levels of an ear in dB HL to levels of bands in dB SPL.

    The results are levels in a free field, as those of all signals of hlsim: the level in dB HL,
    interpolated over log frequency, plus the free-field level of 0 dB HL (ISO 389-7).

    Args:
        uncomfortable_levels: Levels in dB HL at ``FREQUENCIES``.
        points: Centre frequencies of the bands in Hz.

    Shape: (..., 8) -> (..., points).

    >>> highest_band_levels(torch.full((8,), 100.0), (500.0, 4000.0))
    tensor([104.4000,  94.6000])
    """
    levels = _interpolate_over_log(uncomfortable_levels, FREQUENCIES, points)
    return levels + _free_field_threshold(points, like=levels)


def _nal_gains(
    losses: Tensor, three_losses: Tensor, bias: Tensor, correction: Tensor | float = 0.0
) -> Tensor:
    """Compute gains by the formula that NAL-R and NAL-RP have in common.

    Args:
        losses: Thresholds in dB HL. Shape: (..., frequencies).
        three_losses: Those at 500, 1000 and 2000 Hz. Shape: (..., 3).
        bias: Constant of the formula at each frequency in dB. Shape: (frequencies,).
        correction: Gains in dB that are added for a profound loss. Shape: (..., frequencies).

    Returns:
        Gains in dB, 0 or more, and 0 for an ear without any loss. Shape: (..., frequencies).
    """
    total = three_losses.sum(-1, keepdim=True)
    common = torch.where(total <= 180.0, 0.05 * total, 9.0 + 0.116 * (total - 180.0))
    gains = (common + 0.31 * losses + bias + correction).clamp_min(0.0)
    has_no_loss = (losses <= 0.0).all(-1, keepdim=True)
    return torch.where(has_no_loss, 0.0, gains)


def _interpolate_over_log(values: Tensor, grid: Frequencies, points: Frequencies) -> Tensor:
    """Interpolate values linearly over log frequency, constant below the grid and above it.

    Shape: (..., grid) -> (..., points).

    Args:
        values: Values such as thresholds or gains.
        grid: Frequencies of the values in Hz, ascending.
        points: Frequencies of the result in Hz.
    """
    return (values.unsqueeze(-1) * _log_weights(grid, points, like=values)).sum(-2)


@constant
def _log_weights(grid: Frequencies, points: Frequencies) -> NDArray[np.float64]:
    """Return the matrix that interpolates over log frequency, (grid, points)."""
    return np.stack([interpolate_over_log(points, grid, row) for row in np.eye(len(grid))])


@constant
def _table(name: str) -> list[Any]:
    """Return one of the ``PRESCRIPTION_TABLES`` by name, with ``like`` as a tensor."""
    table: list[Any] = PRESCRIPTION_TABLES[name]
    return table


@constant
def _free_field_threshold(points: Frequencies) -> NDArray[np.float64]:
    """Return the free-field level in dB SPL of 0 dB HL at frequencies in Hz.

    It is interpolated linearly in Hz, and constant outside 125 Hz to 12.5 kHz. Shape: (points,).
    """
    grid, levels = zip(*FREE_FIELD_THRESHOLD_SPL.items(), strict=True)
    return np.interp(points, grid, levels)


@constant
def _cambridge_intercepts(points: Frequencies) -> NDArray[np.float64]:
    """Return the constants in dB of the Cambridge formula at some frequencies in Hz.

    They are interpolated over log frequency. Shape: (points,).
    """
    grid, intercepts = zip(*CAMBRIDGE_INTERCEPTS.items(), strict=True)
    return interpolate_over_log(points, grid, intercepts)
