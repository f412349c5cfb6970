"""The bands of a wearable aid, its frames, and levels on the same division of frequency."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb
from hlsim.dsp.fft import power
from hlsim.torchtools import constant_like

RATE = 16000
"""Sample rate in Hz at which all of it works."""

HOP = 64
"""Samples from control frame to control frame."""

DELAY = 79
"""Samples, 4.9 ms, that the direct path is late: gains of a frame that has just ended meet what is that old."""

GLIDE = 32
"""Samples, 2 ms, over which the gains of a hop go from the last frame's to the next one's, and then stay."""

FRAME, LONG_FRAME = 256, 512
"""Samples of the frames for levels in bands, 16 ms, and of those for single frequencies, 31.25 Hz apart."""

_FALL = 32  # samples over which the frames' windows fall: their peaks are 2 ms before their ends

HISTORY = LONG_FRAME - HOP
"""Samples before a hop that frames and filters look back on."""

_NARROWEST = 125.0  # Hz from centre to centre, about what frames of 16 ms can tell apart
_LEAST = 10.0 ** (-PASCAL_SPL / 10.0)  # power at 0 dB SPL, under which no level goes
_REACH = 64  # samples to either side, of the smoothing of bands over frequency
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


def spread(gains_db: Tensor) -> Tensor:
    """Gains of bands as gains of single frequencies. Shape: (..., bands) dB -> (..., LONG_FRAME / 2 + 1) dB."""
    added = 10.0 ** (gains_db / 20.0) - 1.0  # sums of shares round, but not those of 0
    return 20.0 * torch.log10(1.0 + added @ constant_like(added, smooth_shares, gains_db.shape[-1]))


def smooth_shares(count: int) -> NDArray[np.float64]:
    """``shares`` as filters of 8 ms have them, which tell frequencies less apart than 250 Hz badly.

    Between a loud band and a silent one, whose gains differ by tens of dB, the gain would fall too steeply without, and a
    tone be heard too softly. Returns (count, LONG_FRAME / 2 + 1).
    """
    impulses = np.fft.irfft(shares(count, LONG_FRAME).T, LONG_FRAME)
    window = np.hanning(2 * _REACH + 3)[1:-1]
    taps = np.roll(impulses, _REACH, -1)[:, : 2 * _REACH + 1] * window
    smooth: NDArray[np.float64] = np.fft.rfft(
        np.roll(np.pad(taps, ((0, 0), (0, LONG_FRAME - taps.shape[-1]))), -_REACH, -1)
    ).real
    return smooth


def gain_at_rate(gains: Tensor, rate: int, time: int) -> Tensor:
    """One frequency's gains as ``apply_filters`` has them, at the samples of another rate, aligned with the input.

    Shape: (items, frames) -> (items, time).
    """
    place = (torch.arange(time, device=gains.device).double() * RATE / rate + DELAY + 1.0) / HOP
    hop = place.long()
    padded = nn.functional.pad(gains, (2, 0))  # what comes before the first frame
    share = ((place - hop) * HOP / GLIDE).clamp_max(1.0)
    return torch.lerp(padded[:, hop], padded[:, hop + 1], share.to(gains))


def frame_power(padded: Tensor, points: int) -> Tensor:
    """Power of each frequency in frames of so many samples, every 4 ms, whose sum is the mean square.

    Shape: (items, HISTORY + frames * HOP) pascals -> (items, frames, points / 2 + 1).
    """
    frames = padded[:, LONG_FRAME - points :].unfold(-1, points, HOP) * constant_like(padded, _window, points)
    return power(torch.fft.rfft(frames)) * constant_like(padded, _scale, points)


def level_db(powers: Tensor) -> Tensor:
    """Level in dB SPL, 0 or more. Any shape."""
    return 10.0 * torch.log10(powers + _LEAST) + PASCAL_SPL


@lru_cache(maxsize=8)
def speech_levels(count: int, spl: float = 65.0) -> tuple[float, ...]:
    """Level in dB SPL of average speech of a level in each band."""
    hz = np.arange(1, _GRID // 2 + 1) * RATE / _GRID
    width = 10.0 * np.log10(2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0))
    thirds = np.array(list(_SPEECH), dtype=float)
    density = np.array(list(_SPEECH.values())) - 10.0 * np.log10(thirds) - width
    powers = 10.0 ** (np.interp(np.log(hz), np.log(thirds), density) / 10.0)
    bands = powers @ shares(count, _GRID)[1:]
    return tuple((10.0 * np.log10(bands / bands.sum()) + spl).tolist())


def _window(points: int) -> NDArray[np.float64]:
    """Rises as a Hann window, and falls as a shorter one: what it tells is 2 ms old."""
    rise = points - _FALL
    up = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / rise)
    down = 0.5 + 0.5 * np.cos(np.pi * (np.arange(_FALL) + 0.5) / _FALL)
    return np.concatenate([up, down])


def _scale(points: int) -> NDArray[np.float64]:
    scale = np.full(points // 2 + 1, 2.0 / (points * np.square(_window(points)).sum()))
    scale[[0, -1]] /= 2.0
    return scale
