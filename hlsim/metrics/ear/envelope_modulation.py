"""How the envelopes of two signals agree, by rate of modulation: HASPI's features.

Kates and Arehart 2021, "The hearing-aid speech perception index (HASPI) version 2", Speech Communication 131, 35-46. The
levels of 32 channels are smoothed and taken 2667 times a second, freed of what is silent in the reference, and summed up
in five cosines over frequency; ten band-passes of the cosines' course in time, reference and processed, are correlated.
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
from torch.nn import functional

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.clean_speech import UnscorableError
from hlsim.metrics.ear.model import CHANNELS, Extent, integers, shift
from hlsim.torchtools import constant

STRIDE = 9
"""Samples at 24 kHz from one frame to the next."""

_TAPS = 52  # of the smoothing window, which ends 26 samples after its frame
_SPAN = -(-(_TAPS + 2) // STRIDE)
_LEAD = _SPAN * STRIDE - _TAPS // 2 - 1

_SILENCE = 2.5  # dB over threshold that the reference's frames are to exceed
_COSINES = 5

RATES = (2.0, 6.0, 10.0, 16.0, 25.0, 40.0, 64.0, 100.0, 160.0, 256.0)
"""Centres of the modulation filters in Hz."""

_FRAME_RATE = 2560.0  # what the modulation filters take 24000 / 9 for
_LONGEST = 0.24  # seconds of the filters up to 10 Hz; others have the same number of periods

NOISE_DB = 0.1
"""Standard deviation of the noise on the firing rate, in dB."""

_NOTHING = 1e-30


def frames(levels: Tensor, delays: Tensor, extent: Extent) -> Tensor:
    """Smoothed levels of channels at 24000 / 9 Hz, delayed to match.

    Shape: (items, channels, padded), (items, channels) samples -> (items, channels, ceil(longest / 9)).
    """
    count = -(-extent.longest // STRIDE)
    stops = [end + _LEAD for end in extent.ends]
    late = shift(levels, delays + _LEAD, extent.ends, stops, STRIDE * (count + _SPAN - 1))
    window = constant(_smoothing, dtype=levels.dtype, device=levels.device)
    parts = late.unflatten(-1, (-1, STRIDE)) @ window
    return sum((parts[..., i : i + count, i] for i in range(1, _SPAN)), start=parts[..., :count, 0])


def _smoothing() -> NDArray[np.float64]:
    """A Hann window without its zeros, by phase: (STRIDE, _SPAN)."""
    window = np.hanning(_TAPS + 2)[1:-1]
    padded = np.concatenate((np.zeros(_SPAN * STRIDE - _TAPS), window / window.sum()))
    return padded.reshape(_SPAN, STRIDE).T


class Course(NamedTuple):
    """What is made of frames over the channels; that of all channels is the sum over some at a time.

    Attributes:
        loudness: mean over the channels of the amplitude over threshold. Shape: (items, frames).
        cosines: five cosines over frequency. Shape: (items, 5, frames).
    """

    loudness: Tensor
    cosines: Tensor


def course(levels: Tensor, channels: slice) -> Course:
    """Of the frames of some channels. Shape: (items, channels, frames)."""
    loudness = (levels.detach() * (math.log(10.0) / 20.0)).exp().sum(-2) / CHANNELS
    return Course(loudness, cosines(levels, channels))


def cosines(levels: Tensor, channels: slice = slice(None)) -> Tensor:
    """Five cosines over frequency. Shape: (..., channels, frames) -> (..., 5, frames)."""
    return constant(_cosines, dtype=levels.dtype, device=levels.device)[:, channels] @ levels


def added(sum_so_far: Course | None, part: Course) -> Course:
    """The sum over chunks of channels."""
    if sum_so_far is None:
        return part
    return Course(sum_so_far.loudness + part.loudness, sum_so_far.cosines + part.cosines)


def joined(parts: Sequence[Course]) -> Course:
    """Join the courses of several groups of items. Those that are shorter end in zeros."""
    if len(parts) == 1:
        return parts[0]
    longest = max(part.loudness.shape[-1] for part in parts)
    return Course(*(_padded_and_joined(tensors, longest) for tensors in zip(*parts, strict=True)))


def _padded_and_joined(tensors: Sequence[Tensor], longest: int) -> Tensor:
    return torch.cat([functional.pad(one, (0, longest - one.shape[-1])) for one in tensors])


def audible_frames(loudness: Tensor, extent: Extent) -> tuple[Tensor, Extent]:
    """Choose the frames that count: those in which the reference exceeds the threshold of hearing.

    The host waits for the device once.

    Args:
        loudness: ``Course.loudness`` of the reference. Shape: (items, frames).
        extent: samples of each item.

    Returns: places of the frames of each item, followed by other places, (items, kept), and how many there are of each.

    Raises:
        UnscorableError: an item has none or one.
    """
    frames_of = Extent(tuple(-(-end // STRIDE) for end in extent.ends))
    loudness = frames_of.cut(loudness)
    audible = loudness > 10.0 ** (_SILENCE / 20.0)
    counts = audible.sum(-1).tolist()
    if min(counts) < 2:
        raise UnscorableError("clean is below the threshold of hearing")
    kept = Extent(tuple(counts))
    places = (~audible).byte().argsort(dim=-1, stable=True)
    return places[:, : kept.longest], kept


def chosen_frames(waves: Tensor, places: Tensor) -> Tensor:
    """Return the frames at the places of each item. Shape: (items, 5, frames), (items, kept) -> (items, 5, kept)."""
    return waves.take_along_dim(places[:, None], -1)


def _cosines() -> NDArray[np.float64]:
    place = np.pi * np.arange(CHANNELS) / (CHANNELS - 1)
    waves = np.cos(np.arange(1, _COSINES + 1)[:, None] * place)
    return waves / np.linalg.norm(waves, axis=1, keepdims=True)


# -- modulation filters ------------------------------------------------------------------------------------------------


class Agreement(NamedTuple):
    """How the filtered cosines of two signals correspond.

    Attributes:
        xx, yy, xy: energies of both and of their product, without the means. Shape: (items, 10, 5).
        waves: the cosines without their means, before the filters. Shape: (items, 5, kept) twice.
        spectra: spectra of these. Shape: (items, 5, bins) twice.
        extent: frames of each item.
    """

    xx: Tensor
    yy: Tensor
    xy: Tensor
    waves: tuple[Tensor, Tensor]
    spectra: tuple[Tensor, Tensor]
    extent: Extent


def agreement(reference: Tensor, processed: Tensor, extent: Extent) -> Agreement:
    """Filter the course of the cosines in time by ten band-passes without delay, and compare.

    Shape: (items, 5, kept) twice.
    """
    kept, points = extent.longest, _points(extent.longest)
    waves = extent.centred(reference), extent.centred(processed)
    a, b = (torch.fft.rfft(one, points) for one in waves)
    responses = constant(_responses, points, dtype=reference.dtype, device=reference.device)
    together = 1 if reference.device.type == "cpu" else len(responses)
    sums = []
    for part in responses.split(together):
        x, y = (
            extent.centred(torch.fft.irfft(spectrum[:, None] * part[:, None], points)[..., :kept])
            for spectrum in (a, b)
        )
        sums.append(torch.stack((x.square().sum(-1), y.square().sum(-1), (x * y).sum(-1))))
    xx, yy, xy = torch.cat(sums, 2)
    return Agreement(xx, yy, xy, waves, (a, b), extent)


def _points(kept: int) -> int:
    return fft_length(kept + len(_filters()[0]) // 2, 256)


def _filters() -> list[NDArray[np.float64]]:
    """A Hann window on a cosine for each rate, symmetric about the middle."""
    filters = []
    for k, rate in enumerate(RATES):
        seconds = _LONGEST if k < 2 else _LONGEST * RATES[2] / rate
        half = math.floor(seconds * _FRAME_RATE / 2)
        window = np.hanning(2 * half + 1)
        window /= window.sum()
        if k:
            window *= 2.0 * np.cos(2.0 * np.pi * rate / _FRAME_RATE * np.arange(-half, half + 1))
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
        filters: taps of each filter, an odd number, symmetric about the middle one.
        points: length of the Fourier transform.

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


# -- correlation -------------------------------------------------------------------------------------------------------


def correlation(found: Agreement) -> Tensor:
    """Magnitude of the correlation by rate, mean over the cosines; 0 where one of them is constant.

    Returns: (items, 10).
    """
    there = (found.xx >= _NOTHING) & (found.yy >= _NOTHING)
    norm = torch.where(there, found.xx, 1.0).sqrt() * torch.where(there, found.yy, 1.0).sqrt()
    return torch.where(there, found.xy.abs() / norm, 0.0).mean(-1)


def expected_correlation(found: Agreement) -> Tensor:
    """Mean of ``correlation`` over the noise that the hair cells add to both, without drawing it.

    The noise adds to the energies that the correlation is divided by, and what it adds to the product is as often
    negative: the mean and the variance of the quotient are taken to second order, and that of a magnitude is the folded
    normal distribution's mean.

    Returns: (items, 10).
    """
    variance = NOISE_DB**2
    noise = variance * _noise_energies(found)
    xx, yy, xy = found.xx + noise, found.yy + noise, found.xy
    xx2, yy2, xy2, own = _energies_filtered_twice(found)
    own = variance**2 * own
    spread_x = (4.0 * variance * xx2 + 2.0 * own) / xx.square()
    spread_y = (4.0 * variance * yy2 + 2.0 * own) / yy.square()
    norm = xx.sqrt() * yy.sqrt()
    both = 2.0 * variance * xy2 / norm
    plain = xy / norm
    mean = plain * (1.0 + 0.375 * (spread_x + spread_y)) - 0.5 * both * (1.0 / xx + 1.0 / yy)
    product = (variance * (xx2 + yy2) + own) / norm.square()
    spread = (
        product
        + 0.25 * plain.square() * (spread_x + spread_y)
        - plain * both * (1.0 / xx + 1.0 / yy)
    )
    spread = spread.clamp_min(1e-12)
    folded = (2.0 / math.pi * spread).sqrt() * torch.exp(-0.5 * mean.square() / spread)
    return (folded + mean * torch.erf(mean / (2.0 * spread).sqrt())).mean(-1)


def _noise_energies(found: Agreement) -> Tensor:
    """``_noise_energy`` of each item. Shape: -> (items, 10, 1)."""
    energies = torch.from_numpy(np.stack([_noise_energy(kept) for kept in found.extent.ends]))
    device = found.xy.device
    energies = energies.to(device, found.xy.dtype, non_blocking=device.type != "cpu")
    return energies.unsqueeze(-1)


def _energies_filtered_twice(found: Agreement) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Energies of the filtered cosines filtered again, and of white noise.

    They say how far noise of the filters' colour goes along with the cosines. The filters are circular, so that an item
    is transformed with as many points as it is alone.

    Returns: xx, yy and xy, (items, 10, 5), and that of noise, (items, 10, 1).
    """
    device = found.xy.device
    members: dict[int, list[int]] = {}
    for item, kept in enumerate(found.extent.ends):
        members.setdefault(_points(kept), []).append(item)
    parts: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for points, items in members.items():
        a, b = found.spectra
        if len(members) > 1:
            chosen = integers(tuple(items), device)
            kept = max(found.extent.ends[item] for item in items)
            a, b = (
                torch.fft.rfft(one.index_select(0, chosen)[..., :kept], points)
                for one in found.waves
            )
        weights = constant(_twice_filtered, points, dtype=found.xy.dtype, device=device)
        x, y = torch.view_as_real(a), torch.view_as_real(b)
        xx, yy, xy = (weights @ product.sum(-1).mT for product in (x.square(), y.square(), x * y))
        counts = integers(tuple(found.extent.ends[item] for item in items), device)
        own = counts.to(weights)[:, None, None] * weights.sum(-1, keepdim=True)
        parts.append((xx, yy, xy, own))
    if len(parts) == 1:
        return parts[0]
    order = [item for items in members.values() for item in items]
    back = integers(tuple(sorted(range(len(order)), key=order.__getitem__)), device)
    xx, yy, xy, own = (
        torch.cat(tensors).index_select(0, back) for tensors in zip(*parts, strict=True)
    )
    return xx, yy, xy, own


@lru_cache(maxsize=1024)
def _noise_energy(kept: int) -> NDArray[np.float64]:
    """Energy of each filter's output for white noise of variance 1, both without their means. Returns (10,)."""
    energies = []
    for taps in _filters():
        half = min(len(taps) // 2, kept - 1)
        lags = np.arange(-half, half + 1)
        taps = taps[len(taps) // 2 + lags]
        sums, place = np.concatenate(([0.0], np.cumsum(taps))), np.arange(half, half + kept)
        # a constant, filtered
        steady = sums[np.minimum(place + 1, len(taps))] - sums[np.maximum(place + 1 - kept, 0)]
        energy = (taps**2 * (kept - np.abs(lags))).sum()
        energies.append(energy - (steady**2).mean() - steady.var())
    return np.array(energies)


def _twice_filtered(points: int) -> NDArray[np.float64]:
    """Weights of a half spectrum's squares in the energy of what was filtered twice: (10, points // 2 + 1)."""
    sides = np.full(points // 2 + 1, 2.0)
    sides[[0, -1]] = 1.0
    return _responses(points) ** 4 * sides / points
