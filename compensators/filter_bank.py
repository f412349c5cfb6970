"""Filter bank of the wearable aids: it amplifies bands of a signal, and measures their levels.

The bands cover 0 to 8000 Hz at a sample rate of 16 kHz. Their filters have linear phase, and their
sum is a delay of 64 samples. Three terms of all wearable aids:

- A *hop* is 64 samples (4 ms). An aid computes the gains of its bands once per hop.
- A *frame* is the last 256 samples (16 ms) at the end of a hop, whose spectrum sets the gains.
- An *excess gain* is a linear gain minus 1. If it is 0 in all bands, the signal is only delayed,
  and no bit of its samples changes.
"""

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.published import SPEECH_SPECTRUM
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.erb import erb
from hlsim.dsp.fft import power
from hlsim.dsp.interpolation import interpolation_weights
from hlsim.torchtools import constant

RATE = 16000
"""Sample rate of the aids in Hz."""

DELAY = 64
"""Delay of the filters in samples, 4 ms. Each filter has 2 * 64 + 1 taps."""

HOP = 64
"""Number of samples from the end of one frame to the end of the next one."""

FRAME = 256
"""Number of samples of a frame."""

FALL = 64
"""Number of samples at the end of a frame in which its window falls."""

HISTORY = FRAME - HOP
"""Number of samples before a hop that belong to its frame."""

MIN_SPACING = 125.0
"""Smallest distance of two centres in Hz, about what filters of this length can separate."""

POWER_FLOOR = 10.0 ** (-PASCAL_SPL / 10.0)
"""Power in Pa^2 at 0 dB SPL, the lowest level of a band."""

GRID_POINTS = 4096
"""Length of the Fourier transform with which filters and the spectrum of speech are computed."""

SPEECH_SPL = 65.0
"""Level in dB SPL at which average speech is presented."""


@lru_cache(maxsize=8)
def filter_centres(bands: int) -> tuple[float, ...]:
    """Return the centre frequencies of the bands in Hz, from 0 to 8000.

    Neighbours are an equal number of ERBs (bandwidths of the normal ear), but at least 125 Hz,
    apart.

    Args:
        bands: Number of bands, 4 to 40.

    >>> [round(hertz) for hertz in filter_centres(4)]
    [0, 526, 2264, 8000]
    """
    low, high = 0.0, 100.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if _spaced_frequencies(bands, middle)[-1] < RATE / 2.0:
            low = middle
        else:
            high = middle
    return tuple(min(frequency, RATE / 2.0) for frequency in _spaced_frequencies(bands, high))


def _spaced_frequencies(count: int, erbs: float) -> list[float]:
    """Return ``count`` frequencies from 0 Hz upwards, ``erbs`` ERBs but at least 125 Hz apart."""
    frequencies = [0.0]
    for _ in range(count - 1):
        width = erbs * float(erb(np.array(frequencies[-1])))
        frequencies.append(frequencies[-1] + max(MIN_SPACING, width))
    return frequencies


def filter_powers(powers: Tensor, bands: int) -> Tensor:
    """Add up the powers of a frame's frequencies in each band.

    The power at a frequency between two centres is shared between both bands, linearly, so that the
    nearer band gets more.

    Args:
        powers: Powers in Pa^2 from ``frame_power``.
        bands: Number of bands, 4 to 40.

    Shape: (items, frames, FRAME / 2 + 1) -> (items, frames, bands) in Pa^2.

    >>> filter_powers(torch.ones(1, 1, FRAME // 2 + 1), bands=4).round()
    tensor([[[ 5., 18., 60., 46.]]])
    """
    return powers @ _filter_shares(bands, FRAME, like=powers)


