"""How smoothed envelopes and the basilar membrane's motion agree, 16 ms at a time: HASQI's features.

Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio Eng. Soc. 62(3), 99-117.
Segments of 384 samples at 24 kHz overlap by half; the first and the last are half as long.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.metrics.ear.model import CHANNELS, Extent, centre_frequencies, integers
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

SEGMENT = 384
_HALF = SEGMENT // 2
_LAGS = RATE // 1000  # 1 ms, either way
_POINTS = 432  # of the transforms: a segment and the lags

_SILENCE = 2.5  # dB over threshold that a segment, and a channel's part of it, is to exceed
_SYNCHRONY_HZ, _SYNCHRONY_ORDER = 3500.0, 5  # of the hair cells' loss of synchrony (Johnson 1980)

_NOTHING = 1e-30


def segments(time: int) -> int:
    """How many there are in a signal of so many samples."""
    return 1 + time // SEGMENT + (time - _HALF) // SEGMENT


def segments_of(extent: Extent) -> Extent:
    """Return the number of segments of each item."""
    return Extent(tuple(segments(end) for end in extent.ends))


def smoothed(levels: Tensor, extent: Extent) -> Tensor:
    """Compute Hann-weighted means. Shape: (items, channels, longest) -> (items, channels, segments)."""
    counts = segments_of(extent)
    window = constant(_halves, dtype=levels.dtype, device=levels.device)
    halves = levels[..., : counts.longest * _HALF].unflatten(-1, (counts.longest, _HALF))
    rising, falling = (halves @ window).unbind(-1)
    inner = 0.5 * (rising[..., 1:-1] + falling[..., 2:])
    means = torch.cat((falling[..., :1], inner, rising[..., -1:]), -1)
    if counts.is_even:
        return means
    is_last = _segment_kinds(counts, levels.device)[:, None] == _LAST
    return counts.cut(torch.where(is_last, rising, means))


def _halves() -> NDArray[np.float64]:
    """The rising and the falling half of a Hann window, each of sum 1: (192, 2)."""
    window = np.hanning(SEGMENT).reshape(2, _HALF).T
    halves: NDArray[np.float64] = window / window.sum(0)
    return halves


def envelope_correlation(reference: Tensor, processed: Tensor, counts: Extent) -> Tensor:
    """Mean magnitude of the correlation of five cosines over frequency.

    Segments that are silent in the reference are left out; the value is 0 where no two are left. The host waits for the
    device once.

    Args:
        reference, processed: by ``smoothed``. Shape: (items, 32, segments).
        counts: segments of each item.

    Returns: (items,).
    """
    places = _loud(reference, counts)
    loud = Extent(tuple(places.sum(-1).tolist()))
    kept = Extent(tuple(max(1, count) for count in loud.ends))
    order = (~places).byte().argsort(dim=-1, stable=True)[:, None, : kept.longest]
    basis = constant(_cosines, dtype=reference.dtype, device=reference.device)
    x, y = (
        kept.centred(basis @ levels.take_along_dim(order, -1)) for levels in (reference, processed)
    )
    xx, yy, xy = x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1)
    there = (xx >= _NOTHING) & (yy >= _NOTHING)
    norm = torch.where(there, xx, 1.0).sqrt() * torch.where(there, yy, 1.0).sqrt()
    correlation = torch.where(there, xy.abs() / norm, 0.0).mean(-1)
    return torch.where(integers(loud.ends, reference.device) < 2, 0.0, correlation)


def _loud(levels: Tensor, counts: Extent) -> Tensor:
    """Whether a segment exceeds the threshold of hearing. Shape: (items, 32, segments) -> (items, segments), bool."""
    loudness = (levels.detach() * (math.log(10.0) / 20.0)).exp().mean(1)
    return counts.inside(levels.device) & (loudness > 10.0 ** (_SILENCE / 20.0))


def _cosines() -> NDArray[np.float64]:
    place = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    return np.cos(np.arange(1, 6)[:, None] * place)


# -- motion ------------------------------------------------------------------------------------------------------------


_FIRST, _INNER, _LAST = 0, 1, 2
"""Kinds of segments: the first and the last one are half as long."""


def _segment_kinds(counts: Extent, device: torch.device) -> Tensor:
    """Shape: -> (items, segments), int64."""
    places = torch.arange(counts.longest, device=device)
    is_last = places == integers(counts.ends, device)[:, None] - 1
    return torch.where(is_last, _LAST, (places > 0).long())


def segment_spectra(motion: Tensor, extent: Extent) -> tuple[Tensor, Tensor]:
    """Compute spectra of windowed segments without their means, and mean squares of the segments as of an envelope.

    Args:
        motion: zero after the end of each item. Shape: (items, channels, longest).

    Returns: (items, channels, segments, bins), (items, channels, segments).
    """
    counts = segments_of(extent)
    fixed = partial(constant, dtype=motion.dtype, device=motion.device)
    kinds = _segment_kinds(counts, motion.device)
    window, inside = (fixed(make)[kinds][:, None] for make in (_windows, _inside))
    behind = (counts.longest + 1) * _HALF - motion.shape[-1]
    padded = functional.pad(motion, (0, max(0, behind)))
    parts = padded.unfold(-1, SEGMENT, _HALF)[..., : counts.longest, :] * window
    means = parts.sum(-1, keepdim=True) / inside.sum(-1, keepdim=True)
    parts = torch.addcmul(parts, means, inside, value=-1.0)
    energy = parts.square().sum(-1) / window.square().sum(-1)
    return torch.fft.rfft(parts, _POINTS), counts.cut(2.0 * energy)


def _windows() -> NDArray[np.float64]:
    """Windows by kind: the first is the falling half, the last the rising half, padded. Returns (3, SEGMENT)."""
    window = np.hanning(SEGMENT)
    falling = np.concatenate((window[_HALF:], np.zeros(_HALF)))
    rising = np.concatenate((window[:_HALF], np.zeros(_HALF)))
    return np.stack((falling, window, rising))


def _inside() -> NDArray[np.float64]:
    """1 for the samples of a segment, by kind. Returns (3, SEGMENT)."""
    inside = np.ones((3, SEGMENT))
    inside[[_FIRST, _LAST], _HALF:] = 0.0
    return inside


def coherence(
    reference: tuple[Tensor, Tensor], processed: tuple[Tensor, Tensor], counts: Extent
) -> Tensor:
    """Compute the largest normalised cross-covariance over lags of up to 1 ms, 0 to 1.

    Args:
        reference, processed: by ``segment_spectra``.
        counts: segments of each item.

    Returns: (items, channels, segments).
    """
    (x, xx), (y, yy) = reference, processed
    kinds = _segment_kinds(counts, xx.device)
    weights = constant(_lag_weights, dtype=xx.dtype, device=xx.device)[kinds][:, None]
    covariance = torch.fft.irfft(x * y.conj(), _POINTS)
    near = torch.cat((covariance[..., : _LAGS + 1], covariance[..., -_LAGS:]), -1) * weights
    there = (xx > 2.0 * _NOTHING) & (yy > 2.0 * _NOTHING)
    norm = 0.5 * torch.where(there, xx, 1.0).sqrt() * torch.where(there, yy, 1.0).sqrt()
    return torch.where(there, near.abs().amax(-1) / norm, 0.0).clamp(0.0, 1.0)


def _lag_weights() -> NDArray[np.float64]:
    """Inverse autocorrelations of the windows at lags 0 to 24 and -24 to -1. Returns (3, 49)."""
    lags = [*range(_LAGS + 1), *range(_LAGS, 0, -1)]
    rows = []
    for window in _windows():
        autocorrelation = np.correlate(window, window, "full")[SEGMENT - 1 :]
        rows.append(1.0 / autocorrelation[lags])
    return np.stack(rows)


def synchrony(coherences: Tensor, mean_square: Tensor, counts: Extent) -> Tensor:
    """Mean of what lies over threshold in the reference, less where hair cells lose synchrony.

    Args:
        coherences: (items, 32, segments).
        mean_square: that of the reference's segments. Shape: (items, 32, segments).
        counts: segments of each item.

    Returns: (items,); 0 where no two segments are over threshold.
    """
    rms = mean_square.detach().sqrt()
    loud = _loud(rms, counts)
    weights = constant(_synchronous, dtype=rms.dtype, device=rms.device)[:, None]
    weights = weights * ((rms > _SILENCE) & loud[:, None])
    total = (weights * coherences).sum((-2, -1))
    mean = total / weights.sum((-2, -1)).clamp_min(_NOTHING)
    return torch.where(loud.sum(-1) < 2, 0.0, mean)


def _synchronous() -> NDArray[np.float64]:
    ratio = (centre_frequencies() / _SYNCHRONY_HZ) ** (2 * _SYNCHRONY_ORDER)
    return 1.0 / np.sqrt(1.0 + ratio)


# -- long-term spectra -------------------------------------------------------------------------------------------------


def spectral_likeness(reference: Tensor, processed: Tensor) -> Tensor:
    """By the spread of differences between two spectra and between their slopes, 0 to 1.

    Shape: (..., 32) dB over threshold, twice -> (...,).
    """
    x, y = (torch.exp(levels * (math.log(10.0) / 20.0)) for levels in (reference, processed))
    difference = x / x.sum(-1, keepdim=True) - y / y.sum(-1, keepdim=True)
    shape = (1.0 - CHANNELS * _spread(difference) / 2.5).clamp(0.0, 1.0)
    slope = (1.0 - CHANNELS * _spread(difference.diff(dim=-1))).clamp(0.0, 1.0)
    return 0.579 * shape + 0.421 * slope


def _spread(values: Tensor) -> Tensor:
    variance = values.var(-1, correction=0)
    there = variance > 0.0
    return torch.where(there, torch.where(there, variance, 1.0).sqrt(), 0.0)
