"""Gains that the prescription NAL-R gives to an ear, and filters with these gains.

Source: Byrne and Dillon 1986, Ear and Hearing 7(4), and for severe losses Byrne, Parkinson and
Newall 1990, Ear and Hearing 11(1).
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.scale import FREQUENCIES
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.interpolation import interpolate
from hlsim.torchtools import constant


def nalr_gains_db(thresholds: Tensor) -> Tensor:
    """Return the gains that NAL-R prescribes at the eight frequencies of an audiogram.

    The formula is for 250, 500, 1000, 2000, 4000 and 6000 Hz. As in pyclarity, the gain is a
    straight line from 2 to 4 kHz and constant above 6 kHz, so that the thresholds at 3 and 8 kHz do
    not count. An ear without any loss has no gain.

    Args:
        thresholds: Thresholds in dB HL at ``hlsim.audiogram.FREQUENCIES``.

    Shape: (..., 8) -> (..., 8) in dB, 0 or more.

    >>> nalr_gains_db(torch.tensor([20.0, 20.0, 25.0, 35.0, 40.0, 45.0, 50.0, 50.0])).round()
    tensor([ 0.,  2., 13., 14., 15., 16., 18., 18.])
    """
    losses = torch.cat((thresholds[..., :4], thresholds[..., 5:7]), -1)  # without 3 and 8 kHz
    three_frequency_sum = losses[..., 1:4].sum(-1, keepdim=True)  # 500, 1000 and 2000 Hz
    common = torch.where(
        three_frequency_sum <= 180.0,
        0.05 * three_frequency_sum,
        9.0 + 0.116 * (three_frequency_sum - 180.0),
    )
    bias = _bias(like=losses)
    gains = (common + 0.31 * losses + bias).clamp_min(0.0)
    low, high = gains[..., :4], gains[..., 4:]
    at_3_khz = 0.5 * (low[..., -1:] + high[..., :1])
    all_gains = torch.cat((low, at_3_khz, high, high[..., -1:]), -1)
    has_no_loss = (losses <= 0.0).all(-1, keepdim=True)
    return torch.where(has_no_loss, 0.0, all_gains)


def nalr_filter(thresholds: Tensor, sample_rate: int, order: int) -> Tensor:
    """Design the filter with the gains of NAL-R, linear in dB between the audiometric frequencies.

    The filter has linear phase, and is that of pyclarity.

    Shape: (..., 8) -> (..., order + 1), float64.

    Args:
        thresholds: Thresholds in dB HL at ``hlsim.audiogram.FREQUENCIES``.
        sample_rate: Sample rate in Hz.
        order: Order of the filter, an even number. The filter delays by half of it.

    >>> taps = nalr_filter(torch.full((8,), 40.0), sample_rate=16000, order=220)
    >>> int(taps.argmax())
    110
    """
    frequencies = np.linspace(0.0, sample_rate / 2.0, order + 1)
    gains = interpolate(
        nalr_gains_db(thresholds.double()), FREQUENCIES, tuple(frequencies.tolist())
    )
    return (10.0 ** (gains / 20.0)) @ _unit_filters(order, like=gains)


@constant
def _unit_filters(order: int) -> NDArray[np.float64]:
    """Return the filters with a gain of 1 at one of ``order + 1`` evenly spaced frequencies.

    A filter is linear in its gains, and so the sum of these filters times the gains.

    Returns: (order + 1, order + 1), one row per frequency.
    """
    points = order + 1
    grid = np.arange(points) / order
    rows = [frequency_sampling_fir(points, grid, gain) for gain in np.eye(points)]
    return np.stack(rows)


@constant
def _bias() -> list[float]:
    """Return the constant in dB of the formula at 250, 500, 1000, 2000, 4000 and 6000 Hz."""
    return [-17.0, -8.0, 1.0, -1.0, -2.0, -2.0]
