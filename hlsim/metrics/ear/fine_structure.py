"""Features of quality: smoothed envelopes, fine structure in 16 ms segments, and long-term spectra.

HASQI and HAAQI share them. Segments at 24 kHz overlap by half; the first and the last one are half
as long.

Source: Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio
Eng. Soc. 62(3), 99-117.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.metrics.ear.model import CHANNELS, Extent, centre_frequencies, integers
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

SEGMENT = 384
"""Samples of a segment of the fine structure, 16 ms at 24 kHz."""

HALF_SEGMENT = SEGMENT // 2
MAX_LAG = RATE // 1000
"""Largest lag in samples between the fine structures of two signals, 1 ms in both directions."""

FFT_POINTS = 432
"""Points of the transforms of segments, enough for a segment and the lags."""

SILENCE_DB = 2.5
"""Level over threshold in dB that a segment, and a channel in it, must exceed to count."""

SYNCHRONY_HZ = 3500.0
"""Frequency above which hair cells lose synchrony (Johnson 1980)."""

SYNCHRONY_ORDER = 5
"""Order of the low-pass that describes this loss."""

ENERGY_FLOOR = 1e-30
"""Energies below this one count as zero."""

NEPERS_PER_DB = math.log(10.0) / 20.0


def count_segments(samples: int, segment: int = SEGMENT) -> int:
    """Return the number of segments of a signal.

    Args:
        samples: Length of the signal.
        segment: Length of a segment in samples, an even number.

    >>> count_segments(1000)
    5
    """
    return 1 + samples // segment + (samples - segment // 2) // segment


def segments_of(extent: Extent, segment: int = SEGMENT) -> Extent:
    """Return the number of segments of each item.

    Args:
        extent: Number of samples of each item.
        segment: Length of a segment in samples, an even number.

    >>> segments_of(Extent((1000, 800))).ends
    (5, 4)
    """
    return Extent(tuple(count_segments(end, segment) for end in extent.ends))


# -- envelopes -------------------------------------------------------------------------------------


def smooth_levels(levels: Tensor, extent: Extent, segment: int = SEGMENT) -> Tensor:
    """Compute the Hann-weighted means of segments, which overlap by half.

    Args:
        levels: Levels of the envelopes in dB.
        extent: Number of samples of each item.
        segment: Length of a segment in samples, an even number.

    Shape: (items, channels, longest) -> (items, channels, segments).

    >>> smooth_levels(torch.ones(1, 2, 1000), Extent((1000,))).shape
    torch.Size([1, 2, 5])
    """
    counts = segments_of(extent, segment)
    half = segment // 2
    window = constant(_half_windows, segment, dtype=levels.dtype, device=levels.device)
    halves = levels[..., : counts.longest * half].unflatten(-1, (counts.longest, half))
    rising, falling = (halves @ window).unbind(-1)
    inner = 0.5 * (rising[..., 1:-1] + falling[..., 2:])
    means = torch.cat((falling[..., :1], inner, rising[..., -1:]), -1)
    if counts.is_even:
        return means
    is_last = _segment_kinds(counts, levels.device)[:, None] == _LAST
    return counts.cut(torch.where(is_last, rising, means))


def _half_windows(segment: int) -> NDArray[np.float64]:
    """Return the rising and the falling half of a Hann window, each of sum 1: (segment / 2, 2)."""
    window = np.hanning(segment).reshape(2, segment // 2).T
    halves: NDArray[np.float64] = window / window.sum(0)
    return halves


class Cepstra(NamedTuple):
    """Five cosines over frequency of the audible segments of two signals, without their means.

    Attributes:
        reference, processed: Cosines over time. Shape: (items, 5, audible segments).
        audible: Number of audible segments of each item.
        extent: The same, but at least 1.

    >>> levels = 40.0 + torch.randn(1, 32, 5)
    >>> compute_cepstra(levels, levels, Extent((5,))).audible.ends
    (5,)
    """

    reference: Tensor
    processed: Tensor
    audible: Extent
    extent: Extent


def compute_cepstra(reference: Tensor, processed: Tensor, counts: Extent) -> Cepstra:
    """Compute the cepstra of the segments that are audible in the reference.

    The host waits for the device once.

    Args:
        reference, processed: Levels by ``smooth_levels``. Shape: (items, 32, segments).
        counts: Number of segments of each item.

    >>> levels = 40.0 + torch.randn(1, 32, 5)
    >>> compute_cepstra(levels, levels, Extent((5,))).reference.shape
    torch.Size([1, 5, 5])
    """
    is_audible = _audible_segments(reference, counts)
    audible = Extent(tuple(is_audible.sum(-1).tolist()))
    extent = Extent(tuple(max(1, count) for count in audible.ends))
    order = (~is_audible).byte().argsort(dim=-1, stable=True)[:, None, : extent.longest]
    basis = constant(_cosines, dtype=reference.dtype, device=reference.device)
    x = extent.centred(basis @ reference.take_along_dim(order, -1))
    y = extent.centred(basis @ processed.take_along_dim(order, -1))
    return Cepstra(x, y, audible, extent)


def absolute_correlation(x: Tensor, y: Tensor) -> Tensor:
    """Compute the magnitude of the correlation of zero-mean signals; 0 where one is constant.

    Shape: (..., time) twice -> (...).

    >>> absolute_correlation(torch.tensor([1.0, -1.0]), torch.tensor([-2.0, 2.0])).round(decimals=4)
    tensor(1.)
    """
    xx, yy, xy = x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1)
    is_varying = (xx >= ENERGY_FLOOR) & (yy >= ENERGY_FLOOR)
    norm = torch.where(is_varying, xx, 1.0).sqrt() * torch.where(is_varying, yy, 1.0).sqrt()
    return torch.where(is_varying, xy.abs() / norm, 0.0)


def envelope_correlation(reference: Tensor, processed: Tensor, counts: Extent) -> Tensor:
    """Compute the mean magnitude of the correlation of five cosines over frequency.

    Only segments that are audible in the reference count; the value is 0 where there are fewer than
    two. The host waits for the device once.

    Args:
        reference, processed: Levels by ``smooth_levels``. Shape: (items, 32, segments).
        counts: Number of segments of each item.

    Returns:
        Correlation of each item, 0 to 1. Shape: (items,).

    >>> levels = 40.0 + torch.randn(1, 32, 5)
    >>> envelope_correlation(levels, 2.0 * levels, Extent((5,))).round(decimals=4)
    tensor([1.])
    """
    cepstra = compute_cepstra(reference, processed, counts)
    correlation = absolute_correlation(cepstra.reference, cepstra.processed).mean(-1)
    return zero_unless_audible(correlation, cepstra.audible)


def zero_unless_audible(values: Tensor, audible: Extent) -> Tensor:
    """Replace the values of items with fewer than two audible segments by 0. Shape: (items,).

    >>> zero_unless_audible(torch.ones(2), Extent((9, 1)))
    tensor([1., 0.])
    """
    return torch.where(integers(audible.ends, values.device) < 2, 0.0, values)


def _audible_segments(levels: Tensor, counts: Extent) -> Tensor:
    """Return whether a segment exceeds the threshold of hearing.

    Shape: (items, 32, segments) in dB over threshold -> bool (items, segments).
    """
    loudness = (levels.detach() * NEPERS_PER_DB).exp().mean(1)
    return counts.inside(levels.device) & (loudness > 10.0 ** (SILENCE_DB / 20.0))


def _cosines() -> NDArray[np.float64]:
    angle = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    return np.cos(np.arange(1, 6)[:, None] * angle)


# -- fine structure --------------------------------------------------------------------------------


_FIRST, _INNER, _LAST = 0, 1, 2
"""Kinds of segments: the first and the last one are half as long."""


def _segment_kinds(counts: Extent, device: torch.device) -> Tensor:
    """Return the kind of each segment. Shape: -> int64 (items, segments)."""
    indices = torch.arange(counts.longest, device=device)
    is_last = indices == integers(counts.ends, device)[:, None] - 1
    return torch.where(is_last, _LAST, (indices > 0).long())


def segment_spectra(motion: Tensor, extent: Extent) -> tuple[Tensor, Tensor]:
    """Compute the spectra of windowed segments and their mean squares.

    The means are subtracted first. Mean squares are those of an envelope, twice those of the
    motion.

    Args:
        motion: Motion of the basilar membrane, zero after the end of each item.
        extent: Number of samples of each item.

    Shape: (items, channels, longest) -> (items, channels, segments, bins), (items, channels,
    segments).

    >>> spectra, energy = segment_spectra(torch.randn(1, 2, 1000), Extent((1000,)))
    >>> spectra.shape, energy.shape
    (torch.Size([1, 2, 5, 217]), torch.Size([1, 2, 5]))
    """
    counts = segments_of(extent)
    constant_like_motion = partial(constant, dtype=motion.dtype, device=motion.device)
    kinds = _segment_kinds(counts, motion.device)
    window = constant_like_motion(_windows)[kinds][:, None]
    inside = constant_like_motion(_inside)[kinds][:, None]
    missing = (counts.longest + 1) * HALF_SEGMENT - motion.shape[-1]
    padded = functional.pad(motion, (0, max(0, missing)))
    segments = padded.unfold(-1, SEGMENT, HALF_SEGMENT)[..., : counts.longest, :] * window
    means = segments.sum(-1, keepdim=True) / inside.sum(-1, keepdim=True)
    segments = torch.addcmul(segments, means, inside, value=-1.0)
    energy = segments.square().sum(-1) / window.square().sum(-1)
    return torch.fft.rfft(segments, FFT_POINTS), counts.cut(2.0 * energy)


def _windows() -> NDArray[np.float64]:
    """Return the window of each kind of segment: (3, SEGMENT).

    The first segment has the falling half of a window, the last one the rising half.
    """
    window = np.hanning(SEGMENT)
    falling = np.concatenate((window[HALF_SEGMENT:], np.zeros(HALF_SEGMENT)))
    rising = np.concatenate((window[:HALF_SEGMENT], np.zeros(HALF_SEGMENT)))
    return np.stack((falling, window, rising))


def _inside() -> NDArray[np.float64]:
    """Return 1 for the samples of a segment and 0 for its padding, by kind: (3, SEGMENT)."""
    inside = np.ones((3, SEGMENT))
    inside[[_FIRST, _LAST], HALF_SEGMENT:] = 0.0
    return inside


def coherence(
    reference: tuple[Tensor, Tensor], processed: tuple[Tensor, Tensor], counts: Extent
) -> Tensor:
    """Compute the largest normalised cross-covariance over lags of up to 1 ms.

    Args:
        reference, processed: Spectra and mean squares by ``segment_spectra``.
        counts: Number of segments of each item.

    Returns:
        Coherence from 0 to 1. Shape: (items, channels, segments).

    >>> spectra = segment_spectra(torch.randn(1, 2, 1000), Extent((1000,)))
    >>> float(coherence(spectra, spectra, Extent((5,))).min()) > 0.99
    True
    """
    (x, xx), (y, yy) = reference, processed
    kinds = _segment_kinds(counts, xx.device)
    weights = constant(_lag_weights, dtype=xx.dtype, device=xx.device)[kinds][:, None]
    covariance = torch.fft.irfft(x * y.conj(), FFT_POINTS)
    near = torch.cat((covariance[..., : MAX_LAG + 1], covariance[..., -MAX_LAG:]), -1) * weights
    is_moving = (xx > 2.0 * ENERGY_FLOOR) & (yy > 2.0 * ENERGY_FLOOR)
    norm = 0.5 * torch.where(is_moving, xx, 1.0).sqrt() * torch.where(is_moving, yy, 1.0).sqrt()
    return torch.where(is_moving, near.abs().amax(-1) / norm, 0.0).clamp(0.0, 1.0)


def _lag_weights() -> NDArray[np.float64]:
    """Return the inverse autocorrelations of the windows at lags 0 to 24 and -24 to -1: (3, 49)."""
    lags = [*range(MAX_LAG + 1), *range(MAX_LAG, 0, -1)]
    rows = []
    for window in _windows():
        autocorrelation = np.correlate(window, window, "full")[SEGMENT - 1 :]
        rows.append(1.0 / autocorrelation[lags])
    return np.stack(rows)


def synchrony(coherences: Tensor, mean_square: Tensor, counts: Extent) -> Tensor:
    """Compute the mean coherence of what is audible in the reference.

    Channels count less where hair cells lose synchrony. The value is 0 where fewer than two
    segments are audible.

    Args:
        coherences: Values by ``coherence``. Shape: (items, 32, segments).
        mean_square: Mean squares of the reference's segments. Shape: (items, 32, segments).
        counts: Number of segments of each item.

    Returns:
        Mean of each item, 0 to 1. Shape: (items,).

    >>> mean_square = torch.full((1, 32, 5), 40.0) ** 2
    >>> synchrony(torch.full((1, 32, 5), 0.5), mean_square, Extent((5,)))
    tensor([0.5000])
    """
    rms = mean_square.detach().sqrt()
    is_audible = _audible_segments(rms, counts)
    weights = constant(_synchrony_weights, dtype=rms.dtype, device=rms.device)[:, None]
    weights = weights * ((rms > SILENCE_DB) & is_audible[:, None])
    total = (weights * coherences).sum((-2, -1))
    mean = total / weights.sum((-2, -1)).clamp_min(ENERGY_FLOOR)
    return torch.where(is_audible.sum(-1) < 2, 0.0, mean)


def _synchrony_weights() -> NDArray[np.float64]:
    ratio = (centre_frequencies() / SYNCHRONY_HZ) ** (2 * SYNCHRONY_ORDER)
    return 1.0 / np.sqrt(1.0 + ratio)


# -- long-term spectra -----------------------------------------------------------------------------


def relative_loudness(levels: Tensor) -> Tensor:
    """Return the share that each channel has in the loudness.

    Shape: (..., 32) dB over threshold -> (..., 32), of sum 1.

    >>> relative_loudness(torch.tensor([20.0, 20.0]))
    tensor([0.5000, 0.5000])
    """
    amplitude = torch.exp(levels * NEPERS_PER_DB)
    return amplitude / amplitude.sum(-1, keepdim=True)


def spectral_similarity(differences: Tensor, scale: float) -> Tensor:
    """Compute the similarity of two spectra, from 0 to 1.

    It is 1 - 32 s / scale, where s is the standard deviation of the differences over the 32
    channels, and at least 0.

    Args:
        differences: One spectrum minus the other. Shape: (..., channels).
        scale: Value of 32 s at which the similarity is 0.

    Shape: (..., channels) -> (...).

    >>> spectral_similarity(torch.zeros(32), 2.5)
    tensor(1.)
    """
    variance = differences.var(-1, correction=0)
    is_positive = variance > 0.0  # the square root of 0 has no gradient
    deviation = torch.where(is_positive, torch.where(is_positive, variance, 1.0).sqrt(), 0.0)
    return (1.0 - CHANNELS * deviation / scale).clamp(0.0, 1.0)
