"""The bands of a wearable aid: linear-phase filters that sum to a delay, and levels on the same division of frequency."""

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
"""Sample rate in Hz at which all of it works."""

DELAY = 64
"""Delay of the filters in samples, 4 ms; each has 2 * 64 + 1 taps."""

HOP = 64
"""Samples from control frame to control frame."""

FRAME, _FALL = 256, 64
"""Samples of a control frame; those over which its window falls: its peak is 4 ms before its end."""

HISTORY = FRAME - HOP
"""Samples before a hop that frame and filters look back on."""

_NARROWEST = 125.0  # Hz from centre to centre, about what filters of this length can tell apart
_LEAST = 10.0 ** (-PASCAL_SPL / 10.0)  # power at 0 dB SPL, under which no level goes
_GRID = 4096

# Long-term average of speech at 70 dB SPL in thirds of an octave, men's and women's: Byrne et al. 1994, JASA 96(4)
_SPEECH = {
    63: 38.6, 80: 43.5, 100: 54.4, 125: 57.7, 160: 56.8, 200: 60.2, 250: 60.3, 315: 59.0, 400: 62.1, 500: 62.1,
    630: 60.5, 800: 56.8, 1000: 53.7, 1250: 53.0, 1600: 52.0, 2000: 48.7, 2500: 48.1, 3150: 46.8, 4000: 45.6,
    5000: 44.5, 6300: 44.3, 8000: 43.7,
}  # fmt: skip


@lru_cache(maxsize=8)
def centres(count: int) -> tuple[float, ...]:
    """Centre frequencies from 0 to 8000 Hz: an equal number of ERBs apart, but no less than 125 Hz."""

    def made(erbs: float) -> list[float]:
        places = [0.0]
        for _ in range(count - 1):
            places.append(places[-1] + max(_NARROWEST, erbs * float(erb(np.array(places[-1])))))
        return places

    low, high = 0.0, 100.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if made(middle)[-1] < RATE / 2.0 else (low, middle)
    return tuple(min(place, RATE / 2.0) for place in made(high))


def shares(count: int, points: int) -> NDArray[np.float64]:
    """Share of each band in each frequency of an FFT: straight lines between centres, which sum to 1.

    Returns (points / 2 + 1, count).
    """
    hz = np.arange(points // 2 + 1) * RATE / points
    return np.stack([np.interp(hz, centres(count), row) for row in np.eye(count)], 1)


def filters(count: int) -> NDArray[np.float64]:
    """Taps of the bands' filters, symmetric, whose sum is 1 at the middle and 0 elsewhere. Returns (count, 129)."""
    impulses = np.fft.irfft(shares(count, _GRID).T, _GRID)
    taps = np.roll(impulses, DELAY, -1)[:, : 2 * DELAY + 1]
    return taps * np.hanning(2 * DELAY + 3)[1:-1]


def apply_gains(padded: Tensor, gains: Tensor, first: int = 0) -> Tensor:
    """The sum of the bands times gains that go linearly from hop to hop, ``DELAY`` samples late.

    Sums alone, no transform: what comes later changes nothing, not even by rounding. Gains of 1 change nothing either.

    Args:
        padded: the samples, ``2 * DELAY`` before them first: of whole hops, or within one.
        gains: less 1, where each hop begins and the last ends.
        first: the place of the first sample in its hop.

    Shape: (items, 2 * DELAY + time), (items, hops + 1, bands) -> (items, time).
    """
    time, count = padded.shape[-1] - 2 * DELAY, gains.shape[-1]
    length = min(time, HOP)
    taps = constant_like(padded, _for_a_hop, count).unflatten(1, (count, HOP))[
        : length + 2 * DELAY, :, :length
    ]
    ramp = constant_like(padded, _ramp)[:, first : first + length]
    hops = padded.unfold(-1, length + 2 * DELAY, length)
    bands = (hops @ taps.flatten(1)).unflatten(-1, (count, length))
    both = torch.stack((gains[:, :-1], gains[:, 1:]), 2) @ bands
    added = (both * ramp).sum(2).flatten(1)
    return padded[:, DELAY : DELAY + time] + added


def gain_at_rate(gains: Tensor, rate: int, time: int) -> Tensor:
    """One band's gains as ``apply_gains`` has them, linear from hop to hop, at the samples of another rate.

    Args:
        gains: before the first sample and at the last one of each hop.

    Shape: (items, hops + 1) -> (items, time).
    """
    place = (torch.arange(time, device=gains.device) * RATE + rate).double() / (HOP * rate)
    hop = place.long()
    return torch.lerp(gains[:, hop], gains[:, hop + 1], (place - hop).to(gains))


def frame_power(padded: Tensor) -> Tensor:
    """Power of each frequency in frames of 16 ms every 4 ms, whose sum is the mean square.

    Shape: (items, HISTORY + frames * HOP) pascals -> (items, frames, FRAME / 2 + 1).
    """
    frames = padded.unfold(-1, FRAME, HOP) * constant_like(padded, _window)
    return power(torch.fft.rfft(frames)) * constant_like(padded, _scale)


def level_db(powers: Tensor) -> Tensor:
    """Level in dB SPL, 0 or more. Any shape."""
    return 10.0 * torch.log10(powers + _LEAST) + PASCAL_SPL


def speech_levels(count: int) -> tuple[float, ...]:
    """Level in dB SPL of average speech at 65 dB SPL in each band."""
    hz = np.arange(1, _GRID // 2 + 1) * RATE / _GRID
    width = 10.0 * np.log10(2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0))
    thirds = np.array(list(_SPEECH), dtype=float)
    density = np.array(list(_SPEECH.values())) - 10.0 * np.log10(thirds) - width
    powers = 10.0 ** (np.interp(np.log(hz), np.log(thirds), density) / 10.0)
    bands = powers @ shares(count, _GRID)[1:]
    return tuple((10.0 * np.log10(bands / bands.sum()) + 65.0).tolist())


def _for_a_hop(count: int) -> NDArray[np.float64]:
    """Weights of samples in the bands' next ``HOP`` outputs. Returns (2 * DELAY + HOP, count * HOP)."""
    matrix = np.zeros((2 * DELAY + HOP, count, HOP))
    for place in range(HOP):
        matrix[place : place + 2 * DELAY + 1, :, place] = filters(count).T
    return matrix.reshape(len(matrix), -1)


def _ramp() -> NDArray[np.float64]:
    """Weights of a hop's first and last gain at each sample. Returns (2, HOP)."""
    last = np.arange(1, HOP + 1) / HOP
    return np.stack([1.0 - last, last])


def _window() -> NDArray[np.float64]:
    """Rises as a Hann window over 12 ms and falls as one over 4 ms: what it tells is 4 ms old."""
    rise = FRAME - _FALL
    up = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / rise)
    down = 0.5 + 0.5 * np.cos(np.pi * (np.arange(_FALL) + 0.5) / _FALL)
    return np.concatenate([up, down])


def _scale() -> NDArray[np.float64]:
    scale = np.full(FRAME // 2 + 1, 2.0 / (FRAME * np.square(_window()).sum()))
    scale[[0, -1]] /= 2.0
    return scale
