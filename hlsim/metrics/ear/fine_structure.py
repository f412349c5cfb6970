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

from hlsim.metrics.ear.model import CHANNELS, centre_frequencies
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


def smoothed(levels: Tensor) -> Tensor:
    """Hann-weighted means. Shape: (channels, time) -> (channels, segments)."""
    count = segments(levels.shape[-1])
    window = constant(_halves, dtype=levels.dtype, device=levels.device)
    rising, falling = (levels[..., : count * _HALF].unflatten(-1, (count, _HALF)) @ window).unbind(
        -1
    )
    inner = 0.5 * (rising[..., 1:-1] + falling[..., 2:])
    return torch.cat((falling[..., :1], inner, rising[..., -1:]), -1)


def _halves() -> NDArray[np.float64]:
    """The rising and the falling half of a Hann window, each of sum 1: (192, 2)."""
    window = np.hanning(SEGMENT).reshape(2, _HALF).T
    halves: NDArray[np.float64] = window / window.sum(0)
    return halves


def envelope_correlation(reference: Tensor, processed: Tensor) -> Tensor:
    """Mean magnitude of the correlation of five cosines over frequency. Shape: (32, segments) twice -> ().

    Segments that are silent in the reference are left out; 0 where no two are left.
    """
    loudness = (reference.detach() * (math.log(10.0) / 20.0)).exp().mean(0)
    kept = loudness > 10.0 ** (_SILENCE / 20.0)
    if int(kept.sum()) < 2:
        return processed.sum() * 0.0
    basis = constant(_cosines, dtype=reference.dtype, device=reference.device)
    x, y = (basis @ levels[:, kept] for levels in (reference, processed))
    x, y = (cosines - cosines.mean(-1, keepdim=True) for cosines in (x, y))
    xx, yy, xy = x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1)
    there = (xx >= _NOTHING) & (yy >= _NOTHING)
    norm = torch.where(there, xx, 1.0).sqrt() * torch.where(there, yy, 1.0).sqrt()
    return torch.where(there, xy.abs() / norm, 0.0).mean()


def _cosines() -> NDArray[np.float64]:
    place = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    return np.cos(np.arange(1, 6)[:, None] * place)


# -- motion ------------------------------------------------------------------------------------------------------------


def segment_spectra(motion: Tensor) -> tuple[Tensor, Tensor]:
    """Of windowed segments without their means, and their mean squares as of an envelope.

    Shape: (channels, time) -> (channels, segments, bins), (channels, segments).
    """
    time = motion.shape[-1]
    count = segments(time)
    fixed = partial(constant, dtype=motion.dtype, device=motion.device)
    window = fixed(_windows, count)
    padded = functional.pad(motion, (0, max(0, (count + 1) * _HALF - time)))
    parts = padded.unfold(-1, SEGMENT, _HALF)[..., :count, :] * window
    inside = fixed(_inside, count)
    means = parts.sum(-1, keepdim=True) / inside.sum(-1, keepdim=True)
    parts = torch.addcmul(parts, means, inside, value=-1.0)
    energy = parts.square().sum(-1) / window.square().sum(-1)
    return torch.fft.rfft(parts, _POINTS), 2.0 * energy


def _windows(count: int) -> NDArray[np.float64]:
    """One a segment: the first is the falling half, the last the rising half, padded. Returns (count, SEGMENT)."""
    window = np.hanning(SEGMENT)
    windows = np.tile(window, (count, 1))
    windows[0] = np.concatenate((window[_HALF:], np.zeros(_HALF)))
    windows[-1] = np.concatenate((window[:_HALF], np.zeros(_HALF)))
    return windows


def _inside(count: int) -> NDArray[np.float64]:
    inside = np.ones((count, SEGMENT))
    inside[[0, -1], _HALF:] = 0.0
    return inside


def coherence(reference: tuple[Tensor, Tensor], processed: tuple[Tensor, Tensor]) -> Tensor:
    """Largest normalised cross-covariance over lags of up to 1 ms, 0 to 1.

    Shape: ``segment_spectra`` of both -> (channels, segments).
    """
    (x, xx), (y, yy) = reference, processed
    weights = constant(_lag_weights, x.shape[-2], dtype=xx.dtype, device=xx.device)
    covariance = torch.fft.irfft(x * y.conj(), _POINTS)
    near = torch.cat((covariance[..., : _LAGS + 1], covariance[..., -_LAGS:]), -1) * weights
    there = (xx > 2.0 * _NOTHING) & (yy > 2.0 * _NOTHING)
    norm = 0.5 * torch.where(there, xx, 1.0).sqrt() * torch.where(there, yy, 1.0).sqrt()
    return torch.where(there, near.abs().amax(-1) / norm, 0.0).clamp(0.0, 1.0)


def _lag_weights(count: int) -> NDArray[np.float64]:
    """The windows' autocorrelations inverted, at lags 0 to 24 and -24 to -1: (count, 49)."""
    lags = [*range(_LAGS + 1), *range(_LAGS, 0, -1)]
    made = []
    for window in _windows(3):
        both = np.correlate(window, window, "full")[SEGMENT - 1 :]
        made.append(1.0 / both[lags])
    first, inner, last = made
    return np.stack([first, *[inner] * (count - 2), last])


def synchrony(coherences: Tensor, mean_square: Tensor) -> Tensor:
    """Mean of what lies over threshold in the reference, less where hair cells lose synchrony. Returns ().

    Shape: (32, segments) twice.

    Args:
        mean_square: of the reference's segments.
    """
    rms = mean_square.detach().sqrt()
    loud = (rms * (math.log(10.0) / 20.0)).exp().mean(0) > 10.0 ** (_SILENCE / 20.0)
    weights = constant(_synchronous, dtype=rms.dtype, device=rms.device)[:, None]
    weights = weights * ((rms > _SILENCE) & loud)
    if int(loud.sum()) < 2:
        return coherences.sum() * 0.0
    return (weights * coherences).sum() / weights.sum().clamp_min(_NOTHING)


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
