"""Preparation of signals for Kates' ear, before its filters.

Signals are resampled to 24 kHz, and silence before and after the clean signal is found.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import lowpass_fir
from hlsim.dsp.iir import chebyshev2, digital_filter, frequency_response
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

ZERO_CROSSINGS, KAISER_BETA = 10, 5.0
"""Zero crossings on each side of the resampling filter, and parameter of its Kaiser window.

Both are those of scipy's ``resample_poly``.
"""

OUTPUTS_PER_ROW = 64
"""Approximate number of output samples that are computed from one row of input samples."""

RING_SAMPLES = 4096
"""Number of samples after which the impulse response of the Chebyshev filters has vanished."""

AUDIBLE_RATIO = 0.001
"""Magnitude, relative to the maximum, below which the clean signal is silent at its ends."""


def at_ear_rate(extent: Extent, sample_rate: int) -> Extent:
    """Convert the lengths of items from a sample rate to 24 kHz, and round them up.

    Args:
        extent: Number of samples of each item at ``sample_rate``.
        sample_rate: Sample rate in Hz.

    >>> at_ear_rate(Extent((16000,)), 16000).ends
    (24000,)
    """
    return Extent(tuple(-(-end * RATE // sample_rate) for end in extent.ends))


def to_ear_rate(signals: Tensor, sample_rate: int, extent: Extent) -> Tensor:
    """Resample signals to 24 kHz, the rate of the ear, without a change of their RMS level.

    Signals at rates above 24 kHz keep the RMS level of their band below 10.5 kHz instead. The
    filter is a Kaiser-windowed sinc as in scipy's ``resample_poly``. Signals at 24 kHz are returned
    as they are.

    Args:
        signals: Signals, zero after the end of each item. Shape: (items, time).
        sample_rate: Sample rate of the signals in Hz.
        extent: Number of samples of each item at that rate.

    Returns:
        Resampled signals, zero after the end of each item. Shape: (items, longest at 24 kHz).

    >>> to_ear_rate(torch.randn(1, 16000), 16000, Extent((16000,))).shape
    torch.Size([1, 24000])
    """
    if sample_rate == RATE:
        return signals
    resampled_extent = at_ear_rate(extent, sample_rate)
    common = math.gcd(RATE, sample_rate)
    up, down = RATE // common, sample_rate // common
    periods = max(1, OUTPUTS_PER_ROW // up)
    kernel = _kernel(up, down, periods, like=signals)
    inputs, outputs = kernel.shape
    rows = -(-resampled_extent.longest // outputs)
    lead = _reach(up, down)
    behind = (rows - 1) * down * periods + inputs - lead - signals.shape[-1]
    padded = functional.pad(signals, (lead, max(0, behind)))
    windows = padded.unfold(-1, inputs, down * periods)[:, :rows]
    resampled = resampled_extent.cut((windows @ kernel).flatten(1))
    if sample_rate < RATE:
        before, after = extent.mean(signals.square()), resampled_extent.mean(resampled.square())
    else:
        before = _power_below(signals, sample_rate, extent)
        after = _power_below(resampled, RATE, resampled_extent)
    is_audible = after > 0.0  # silence has no level
    ratio = torch.where(is_audible, before / torch.where(is_audible, after, 1.0), 1.0)
    return resampled * ratio.sqrt().unsqueeze(-1)


def _reach(up: int, down: int) -> int:
    """Return the number of input samples before an output sample that contribute to it.

    Args:
        up: Numerator of the ratio of the rates, output to input.
        down: Denominator of this ratio.
    """
    return -(-ZERO_CROSSINGS * max(up, down) // up)


@constant
def _kernel(up: int, down: int, periods: int) -> NDArray[np.float64]:
    """Return the resampling filter as a matrix from a row of inputs to a row of outputs.

    Args:
        up: Numerator of the ratio of the rates, output to input.
        down: Denominator of this ratio.
        periods: Number of groups of ``up`` outputs per row; a group uses ``down`` inputs more.

    Returns:
        Matrix, (inputs, periods * up).
    """
    half = ZERO_CROSSINGS * max(up, down)
    taps = up * lowpass_fir(2 * half + 1, 1.0 / max(up, down), KAISER_BETA)
    output = np.arange(periods * up)
    inputs = 2 * _reach(up, down) + down * periods
    # On the grid that both rates share, input j lies at (j - reach) * up and output k at k * down.
    index = half + output[None, :] * down - (np.arange(inputs)[:, None] - _reach(up, down)) * up
    inside = (index >= 0) & (index <= 2 * half)
    return np.where(inside, taps[np.clip(index, 0, 2 * half)], 0.0)


def _power_below(signals: Tensor, rate: int, extent: Extent) -> Tensor:
    """Compute the mean power below 10.5 kHz, by Kates' Chebyshev filter of seventh order.

    Shape: (items, time) -> (items,).
    """
    points = fft_length(extent.longest + RING_SAMPLES, 2)
    response = _chebyshev(rate, points, like=signals)
    spectrum = torch.fft.rfft(signals, points) * response
    return extent.mean(torch.fft.irfft(spectrum, points).square())


@constant
def _chebyshev(rate: int, points: int) -> NDArray[np.complex128]:
    """Return the response of the low-pass at 10.5 kHz, (points // 2 + 1,), at a rate in Hz."""
    lowpass = digital_filter(chebyshev2(7, 30.0), 10500.0, rate)
    return frequency_response(lowpass, 2.0 * np.pi * np.arange(points // 2 + 1) / points)


def audible_ends(references: Tensor) -> tuple[Tensor, Tensor]:
    """Find the first and the last sample of each clean signal that is not silent.

    A sample is not silent if its magnitude is above a thousandth of the signal's maximum. If all
    samples are zero, the results are the ends of the signal.

    Args:
        references: Clean signals. Shape: (items, time).

    Returns:
        Index of the first and of the last sample, int64. Shape: (items,) each.

    >>> audible_ends(torch.tensor([[0.0, 0.5, 0.0, 0.2, 0.0]]))
    (tensor([1]), tensor([3]))
    """
    magnitude = references.detach().abs()
    is_loud = (magnitude > AUDIBLE_RATIO * magnitude.amax(-1, keepdim=True)).byte()
    return is_loud.argmax(-1), is_loud.shape[-1] - 1 - is_loud.flip(-1).argmax(-1)