@constant
def _filter_shares(bands: int, points: int) -> NDArray[np.float64]:
    """Return the weight of each band at each frequency of a Fourier transform of ``points``.

    The weights are linear between the centres of bands, and sum to 1 at each frequency.

    Returns: (points / 2 + 1, bands).
    """
    frequencies = np.arange(points // 2 + 1) * RATE / points
    return interpolation_weights(filter_centres(bands), frequencies).T


def _filter_taps(bands: int) -> NDArray[np.float64]:
    """Return the symmetric taps of the bands' filters.

    Their sum over all bands is 1 in the middle and 0 elsewhere: a delay.

    Returns: (bands, 2 * DELAY + 1).
    """
    impulses = np.fft.irfft(_filter_shares(bands, GRID_POINTS).T, GRID_POINTS)
    taps = np.roll(impulses, DELAY, -1)[:, : 2 * DELAY + 1]
    return taps * np.hanning(2 * DELAY + 3)[1:-1]


@constant
def filter_leakage(bands: int) -> NDArray[np.float64]:
    """Return the share of the power of a sound that passes the filter of another band.

    A filter attenuates sounds in distant bands by 45 dB or more. An aid that amplifies its band by
    as much makes them audible again.

    Args:
        bands: Number of bands, 4 to 40.

    Returns:
        Largest share for a sound in each band (rows) by the filter of each band (columns), (bands,
        bands): 1 for the band itself, and 0 for the two next ones on either side, which are not
        distant.

    >>> decibels = 10.0 * np.log10(filter_leakage(20)[5, :3])  # sounds near 627 Hz
    >>> print(decibels.round())
    [-63. -54. -46.]
    """
    responses = np.abs(np.fft.rfft(_filter_taps(bands), GRID_POINTS)) ** 2
    nearest = _filter_shares(bands, GRID_POINTS).argmax(1)
    shares = np.stack([responses[:, nearest == band].max(1) for band in range(bands)])
    distance = np.abs(np.arange(bands)[:, None] - np.arange(bands))
    return np.where(distance > 2, shares, np.eye(bands))


def apply_gains(samples: Tensor, excess_gains: Tensor, position: int = 0) -> Tensor:
    """Divide a signal into bands, multiply each by its gain, and add them up again.

    The gain of a band is interpolated linearly from the beginning to the end of each hop of 64
    samples. The output is delayed by ``DELAY`` = 64 samples.

    Args:
        samples: ``2 * DELAY`` = 128 earlier samples, which the filters need, followed by whole hops
            or a part of one hop.
        excess_gains: Linear gains minus 1 of each band, at the beginning of each hop and at the end
            of the last one.
        position: Number of samples of the hop before the part of it that is passed; 0 for whole
            hops.

    Shape: (items, 2 * DELAY + time), (items, hops + 1, bands) -> (items, time).

    >>> gains_of_6_db = torch.ones(1, 3, 20)
    >>> apply_gains(torch.ones(1, 2 * DELAY + 2 * HOP), gains_of_6_db).round()[0, :3]
    tensor([2., 2., 2.])
    """
    time, bands = samples.shape[-1] - 2 * DELAY, excess_gains.shape[-1]
    length = min(time, HOP)
    # A matrix product instead of a Fourier transform, in which later samples would change earlier
    # ones by rounding.
    matrix = _hop_matrix(bands, like=samples).unflatten(1, (bands, HOP))
    matrix = matrix[: length + 2 * DELAY, :, :length]
    hops = samples.unfold(-1, length + 2 * DELAY, length)
    bands_of_hops = (hops @ matrix.flatten(1)).unflatten(-1, (bands, length))
    first_and_last = torch.stack((excess_gains[:, :-1], excess_gains[:, 1:]), 2)
    ramp = _ramp(like=samples)[:, position : position + length]
    added = ((first_and_last @ bands_of_hops) * ramp).sum(2).flatten(1)
    return samples[:, DELAY : DELAY + time] + added


def gain_at_rate(gains: Tensor, rate: int, time: int) -> Tensor:
    """Interpolate the gains of one band linearly to the samples of a signal at another rate.

    Args:
        gains: Gain just before the first sample, then that at the last sample of each hop at 16
            kHz.
        rate: Sample rate of the signal in Hz.
        time: Number of samples of the signal, which ends before the hops do.

    Shape: (items, hops + 1) -> (items, time).

    >>> gain_at_rate(torch.tensor([[0.0, 1.0]]), 16000, 63)[0, [15, 31]]
    tensor([0.2500, 0.5000])
    """
    samples = torch.arange(time, device=gains.device)
    position = (samples * RATE + rate).double() / (HOP * rate)
    hop = position.long()
    return torch.lerp(gains[:, hop], gains[:, hop + 1], (position - hop).to(gains))


def frame_power(samples: Tensor) -> Tensor:
    """Compute the power spectrum of the last 16 ms (a frame) at the end of every 4 ms (a hop).

    The sum over frequencies is the mean square of the frame, weighted by its squared window:
    samples of 1 Pa give 1 Pa^2.

    Args:
        samples: Samples of whole hops in pascals, after the ``HISTORY`` = 192 samples before them
            (zeros at the beginning of a signal).

    Shape: (items, HISTORY + frames * HOP) -> (items, frames, FRAME / 2 + 1) in Pa^2.

    >>> frame_power(torch.randn(2, HISTORY + 10 * HOP)).shape
    torch.Size([2, 10, 129])
    """
    frames = samples.unfold(-1, FRAME, HOP) * _window(like=samples)
    return power(torch.fft.rfft(frames)) * _scale(like=samples)


def level_db(powers: Tensor) -> Tensor:
    """Convert powers in Pa^2 to levels in dB SPL, 0 or more. Any shape.

    >>> level_db(torch.tensor([0.0, 1.0])).round()
    tensor([ 0., 94.])
    """
    return 10.0 * torch.log10(powers + POWER_FLOOR) + PASCAL_SPL


@constant
def speech_band_levels(bands: int) -> NDArray[np.float64]:
    """Return the level in dB SPL of average speech in each band, (bands,), at 65 dB SPL in total.

    The centres of the bands are those of ``filter_centres``.

    >>> print(speech_band_levels(4).round())
    [60. 63. 53. 43.]
    """
    powers = speech_density(GRID_POINTS) @ _filter_shares(bands, GRID_POINTS)[1:]
    return 10.0 * np.log10(powers / powers.sum()) + SPEECH_SPL


def speech_density(points: int) -> NDArray[np.float64]:
    """Return the power density of average speech at the frequencies of a transform, up to a factor.

    Args:
        points: Length of the Fourier transform at 16 kHz.

    Returns:
        Power per Hz at each frequency above 0 Hz, (points / 2,).

    >>> speech_density(512).shape
    (256,)
    """
    frequencies = np.arange(1, points // 2 + 1) * RATE / points
    third_octave = 10.0 * np.log10(2.0 ** (1.0 / 6.0) - 2.0 ** (-1.0 / 6.0))
    thirds = np.array(list(SPEECH_SPECTRUM), dtype=float)
    density = np.array(list(SPEECH_SPECTRUM.values())) - 10.0 * np.log10(thirds) - third_octave
    return 10.0 ** (interpolate_over_log(frequencies, thirds, density) / 10.0)


@constant
def _hop_matrix(bands: int) -> NDArray[np.float64]:
    """Return the matrix that filters samples into bands.

    The product of 192 samples, a hop with the 128 samples before it, and this matrix is the 64
    samples of the first band, then those of the second one, and so on.

    Returns: (2 * DELAY + HOP, bands * HOP).
    """
    matrix = np.zeros((2 * DELAY + HOP, bands, HOP))
    taps = _filter_taps(bands).T
    for sample in range(HOP):
        matrix[sample : sample + 2 * DELAY + 1, :, sample] = taps
    return matrix.reshape(len(matrix), -1)


@constant
def _ramp() -> NDArray[np.float64]:
    """Return the weights of the gains at the start and at the end of a hop, by sample, (2, HOP)."""
    last = np.arange(1, HOP + 1) / HOP
    return np.stack([1.0 - last, last])


@constant
def _window() -> NDArray[np.float64]:
    """Return a window that rises as a Hann window in 12 ms and falls as one in 4 ms, (FRAME,)."""
    rise = FRAME - FALL
    up = 0.5 - 0.5 * np.cos(np.pi * (np.arange(rise) + 0.5) / rise)
    down = 0.5 + 0.5 * np.cos(np.pi * (np.arange(FALL) + 0.5) / FALL)
    return np.concatenate([up, down])


@constant
def _scale() -> NDArray[np.float64]:
    """Return the factors by which squared magnitudes of a frame's spectrum become powers in Pa^2.

    Returns: (FRAME / 2 + 1,).
    """
    scale = np.full(FRAME // 2 + 1, 2.0 / (FRAME * np.square(_window()).sum()))
    scale[[0, -1]] /= 2.0
    return scale
