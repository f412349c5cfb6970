"""Features of HASQI and HAAQI, which show the changes of a sound by an aid besides its level.

Both scores compare the output of an aid with clean speech or music by:

- the *envelopes*: levels of the ear's 32 channels, smoothed over 16 or 8 ms. Five numbers describe
  the shape of the spectrum at a time, the *cepstrum*: projections on cosines over the channels.
- the *fine structure*: the motion of the basilar membrane within segments of 16 ms, which shows
  whether the fast vibrations are the same.
- the long-term spectra: the level of each channel over the whole signal.

Segments overlap by half; the first and the last one are half as long. All signals are at 24 kHz.

Source: Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio
Eng. Soc. 62(3), 99-117.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.metrics.ear.envelope_modulation import (
    ENERGY_FLOOR,
    SILENCE_DB,
    cosines,
    move_to_front,
    normalised_covariance,
)
from hlsim.metrics.ear.extent import Extent, integers
from hlsim.metrics.ear.model import CHANNELS, centre_frequencies
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

SEGMENT = 384
"""Number of samples of a segment of the fine structure, 16 ms at 24 kHz."""

HALF_SEGMENT = SEGMENT // 2
"""Samples between the starts of neighbouring segments."""

MAX_LAG = RATE // 1000
"""Largest delay in samples between the fine structures of two signals, 1 ms in each direction."""

FFT_POINTS = 432
"""Points of the Fourier transform of a segment, enough for correlations at delays of up to 1 ms."""

SYNCHRONY_HZ = 3500.0
"""Frequency above which hair cells lose synchrony (Johnson 1980)."""

SYNCHRONY_ORDER = 5
"""Order of the low-pass that describes the loss of synchrony."""

NEPERS_PER_DB = math.log(10.0) / 20.0
"""Factor from a level in dB to the natural logarithm of an amplitude."""


def segments_of(extent: Extent, segment: int = SEGMENT) -> Extent:
    """Compute the number of segments of each item.

    Segments overlap by half. The first and the last one are half as long.

    Args:
        extent: Number of samples of each item before padding.
        segment: Length of a segment in samples, an even number.

    >>> segments_of(Extent((1000, 800))).ends
    (5, 4)
    """
    return Extent(
        tuple(1 + end // segment + (end - segment // 2) // segment for end in extent.ends)
    )


# -- envelopes -------------------------------------------------------------------------------------


def smooth_levels(levels: Tensor, extent: Extent, segment: int = SEGMENT) -> Tensor:
    """Smooth the levels of channels by the Hann-weighted mean of each segment.

    Neighbouring segments overlap by half. The first and the last one are half as long.

    Args:
        levels: Levels in dB at 24 kHz. Shape: (items, channels, time), where items are padded to
            the length of the longest one.
        extent: Number of samples of each item before padding.
        segment: Length of a segment in samples, an even number.

    Returns:
        Means in dB, 0 after the last segment of an item. Shape: (items, channels, segments).

    >>> smooth_levels(torch.ones(1, 2, 1000), Extent((1000,))).shape
    torch.Size([1, 2, 5])
    """
    counts = segments_of(extent, segment)
    half = segment // 2
    window = _half_windows(segment, like=levels)
    # Each half belongs to two segments, the end of one and the start of the next. Both weighted
    # sums come from one product, so that no sample is copied.
    halves = levels[..., : counts.longest * half].unflatten(-1, (counts.longest, half))
    rising, falling = (halves @ window).unbind(-1)
    inner = 0.5 * (rising[..., 1:-1] + falling[..., 2:])
    means = torch.cat((falling[..., :1], inner, rising[..., -1:]), -1)
    is_last = _segment_kinds(counts, levels.device)[:, None] == _LAST
    return counts.cut(torch.where(is_last, rising, means))


@constant
def _half_windows(segment: int) -> NDArray[np.float64]:
    """Return the rising and the falling half of a Hann window, each scaled to the sum 1.

    Shape: (segment / 2, 2).
    """
    window = np.hanning(segment).reshape(2, segment // 2).T
    return window / window.sum(0)


def envelope_correlation(
    clean: Tensor,
    output: Tensor,
    counts: Extent,
    split_by_rate: Callable[[Tensor], Tensor] | None = None,
) -> Tensor:
    """Compute how well the fluctuations of an output's spectrum follow those of the clean signal.

    Five cepstral coefficients describe the shape of the spectrum in each segment. Each coefficient
    of the output is correlated over time with that of the clean signal; the result is the mean
    magnitude of these correlations. Only segments that are audible in the clean signal count. If
    there are fewer than two, the value is 0. The function synchronises with a GPU once.

    Args:
        clean, output: Levels of the clean signal and of the output by ``smooth_levels``.
            Shape: (items, 32, segments).
        counts: Number of segments of each item.
        split_by_rate: Function that divides the fluctuations of the coefficients into bands of
            modulation, which are correlated separately. Shape: (items, 5, time) -> (items, bands,
            5, time or more). None correlates the coefficients as they are.

    Returns:
        Mean correlation of each item, 0 to 1. Shape: (items,).

    >>> levels = 40.0 + torch.randn(1, 32, 5)
    >>> envelope_correlation(levels, 2.0 * levels, Extent((5,))).round(decimals=4)
    tensor([1.])
    """
    # Silence between audible segments does not count; the rest of a shorter item is cut by
    # ``extent``.
    order, audible = move_to_front(_audible_segments(clean, counts))
    extent = Extent(tuple(max(1, count) for count in audible))
    order = order[:, None, : extent.longest]
    basis = cosines(like=clean)
    waves = []
    for levels in (clean, output):
        wave = extent.centred(basis @ levels.take_along_dim(order, -1))
        if split_by_rate is not None:
            wave = extent.centred(split_by_rate(wave))
        waves.append(wave)
    x, y = waves
    correlations = normalised_covariance(
        x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1)
    ).flatten(1)
    return torch.where(integers(audible, x.device) < 2, 0.0, correlations.mean(-1))


def _audible_segments(levels: Tensor, counts: Extent) -> Tensor:
    """Mark the segments whose mean amplitude over the channels is above ``SILENCE_DB``.

    Args:
        levels: Levels in dB over threshold. Shape: (items, 32, segments).
        counts: Number of segments of each item.

    Returns:
        True for audible segments, False for others and for padding. Shape: (items, segments).
    """
    loudness = (levels.detach() * NEPERS_PER_DB).exp().mean(1)
    return counts.inside(levels.device) & (loudness > 10.0 ** (SILENCE_DB / 20.0))


# -- fine structure --------------------------------------------------------------------------------


_FIRST, _INNER, _LAST = 0, 1, 2
"""Kinds of segments. The first and the last segment are half as long as the inner ones."""


def _segment_kinds(counts: Extent, device: torch.device) -> Tensor:
    """Return the kind of each segment, ``_FIRST``, ``_INNER`` or ``_LAST``.

    The only segment of an item is the last one, and padding counts as inner segments.

    Args:
        counts: Number of segments of each item.
        device: Device of the result.

    Returns: Kinds, int64, (items, segments).
    """
    indices = torch.arange(counts.longest, device=device)
    is_last = indices == integers(counts.ends, device)[:, None] - 1
    return torch.where(is_last, _LAST, (indices > 0).long())


def segment_spectra(motion: Tensor, extent: Extent) -> tuple[Tensor, Tensor]:
    """Compute the spectrum and the energy of each segment of the fine structure.

    Segments of 16 ms are windowed, and their means are subtracted.

    Args:
        motion: Motion of the basilar membrane, zero after the end of each item. Shape: (items,
            channels, longest).
        extent: Number of samples of each item before padding.

    Returns:
        Complex spectra, (items, channels, segments, frequencies), and mean squares of the envelope,
        which are twice those of the motion, (items, channels, segments).

    >>> spectra, energy = segment_spectra(torch.randn(1, 2, 1000), Extent((1000,)))
    >>> spectra.shape, energy.shape
    (torch.Size([1, 2, 5, 217]), torch.Size([1, 2, 5]))
    """
    counts = segments_of(extent)
    kinds = _segment_kinds(counts, motion.device)
    window = _windows(like=motion)[kinds][:, None]
    inside = _inside(like=motion)[kinds][:, None]
    missing = (counts.longest + 1) * HALF_SEGMENT - motion.shape[-1]
    padded = functional.pad(motion, (0, max(0, missing)))
    segments = padded.unfold(-1, SEGMENT, HALF_SEGMENT)[..., : counts.longest, :] * window
    means = segments.sum(-1, keepdim=True) / inside.sum(-1, keepdim=True)
    segments = torch.addcmul(segments, means, inside, value=-1.0)
    energy = segments.square().sum(-1) / window.square().sum(-1)
    return torch.fft.rfft(segments, FFT_POINTS), counts.cut(2.0 * energy)


@constant
def _windows() -> NDArray[np.float64]:
    """Return the Hann window of each kind of segment. Shape: (3, SEGMENT).

    The first segment has the falling half of a window, the last one the rising half; both are
    zero-padded.
    """
    window = np.hanning(SEGMENT)
    return np.stack((np.roll(window, HALF_SEGMENT), window, window)) * _inside()


@constant
def _inside() -> NDArray[np.float64]:
    """Return 1 for the samples of each kind of segment, 0 for its padding. Shape: (3, SEGMENT)."""
    inside = np.ones((3, SEGMENT))
    inside[[_FIRST, _LAST], HALF_SEGMENT:] = 0.0
    return inside


def coherence(
    clean: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor], counts: Extent
) -> Tensor:
    """Compute how similar the fine structures of two signals are in each segment of 16 ms.

    The similarity is the largest magnitude of the normalised cross-covariance at delays of up to
    1 ms. It is 0 where one of the signals is constant.

    Args:
        clean, output: Spectra and mean squares of both signals by ``segment_spectra``.
        counts: Number of segments of each item.

    Returns:
        Coherence from 0 to 1. Shape: (items, channels, segments).

    >>> spectra = segment_spectra(torch.randn(1, 2, 1000), Extent((1000,)))
    >>> float(coherence(spectra, spectra, Extent((5,))).min()) > 0.99
    True
    """
    (x, xx), (y, yy) = clean, output
    kinds = _segment_kinds(counts, xx.device)
    weights = _lag_weights(like=xx)[kinds][:, None]
    # A matrix product computes a ninth of the inverse Fourier transform faster than all of it.
    near = torch.view_as_real(x * y.conj()).flatten(-2) @ _inverse_transform(like=xx) * weights
    is_moving = (xx > 2.0 * ENERGY_FLOOR) & (yy > 2.0 * ENERGY_FLOOR)
    norm = 0.5 * torch.where(is_moving, xx, 1.0).sqrt() * torch.where(is_moving, yy, 1.0).sqrt()
    return torch.where(is_moving, near.abs().amax(-1) / norm, 0.0).clamp(0.0, 1.0)


_LAGS = (*range(MAX_LAG + 1), *range(-MAX_LAG, 0))
"""Lags in samples at which segments are compared."""


@constant
def _inverse_transform() -> NDArray[np.float64]:
    """Return the inverse Fourier transform at ``_LAGS``, from real and imaginary parts in turn.

    Shape: (2 * frequencies, 49).
    """
    frequencies = np.arange(FFT_POINTS // 2 + 1)
    sides = np.where((frequencies == 0) | (frequencies == FFT_POINTS // 2), 1.0, 2.0)
    angles = 2.0 * np.pi / FFT_POINTS * np.outer(frequencies, _LAGS)
    waves = np.stack((np.cos(angles), -np.sin(angles)), 1) * sides[:, None, None] / FFT_POINTS
    return waves.reshape(-1, len(_LAGS))


@constant
def _lag_weights() -> NDArray[np.float64]:
    """Return weights that compensate for the smaller overlap of two windowed segments at each lag.

    A weight is 1 over the autocorrelation of the window. The rows are the kinds of segments; the
    columns are lags of 0 to 24, then -24 to -1 samples. Shape: (3, 49).
    """
    autocorrelations = np.stack([np.correlate(window, window, "full") for window in _windows()])
    return 1.0 / autocorrelations[:, SEGMENT - 1 + np.abs(_LAGS)]


def synchrony(coherences: Tensor, mean_square: Tensor, counts: Extent) -> Tensor:
    """Compute the mean coherence of all segments and channels in which the clean signal is audible.

    A segment is audible if its mean amplitude over the channels is above ``SILENCE_DB``, and those
    of its channels count whose own level is, too. Channels above 3.5 kHz count less, because the
    nerve no longer follows each vibration. Items with fewer than two audible segments have the
    value 0.

    Args:
        coherences: Values by ``coherence``. Shape: (items, 32, segments).
        mean_square: Mean squares of the clean signal's segments by ``segment_spectra``, of motion
            whose envelope is a level: their roots are levels in dB over threshold. Shape: (items,
            32, segments).
        counts: Number of segments of each item.

    Returns:
        Mean of each item, 0 to 1. Shape: (items,).

    >>> mean_square = torch.full((1, 32, 5), 40.0) ** 2
    >>> synchrony(torch.full((1, 32, 5), 0.5), mean_square, Extent((5,)))
    tensor([0.5000])
    """
    rms = mean_square.detach().sqrt()  # a level in dB, because the envelope of the motion is one
    is_audible = _audible_segments(rms, counts)
    weights = _synchrony_weights(like=rms)[:, None]
    weights = weights * ((rms > SILENCE_DB) & is_audible[:, None])
    total = (weights * coherences).sum((-2, -1))
    mean = total / weights.sum((-2, -1)).clamp_min(ENERGY_FLOOR)
    return torch.where(is_audible.sum(-1) < 2, 0.0, mean)


@constant
def _synchrony_weights() -> NDArray[np.float64]:
    """Return the weight of each channel by the synchrony of its nerve fibres, 0 to 1, (32,)."""
    ratio = (centre_frequencies() / SYNCHRONY_HZ) ** (2 * SYNCHRONY_ORDER)
    return 1.0 / np.sqrt(1.0 + ratio)


# -- long-term spectra -----------------------------------------------------------------------------


def channel_shares(levels: Tensor) -> Tensor:
    """Return the share of each channel in the sum of the amplitudes, 10^(level / 20), of all.

    Args:
        levels: Level of each channel in dB over threshold. Shape: (..., channels).

    Returns:
        Shares, whose sum is 1. Shape: (..., channels).

    >>> channel_shares(torch.tensor([20.0, 20.0]))
    tensor([0.5000, 0.5000])
    """
    amplitude = torch.exp(levels * NEPERS_PER_DB)
    return amplitude / amplitude.sum(-1, keepdim=True)


def spectral_similarity(differences: Tensor, scale: float) -> Tensor:
    """Compute the similarity of two long-term spectra from their differences.

    The similarity is 1 - 32 s / scale, but at least 0, where s is the standard deviation of the
    differences over the channels.

    Args:
        differences: One spectrum minus the other. Shape: (..., channels).
        scale: Value of 32 s from which on the similarity is 0.

    Returns:
        Similarity from 0 to 1. Shape: (...).

    >>> spectral_similarity(torch.zeros(32), 2.5)
    tensor(1.)
    """
    variance = differences.var(-1, correction=0)
    is_positive = variance > 0.0  # the square root of 0 has no gradient
    deviation = torch.where(is_positive, torch.where(is_positive, variance, 1.0).sqrt(), 0.0)
    return (1.0 - CHANNELS * deviation / scale).clamp(0.0, 1.0)
