"""The filter bank of a wearable aid, and sound levels in its bands.

The filters have linear phase and sum to a delay.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb
from hlsim.dsp.fft import power
from hlsim.torchtools import constant_like

RATE = 16000
"""Sample rate of the aids in Hz."""

DELAY = 64
"""Delay of the filters in samples, 4 ms. Each filter has 2 * 64 + 1 taps."""

HOP = 64
"""Samples from one control frame to the next."""

FRAME = 256
"""Samples of a control frame."""

FALL = 64
"""Samples at the end of a control frame in which its window falls."""

HISTORY = FRAME - HOP
"""Samples before a hop that frames and filters need."""

MIN_SPACING = 125.0
"""Smallest distance of two centres in Hz, about what filters of this length can separate."""

POWER_FLOOR = 10.0 ** (-PASCAL_SPL / 10.0)
"""Power at 0 dB SPL, the lowest level of a band."""

GRID_POINTS = 4096
"""Length of the transform on which filters are designed and speech is divided into bands."""

SPEECH_SPL = 65.0
"""Level in dB SPL of average speech."""

# Long-term average of speech at 70 dB SPL in thirds of an octave, men's and women's:
# Byrne et al. 1994, Journal of the Acoustical Society of America 96(4)
SPEECH_SPECTRUM = {
    63: 38.6, 80: 43.5, 100: 54.4, 125: 57.7, 160: 56.8, 200: 60.2, 250: 60.3, 315: 59.0,
    400: 62.1, 500: 62.1, 630: 60.5, 800: 56.8, 1000: 53.7, 1250: 53.0, 1600: 52.0, 2000: 48.7,
    2500: 48.1, 3150: 46.8, 4000: 45.6, 5000: 44.5, 6300: 44.3, 8000: 43.7,
}  # fmt: skip


@lru_cache(maxsize=8)
def centres(count: int) -> tuple[float, ...]:
    """Return centre frequencies of bands from 0 to 8000 Hz.

    Neighbours are an equal number of ERBs, but at least 125 Hz, apart.

    >>> [round(hertz) for hertz in centres(4)]
    [0, 526, 2264, 8000]
    """
    low, high = 0.0, 100.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _spaced(count, middle)[-1] < RATE / 2.0:
            low = middle
        else:
            high = middle
    return tuple(min(frequency, RATE / 2.0) for frequency in _spaced(count, high))


def _spaced(count: int, erbs: float) -> list[float]:
    """Return frequencies from 0 Hz upwards with a spacing in ERBs, but at least 125 Hz."""
    frequencies = [0.0]
    for _ in range(count - 1):
        width = erbs * float(erb(np.array(frequencies[-1])))
        frequencies.append(frequencies[-1] + max(MIN_SPACING, width))
    return frequencies


def shares(count: int, points: int) -> NDArray[np.float64]:
    """Return the weight of each band at each frequency of a Fourier transform.

    Returns: (points / 2 + 1, count).

    The weights are linear between the centres of bands, and sum to 1.

    >>> shares(20, 512).shape
    (257, 20)
    """
    frequencies = np.arange(points // 2 + 1) * RATE / points
    return np.stack([np.interp(frequencies, centres(count), row) for row in np.eye(count)], 1)


def filters(count: int) -> NDArray[np.float64]:
    """Return the symmetric taps of the filters, (count, 129).

    Their sum is 1 at the middle tap, else 0.

    >>> filters(20).shape
    (20, 129)
    """
    impulses = np.fft.irfft(shares(count, GRID_POINTS).T, GRID_POINTS)
    taps = np.roll(impulses, DELAY, -1)[:, : 2 * DELAY + 1]
    return taps * np.hanning(2 * DELAY + 3)[1:-1]


def apply_gains(padded: Tensor, gains: Tensor, first: int = 0) -> Tensor:
    """Amplify each band and sum the bands, with a delay of ``DELAY`` samples.

    The gains change linearly from hop to hop.

    It uses no transform, so that later samples do not change earlier ones even by rounding. Gains
    of 1 change nothing either.

    Args:
        padded: Samples of whole hops, or of a part of one hop, after ``2 * DELAY`` earlier samples.
        gains: Gains minus 1 at the beginning of each hop and at the end of the last.
        first: Position of the first sample in its hop.

    Shape: (items, 2 * DELAY + time), (items, hops + 1, bands) -> (items, time).

    >>> twice_as_loud = torch.ones(1, 3, 20)
    >>> apply_gains(torch.ones(1, 2 * DELAY + 2 * HOP), twice_as_loud).round()[0, :3]
    tensor([2., 2., 2.])
    """
    time, count = padded.shape[-1] - 2 * DELAY, gains.shape[-1]
    length = min(time, HOP)
    taps = constant_like(padded, _hop_matrix, count).unflatten(1, (count, HOP))
    taps = taps[: length + 2 * DELAY, :, :length]
    ramp = constant_like(padded, _ramp)[:, first : first + length]
    hops = padded.unfold(-1, length + 2 * DELAY, length)
    bands = (hops @ taps.flatten(1)).unflatten(-1, (count, length))
    ends = torch.stack((gains[:, :-1], gains[:, 1:]), 2) @ bands
    amplified = (ends * ramp).sum(2).flatten(1)
    return padded[:, DELAY : DELAY + time] + amplified


def gain_at_rate(gains: Tensor, rate: int, time: int) -> Tensor:
    """Interpolate the gains of one band at the samples of another rate, as ``apply_gains`` does.

    Args:
        gains: Gains before the first sample and at the last sample of each hop.
        rate: Sample rate of the result in Hz.
        time: Number of samples.

    Shape: (items, hops + 1) -> (items, time).

    >>> gain_at_rate(torch.tensor([[0.0, 1.0]]), 16000, 63)[0, [15, 31]]
    tensor([0.2500, 0.5000])
    """
    samples = torch.arange(time, device=gains.device)
    position = (samples * RATE + rate).double() / (HOP * rate)
    hop = position.long()
    return torch.lerp(gains[:, hop], gains[:, hop + 1], (position - hop).to(gains))


def frame_power(padded: Tensor) -> Tensor:
    """Compute the power at each frequency in frames of 16 ms every 4 ms.

    The sum over frequencies is the mean square of a frame. The input begins with the HISTORY (12
    ms) before the first hop, or as many zeros, so that a frame ends with each hop.

    Shape: (items, HISTORY + frames * HOP) in pascals -> (items, frames, FRAME / 2 + 1).

    >>> frame_power(torch.randn(2, HISTORY + 10 * HOP)).shape
    torch.Size([2, 10, 129])
    """
    frames = padded.unfold(-1, FRAME, HOP) * constant_like(padded, _window)
    return power(torch.fft.rfft(frames)) * constant_like(padded, _scale)


def level_db(powers: Tensor) -> Tensor:
    """Convert powers in Pa^2 to levels in dB SPL, 0 or more. Any shape.

    >>> level_db(torch.tensor([0.0, 1.0])).round()
    tensor([ 0., 94.])
    """
    return 10.0 * torch.log10(powers + POWER_FLOOR) + PASCAL_SPL


def speech_levels(count: int) -> tuple[float, ...]:
    """Return the level of average speech at 65 dB SPL in each band in dB SPL.

    >>> [round(level) for level in speech_levels(4)]
    [60, 63, 53, 43]
    """
    bands = speech_density(GRID_POINTS) @ shares(count, GRID_POINTS)[1:]
    return tuple((10.0 * np.log10(bands / bands.sum()) + SPEECH_SPL).tolist())


def speech_density(points: int) -> NDArray[np.float64]:
    """Return the relative power density of speech at a transform's frequencies above 0 Hz.

    Returns: (points / 2,).

    >>> speech_density(512).shape
    (256,)
    """
    frequencies = np.arange(1, points // 2 + 1) * RATE / points
    third_octave = 10.0 * np.log10(2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0))
    thirds = np.array(list(SPEECH_SPECTRUM), dtype=float)
    density = np.array(list(SPEECH_SPECTRUM.values())) - 10.0 * np.log10(thirds) - third_octave
    return 10.0 ** (np.interp(np.log(frequencies), np.log(thirds), density) / 10.0)


def _hop_matrix(count: int) -> NDArray[np.float64]:
    """Return the weights of samples in the next ``HOP`` outputs of each band.

    Returns: (2 * DELAY + HOP, count * HOP).
    """
    matrix = np.zeros((2 * DELAY + HOP, count, HOP))
    taps = filters(count).T
    for sample in range(HOP):
        matrix[sample : sample + 2 * DELAY + 1, :, sample] = taps
    return matrix.reshape(len(matrix), -1)


def _ramp() -> NDArray[np.float64]:
    """Return the weights of a hop's first and last gain at each sample, (2, HOP)."""
    last = np.arange(1, HOP + 1) / HOP
    return np.stack([1.0 - last, last])


def _window() -> NDArray[np.float64]:
    """Return a window that rises as a Hann window in 12 ms and falls as one in 4 ms, (FRAME,)."""
    rise = FRAME - FALL
    up = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / rise)
    down = 0.5 + 0.5 * np.cos(np.pi * (np.arange(FALL) + 0.5) / FALL)
    return np.concatenate([up, down])


def _scale() -> NDArray[np.float64]:
    """Return the factor from squared magnitudes to powers, (FRAME / 2 + 1,)."""
    scale = np.full(FRAME // 2 + 1, 2.0 / (FRAME * np.square(_window()).sum()))
    scale[[0, -1]] /= 2.0
    return scale
