"""Features of HASPI: correlation of the envelopes of two signals, by rate of modulation.

The levels of 32 channels are smoothed and sampled 2667 times per second. Frames that are silent in
the reference are left out. Five cosines over frequency describe each frame. Ten band-passes filter
the cosines over time, and the outputs of reference and processed signal are correlated.

Source: Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech
Communication 131, 35-46.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.ear.model import CHANNELS, Extent, integers, shift
from hlsim.torchtools import constant, constant_like

STRIDE = 9
"""Samples at 24 kHz between frames."""

WINDOW_SAMPLES = 52
"""Length of the smoothing window, which ends 26 samples after its frame."""

WINDOW_STRIDES = -(-(WINDOW_SAMPLES + 2) // STRIDE)
WINDOW_LEAD = WINDOW_STRIDES * STRIDE - WINDOW_SAMPLES // 2 - 1

SILENCE_DB = 2.5
"""Level over threshold in dB that a frame of the reference must exceed to count."""

COSINES = 5

RATES = (2.0, 6.0, 10.0, 16.0, 25.0, 40.0, 64.0, 100.0, 160.0, 256.0)
"""Centre frequencies of the modulation filters in Hz."""

FRAME_RATE = 2560.0
"""Frame rate for which pyclarity designs the modulation filters. The true one is 24000 / 9."""

MAX_FILTER_SECONDS = 0.24
"""Duration of the filters up to 10 Hz. The others have as many periods as that at 10 Hz."""

NOISE_DB = 0.1
"""Standard deviation of the noise on the firing rate, in dB."""

ENERGY_FLOOR = 1e-30
"""Energies below this one count as zero."""


def smooth_frames(levels: Tensor, delays: Tensor, extent: Extent) -> Tensor:
    """Delay the levels of channels, smooth them, and sample them at 24000 / 9 Hz.

    Args:
        levels: Levels in dB over threshold. Shape: (items, channels, padded).
        delays: Delays in samples. Shape: (items, channels), int64.
        extent: Lengths of the items.

    Returns:
        Frames. Shape: (items, channels, ceil(longest / 9)).

    >>> delays = torch.zeros(1, 2, dtype=torch.int64)
    >>> smooth_frames(torch.ones(1, 2, 128), delays, Extent((128,))).shape
    torch.Size([1, 2, 15])
    """
    count = -(-extent.longest // STRIDE)
    stops = [end + WINDOW_LEAD for end in extent.ends]
    delayed = shift(
        levels, delays + WINDOW_LEAD, extent.ends, stops, STRIDE * (count + WINDOW_STRIDES - 1)
    )
    window = constant(_smoothing, dtype=levels.dtype, device=levels.device)
    parts = delayed.unflatten(-1, (-1, STRIDE)) @ window
    return sum(
        (parts[..., i : i + count, i] for i in range(1, WINDOW_STRIDES)),
        start=parts[..., :count, 0],
    )


def _smoothing() -> NDArray[np.float64]:
    """Return a Hann window without its zeros, by phase: (STRIDE, WINDOW_STRIDES)."""
    window = np.hanning(WINDOW_SAMPLES + 2)[1:-1]
    padded = np.concatenate(
        (np.zeros(WINDOW_STRIDES * STRIDE - WINDOW_SAMPLES), window / window.sum())
    )
    return padded.reshape(WINDOW_STRIDES, STRIDE).T


class ChannelSum(NamedTuple):
    """Features of frames that are sums over channels, and can be added over chunks of channels.

    Attributes:
        loudness: Mean over the channels of the amplitude over threshold. Shape: (items, frames).
        cosines: Five cosines over frequency. Shape: (items, 5, frames).

    >>> sum_over_channels(torch.zeros(1, 32, 4), slice(0, 32)).loudness
    tensor([[1., 1., 1., 1.]])
    """

    loudness: Tensor
    cosines: Tensor


def sum_over_channels(levels: Tensor, channels: slice) -> ChannelSum:
    """Sum the frames of some channels.

    Args:
        levels: Frames in dB over threshold. Shape: (items, channels, frames).
        channels: The channels.

    >>> sum_over_channels(torch.zeros(1, 8, 4), slice(0, 8)).cosines.shape
    torch.Size([1, 5, 4])
    """
    loudness = (levels.detach() * (math.log(10.0) / 20.0)).exp().sum(-2) / CHANNELS
    return ChannelSum(loudness, cosines(levels, channels))


def cosines(levels: Tensor, channels: slice = slice(None)) -> Tensor:
    """Return five cosines over frequency. Shape: (..., channels, frames) -> (..., 5, frames).

    >>> cosines(torch.ones(32, 4)).shape
    torch.Size([5, 4])
    """
    return constant(_cosines, dtype=levels.dtype, device=levels.device)[:, channels] @ levels


def add_sums(total: ChannelSum | None, part: ChannelSum) -> ChannelSum:
    """Add the sums over two chunks of channels.

    >>> part = sum_over_channels(torch.zeros(1, 16, 4), slice(0, 16))
    >>> add_sums(part, part).loudness
    tensor([[1., 1., 1., 1.]])
    """
    if total is None:
        return part
    return ChannelSum(total.loudness + part.loudness, total.cosines + part.cosines)


def find_audible_frames(loudness: Tensor, extent: Extent) -> tuple[Tensor, Extent]:
    """Find the frames in which the reference exceeds the threshold of hearing.

    The host waits for the device once.

    Args:
        loudness: Loudness of the reference. Shape: (items, frames).
        extent: Number of samples of each item.

    Returns:
        Indices of the frames of each item, followed by other indices, (items, audible), and the
        number of audible frames of each item.

    Raises:
        UnscorableError: An item has fewer than two audible frames.

    >>> indices, audible = find_audible_frames(torch.tensor([[0.0, 9.0, 9.0]]), Extent((27,)))
    >>> indices, audible.ends
    (tensor([[1, 2]]), (2,))
    """
    frames_of = Extent(tuple(-(-end // STRIDE) for end in extent.ends))
    loudness = frames_of.cut(loudness)
    audible = loudness > 10.0 ** (SILENCE_DB / 20.0)
    counts = audible.sum(-1).tolist()
    if min(counts) < 2:
        raise UnscorableError("clean is below the threshold of hearing")
    audible_extent = Extent(tuple(counts))
    indices = (~audible).byte().argsort(dim=-1, stable=True)
    return indices[:, : audible_extent.longest], audible_extent


def select_frames(waves: Tensor, indices: Tensor) -> Tensor:
    """Return the frames with the indices of each item.

    Shape: (items, 5, frames), (items, audible) -> (items, 5, audible).

    >>> select_frames(torch.tensor([[[1.0, 2.0, 3.0]]]), torch.tensor([[1, 2]]))
    tensor([[[2., 3.]]])
    """
    return waves.take_along_dim(indices[:, None], -1)


def _cosines() -> NDArray[np.float64]:
    angle = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    waves = np.cos(np.arange(1, COSINES + 1)[:, None] * angle)
    return waves / np.linalg.norm(waves, axis=1, keepdims=True)


# -- modulation filters ----------------------------------------------------------------------------


class ModulationCovariance(NamedTuple):
    """Covariances of the filtered cosines of two signals.

    Attributes:
        xx, yy, xy: Sums of squares and of products, without the means. Shape: (items, 10, 5).
        waves: zero-mean cosines before the filters. Shape: (items, 5, audible) twice.
        spectra: Spectra of these cosines. Shape: (items, 5, bins) twice.
        extent: Number of audible frames of each item.

    >>> waves = torch.randn(1, 5, 900)
    >>> modulation_covariance(waves, waves, Extent((900,))).xx.shape
    torch.Size([1, 10, 5])
    """

    xx: Tensor
    yy: Tensor
    xy: Tensor
    waves: tuple[Tensor, Tensor]
    spectra: tuple[Tensor, Tensor]
    extent: Extent


def modulation_covariance(
    reference: Tensor, processed: Tensor, extent: Extent
) -> ModulationCovariance:
    """Filter the cosines over time by ten band-passes without delay, and compute covariances.

    Args:
        reference, processed: Cosines of the audible frames. Shape: (items, 5, audible).
        extent: Number of audible frames of each item.

    >>> waves = torch.randn(1, 5, 900)
    >>> modulation_covariance(waves, waves, Extent((900,))).xy.shape
    torch.Size([1, 10, 5])
    """
    frames, points = extent.longest, _points(extent.longest)
    waves = extent.centred(reference), extent.centred(processed)
    a, b = (torch.fft.rfft(wave, points) for wave in waves)
    responses = constant(_responses, points, dtype=reference.dtype, device=reference.device)
    filters_at_once = 1 if reference.device.type == "cpu" else len(responses)
    sums = []
    for part in responses.split(filters_at_once):
        x, y = (
            extent.centred(torch.fft.irfft(spectrum[:, None] * part[:, None], points)[..., :frames])
            for spectrum in (a, b)
        )
        sums.append(torch.stack((x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1))))
    xx, yy, xy = torch.cat(sums, 2)
    return ModulationCovariance(xx, yy, xy, waves, (a, b), extent)


def _points(frames: int) -> int:
    return fft_length(frames + len(_filters()[0]) // 2, 256)


def _filters() -> list[NDArray[np.float64]]:
    """Return a Hann-windowed cosine for each rate, symmetric about the middle."""
    filters = []
    for k, rate in enumerate(RATES):
        seconds = MAX_FILTER_SECONDS if k < 2 else MAX_FILTER_SECONDS * RATES[2] / rate
        half = math.floor(seconds * FRAME_RATE / 2)
        window = np.hanning(2 * half + 1)
        window /= window.sum()
        if k:
            window *= 2.0 * np.cos(2.0 * np.pi * rate / FRAME_RATE * np.arange(-half, half + 1))
        filters.append(window)
    return filters


def _responses(points: int) -> NDArray[np.float64]:
    """Return the frequency responses of the modulation filters: (10, points // 2 + 1)."""
    return zero_phase_responses(_filters(), points)


def zero_phase_responses(
    filters: Sequence[NDArray[np.float64]], points: int
) -> NDArray[np.float64]:
    """Return the frequency responses of symmetric filters without their delay, which are real.

    Args:
        filters: Taps of each filter, an odd number, symmetric about the middle one.
        points: Length of the Fourier transform.

    Returns:
        Responses of the filters. Shape: (filters, points // 2 + 1).

    >>> zero_phase_responses([np.array([0.25, 0.5, 0.25])], 4)
    array([[1. , 0.5, 0. ]])
    """
    centred = np.zeros((len(filters), points))
    for row, taps in zip(centred, filters, strict=True):
        row[: len(taps)] = taps
        row[:] = np.roll(row, -(len(taps) // 2))
    return np.fft.rfft(centred).real


# -- correlation -----------------------------------------------------------------------------------


def correlation(covariance: ModulationCovariance) -> Tensor:
    """Compute the correlation of clean and processed envelopes at each rate of modulation.

    Its magnitude is averaged over the cepstral coefficients, which are the projections of the
    spectrum on cosines. A coefficient that is constant over time counts as 0.

    Returns:
        Correlations. Shape: (items, 10).

    >>> waves = torch.randn(1, 5, 900)
    >>> correlation(modulation_covariance(waves, waves, Extent((900,)))).round(decimals=4)[0, :3]
    tensor([1., 1., 1.])
    """
    xx, yy, xy = covariance.xx, covariance.yy, covariance.xy
    is_varying = (xx >= ENERGY_FLOOR) & (yy >= ENERGY_FLOOR)
    norm = torch.where(is_varying, xx, 1.0).sqrt() * torch.where(is_varying, yy, 1.0).sqrt()
    return torch.where(is_varying, xy.abs() / norm, 0.0).mean(-1)


def expected_correlation(covariance: ModulationCovariance) -> Tensor:
    """Return the mean of ``correlation`` over the noise of the hair cells, without drawing noise.

    The noise increases the energies by which the covariance is divided. Its contribution to the
    covariance itself has mean zero. The mean and the variance of the quotient are computed to
    second order. The mean of its magnitude is that of a folded normal distribution.

    Returns:
        Correlations. Shape: (items, 10).

    >>> waves = torch.randn(1, 5, 900)
    >>> expected_correlation(modulation_covariance(waves, waves, Extent((900,)))).shape
    torch.Size([1, 10])
    """
    variance = NOISE_DB**2
    noise = variance * _noise_energies(covariance)
    xx, yy, xy = covariance.xx + noise, covariance.yy + noise, covariance.xy
    xx2, yy2, xy2, noise2 = _energies_filtered_twice(covariance)
    noise2 = variance**2 * noise2
    spread_x = (4.0 * variance * xx2 + 2.0 * noise2) / xx.square()
    spread_y = (4.0 * variance * yy2 + 2.0 * noise2) / yy.square()
    norm = xx.sqrt() * yy.sqrt()
    both = 2.0 * variance * xy2 / norm
    quotient = xy / norm
    mean = quotient * (1.0 + 0.375 * (spread_x + spread_y)) - 0.5 * both * (1.0 / xx + 1.0 / yy)
    product = (variance * (xx2 + yy2) + noise2) / norm.square()
    spread = (
        product
        + 0.25 * quotient.square() * (spread_x + spread_y)
        - quotient * both * (1.0 / xx + 1.0 / yy)
    )
    spread = spread.clamp_min(1e-12)
    folded = (2.0 / math.pi * spread).sqrt() * torch.exp(-0.5 * mean.square() / spread)
    return (folded + mean * torch.erf(mean / (2.0 * spread).sqrt())).mean(-1)


def _noise_energies(covariance: ModulationCovariance) -> Tensor:
    """Return ``_noise_energy`` of each item. Shape: -> (items, 10, 1)."""
    rows = [_noise_energy(frames) for frames in covariance.extent.ends]
    energies = torch.from_numpy(np.stack(rows))
    device = covariance.xy.device
    energies = energies.to(device, covariance.xy.dtype, non_blocking=device.type != "cpu")
    return energies.unsqueeze(-1)


def _energies_filtered_twice(
    covariance: ModulationCovariance,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the energies of cosines and of white noise after filtering them twice.

    They determine the covariance of the cosines with noise that passed the same filter. The filters
    are circular, therefore each item is transformed with as many points as it is alone.

    Returns:
        Energies xx, yy and xy of the cosines, (items, 10, 5), and of noise, (items, 10, 1).
    """
    ends = covariance.extent.ends
    if len({_points(frames) for frames in ends}) == 1:
        return _filter_twice(*covariance.spectra, ends)
    parts = []
    for item, frames in enumerate(ends):
        waves = (wave[item, None, :, :frames] for wave in covariance.waves)
        x, y = (torch.fft.rfft(wave, _points(frames)) for wave in waves)
        parts.append(_filter_twice(x, y, (frames,)))
    xx, yy, xy, noise = (torch.cat(tensors) for tensors in zip(*parts, strict=True))
    return xx, yy, xy, noise


def _filter_twice(
    reference: Tensor, processed: Tensor, ends: tuple[int, ...]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return ``_energies_filtered_twice`` from spectra of the length of every item."""
    x, y = torch.view_as_real(reference), torch.view_as_real(processed)
    weights = constant_like(x, _twice_filtered, _points(max(ends)))
    xx, yy, xy = (weights @ product.sum(-1).mT for product in (x.square(), y.square(), x * y))
    counts = integers(ends, weights.device).to(weights)
    noise = counts[:, None, None] * weights.sum(-1, keepdim=True)
    return xx, yy, xy, noise


@lru_cache(maxsize=1024)
def _noise_energy(frames: int) -> NDArray[np.float64]:
    """Return the energy of the filters' zero-mean outputs for zero-mean white noise of variance 1.

    Returns: (10,).
    """
    energies = []
    for taps in _filters():
        half = min(len(taps) // 2, frames - 1)
        lags = np.arange(-half, half + 1)
        taps = taps[len(taps) // 2 + lags]
        sums = np.concatenate(([0.0], np.cumsum(taps)))
        ends = np.arange(half, half + frames) + 1
        # the response to a constant
        steady = sums[np.minimum(ends, len(taps))] - sums[np.maximum(ends - frames, 0)]
        energy = (taps**2 * (frames - np.abs(lags))).sum()
        energies.append(energy - (steady**2).mean() - steady.var())
    return np.array(energies)


def _twice_filtered(points: int) -> NDArray[np.float64]:
    """Return the weights of squared spectra in the energy after filtering twice: (10, bins)."""
    sides = np.full(points // 2 + 1, 2.0)
    sides[[0, -1]] = 1.0
    return _responses(points) ** 4 * sides / points
