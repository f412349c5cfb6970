"""Kates' model of the auditory periphery, stage by stage, for HASPI and HASQI: normal and impaired ears in one.

Kates 2013, "An auditory model for intelligibility and quality predictions", Proceedings of Meetings on Acoustics 19,
050184; constants as in pyclarity 0.9.0, whose ear this equals. The stages of one channel:

    control gammatone (as wide as with a loss of 100 dB)  ->  bandwidth of the channel, gain of the outer hair cells
    gammatone of that bandwidth  ->  power times gain  ->  aligned with the reference  ->  dB over the threshold
    ->  inner hair cells' adaptation

Signals are in multiples of 20 uPa, so that amplitude 1 is 0 dB SPL, and as long as a whole number of blocks; what follows
their ends is ignored. Channels lie in the second dimension from the last and are taken a few at a time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.recursions import (
    BLOCK,
    RATE,
    Recursion,
    adaptation,
    gain_lowpass,
    gammatone,
    kept,
)
from hlsim.torchtools import constant

CHANNELS = 32
_LOWEST_HZ, _HIGHEST_HZ = 80.0, 8000.0
_EAR_Q, _LEAST_ERB = 9.26449, 24.7  # Moore and Glasberg 1983

AUDIOMETRIC_HZ = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0)
"""Frequencies whose thresholds count; those at 3 and 8 kHz do not."""

_KNEE, _CEILING = 30.0, 100.0  # dB SPL between which a normal ear compresses
_WIDENING = 50.0  # dB SPL at which filters begin to widen; they end at twice that
_WIDEST_LOSS = 100.0  # dB HL of the control filters

_LONGEST_LAG = 2400  # samples by which a channel may be moved: 100 ms

_ON_CPU, _ON_GPU = 2**19, 2**25  # samples of all channels that are processed together


def centre_frequencies() -> NDArray[np.float64]:
    """Of the channels in Hz, evenly spaced on the ERB scale from 80 to 8000 Hz. Returns (32,)."""
    offset = _EAR_Q * _LEAST_ERB
    steps = np.linspace(math.log(_LOWEST_HZ + offset), math.log(_HIGHEST_HZ + offset), CHANNELS)
    centres: NDArray[np.float64] = np.exp(steps) - offset
    return centres


def _decay_of_normal() -> NDArray[np.float64]:
    """Decay per sample of a gammatone of normal bandwidth. Returns (32,)."""
    erb: NDArray[np.float64] = _LEAST_ERB + centre_frequencies() / _EAR_Q
    return 2.0 * math.pi / RATE * 1.019 * erb


@dataclass(frozen=True)
class HairCells:
    """What a loss does to the channels. Shape of all: (..., 32), float64.

    Attributes:
        attenuation: of the outer hair cells in dB.
        bandwidth: of the filters at low levels, in normal ones.
        knee: dB SPL at which compression begins.
        ratio: of the compression.
        inner: attenuation of the inner hair cells in dB.
    """

    attenuation: Tensor
    bandwidth: Tensor
    knee: Tensor
    ratio: Tensor
    inner: Tensor

    def __getitem__(self, channels: slice) -> HairCells:
        return HairCells(*(field[..., channels] for field in vars(self).values()))

    def items(self, chosen: slice) -> HairCells:
        """Return those of some items. Shape of all: (items, 32)."""
        return HairCells(*(field[chosen] for field in vars(self).values()))


def hair_cells(thresholds: Tensor) -> HairCells:
    """Shares a loss out to outer and inner hair cells, after Moore et al. 1999, JASA 106. Shape: (..., 8) dB HL."""
    places = integers(tuple(FREQUENCIES.index(hz) for hz in AUDIOMETRIC_HZ), thresholds.device)
    between = constant(_interpolation, dtype=torch.float64, device=thresholds.device)
    loss = (thresholds.detach().double().index_select(-1, places) @ between).clamp_min(0.0)
    normal = torch.linspace(1.25, 3.5, CHANNELS, dtype=torch.float64, device=loss.device)
    most = 70.0 * (1.0 - 1.0 / normal)  # outer hair cells' loss without any compression left
    outer = torch.minimum(0.8 * loss, most)
    inner = torch.where(loss < 1.25 * most, 0.2 * loss, loss - most)
    bandwidth = 1.0 + outer / 50.0 + 2.0 * (outer / 50.0) ** 6
    knee = outer + _KNEE
    ratio = (_CEILING - knee) / (_KNEE + 70.0 / normal + outer - knee)
    return HairCells(outer, bandwidth, knee, ratio, inner)


def _interpolation() -> NDArray[np.float64]:
    """From the six audiometric frequencies to the channels, linear in Hz and flat beyond. Returns (6, 32)."""
    return np.stack([np.interp(centre_frequencies(), AUDIOMETRIC_HZ, row) for row in np.eye(6)])


@kept
def _widest(device: torch.device) -> Tensor:
    """Bandwidth of the control filters. Shape: (32,)."""
    return hair_cells(torch.full((8,), _WIDEST_LOSS, device=device)).bandwidth


@lru_cache(maxsize=64)
def integers(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Return whole numbers as a tensor, without making the host wait for the device. Shape: (len(values),)."""
    with torch.inference_mode(False):  # or training could not use what it keeps
        return torch.tensor(values).to(device, non_blocking=device.type != "cpu")


@dataclass(frozen=True)
class Extent:
    """Lengths of the items of a padded batch.

    Args:
        ends: number of samples of each item.
    """

    ends: tuple[int, ...]

    def __getitem__(self, items: slice) -> Extent:
        return Extent(self.ends[items])

    @property
    def longest(self) -> int:
        return max(self.ends)

    @property
    def padded(self) -> int:
        """Length in whole blocks."""
        return -(-self.longest // BLOCK) * BLOCK

    def cut(self, signal: Tensor) -> Tensor:
        """Cut the padding off, and set to zero what follows the end of each item.

        Shape: (items, ..., padded) -> (items, ..., longest).
        """
        signal = signal[..., : self.longest]
        if self.is_even:
            return signal
        inside = self.inside(signal.device).view(-1, *[1] * (signal.ndim - 2), self.longest)
        return torch.where(inside, signal, 0.0)

    def mean(self, signal: Tensor) -> Tensor:
        """Mean over the time of each item. Shape: (items, ..., padded) -> (items, ...)."""
        ends = integers(self.ends, signal.device).to(signal.dtype)
        return self.cut(signal).sum(-1) / ends.view(-1, *[1] * (signal.ndim - 2))

    def centred(self, signal: Tensor) -> Tensor:
        """Subtract the mean of each item. Shape: (items, ..., padded) -> (items, ..., longest), zero after the ends."""
        return self.cut(signal[..., : self.longest] - self.mean(signal).unsqueeze(-1))

    def inside(self, device: torch.device) -> Tensor:
        """Whether a sample belongs to its item. Shape: -> (items, longest), bool."""
        return torch.arange(self.longest, device=device) < integers(self.ends, device)[:, None]

    @property
    def is_even(self) -> bool:
        """Whether all items are equally long."""
        return min(self.ends) == self.longest


def item_chunks(extent: Extent) -> Iterator[slice]:
    """Split the items of a batch on a GPU so that what is computed of all channels fits in memory."""
    step = max(1, _ON_GPU // (CHANNELS * extent.padded))
    items = len(extent.ends)
    return (slice(start, min(start + step, items)) for start in range(0, items, step))


def channel_chunks(items: int, samples: int, device: torch.device) -> Iterator[slice]:
    """The channels from low to high, as many at a time as caches or memory hold."""
    room = _ON_CPU if device.type == "cpu" else _ON_GPU
    step = min(CHANNELS, max(1, room // (items * samples)))
    step = -(-CHANNELS // -(-CHANNELS // step))  # of one size
    return (slice(start, min(start + step, CHANNELS)) for start in range(0, CHANNELS, step))


# -- filters and compression -------------------------------------------------------------------------------------------


@kept
def _control_filters(
    channels: tuple[int, int], device: torch.device, dtype: torch.dtype
) -> Recursion:
    chosen = slice(*channels)
    decay = (
        constant(_decay_of_normal, dtype=torch.float64, device=device)[chosen]
        * _widest(device)[chosen]
    )
    return gammatone(decay, _angles(device)[chosen], _memory(chosen), dtype)


def _memory(channels: slice) -> int:
    """Samples after which filters of normal bandwidth, and wider ones, have nothing left in double precision."""
    return math.ceil(50.0 / float(_decay_of_normal()[channels.start]))


def _angles(device: torch.device) -> Tensor:
    return constant(centre_frequencies, dtype=torch.float64, device=device) * (2.0 * math.pi / RATE)


def _filtered(filters: Recursion, signal: Tensor) -> tuple[Tensor, Tensor]:
    """Real and imaginary part in blocks. Shape: (items, padded) -> (items, channels, padded / BLOCK, BLOCK) twice."""
    items = len(signal)
    channels = len(filters.through) // items
    rows = signal if items == 1 else signal.repeat_interleave(channels, 0)
    real, imaginary = filters(rows).unflatten(0, (items, channels)).split(BLOCK, -1)
    return real, imaginary


def _power(real: Tensor, imaginary: Tensor) -> Tensor:
    return (real * real).addcmul_(imaginary, imaginary).flatten(-2)


def control_power(signal: Tensor, channels: slice) -> Tensor:
    """Power of the control filters' envelopes. Shape: (items, padded) -> (items, channels, padded)."""
    filters = _control_filters((channels.start, channels.stop), signal.device, signal.dtype)
    if (items := len(signal)) > 1:
        filters = filters.repeated(items)
    return _power(*_filtered(filters, signal))


def bandwidths(control: Tensor, ear: HairCells, channels: slice, extent: Extent) -> Tensor:
    """Of the filters, in normal ones: they widen with the level. Shape: (items, channels, padded) -> (items, channels).

    Args:
        ear: of these channels.
    """
    mean = extent.mean(control).double()
    level = 10.0 * torch.log10(mean.clamp_min(10.0 ** (_WIDENING / 10.0)))
    share = ((level - _WIDENING) / _WIDENING).clamp_max(1.0)
    return ear.bandwidth + share * (_widest(control.device)[channels] - ear.bandwidth)


@dataclass(frozen=True)
class Heard:
    """What the cochlea makes of a signal in some channels.

    Attributes:
        power: of the compressed envelope. Shape: (items, channels, padded).
        motion: of the basilar membrane, compressed; None where not asked for.
        bandwidth: of the filters, in normal ones. Shape: (items, channels), float64.
        mean_power: of the envelope before compression. Shape: (items, channels).
        mean_control: of the control filters' envelope.
    """

    power: Tensor
    motion: Tensor | None
    bandwidth: Tensor
    mean_power: Tensor
    mean_control: Tensor


def listen(
    signal: Tensor, ear: HairCells, channels: slice, extent: Extent, *, motion: bool = False
) -> Heard:
    """Filter and compress some channels of what the middle ear lets through.

    Args:
        signal: (items, padded).
        ear: (items, 32) or (32,), of all channels.
        motion: return the basilar membrane's motion, too.
    """
    cells = ear[channels]
    control = control_power(signal, channels)
    width = bandwidths(control, cells, channels, extent)
    decay = width * constant(_decay_of_normal, dtype=torch.float64, device=signal.device)[channels]
    angle = _angles(signal.device)[channels].expand_as(decay)
    filters = gammatone(decay.flatten(), angle.flatten(), _memory(channels), signal.dtype)
    real, imaginary = _filtered(filters, signal)
    power = _power(real, imaginary)
    gain = compression_gain(control, cells)
    compressed = power * gain.square()
    moved = real.flatten(-2) * gain if motion else None
    means = (
        (extent.mean(power), extent.mean(control)) if motion else (power[..., 0], control[..., 0])
    )
    return Heard(compressed, moved, width, *means)


def compression_gain(control: Tensor, cells: HairCells) -> Tensor:
    """Gain of the outer hair cells on amplitudes, by the control filters' power. Shape: (..., channels, padded)."""
    knee, ratio, loss = (
        field.to(control).unsqueeze(-1) for field in (cells.knee, cells.ratio, cells.attenuation)
    )
    highest = knee.new_full((), 10.0 ** (_CEILING / 10.0))
    level = control.clamp(10.0 ** (knee / 10.0), highest).log()
    # in nepers: -loss - (level - knee) (1 - 1 / ratio)
    exponent = 0.5 * (1.0 / ratio - 1.0)
    neper = math.log(10.0) / 20.0
    gain = torch.addcmul(-neper * (loss + 2.0 * exponent * knee), level, exponent).exp_()
    return gain_lowpass(control.device, control.dtype)(gain).flatten(-2)


def mean_level(heard: Heard, cells: HairCells) -> Tensor:
    """Long-term level over threshold in dB, by the means of envelope and control. Returns (items, channels)."""
    knee = 10.0 ** (cells.knee / 10.0)
    control = torch.maximum(heard.mean_control.double().clamp_max(10.0 ** (_CEILING / 10.0)), knee)
    gain = -cells.attenuation - (10.0 * torch.log10(control) - cells.knee) * (
        1.0 - 1.0 / cells.ratio
    )
    level = 10.0 * torch.log10(heard.mean_power.double().clamp_min(1.0))
    return (level + gain - cells.inner).clamp_min(0.0).to(heard.power.dtype)


# -- alignment of channels ---------------------------------------------------------------------------------------------


def lag_spectrum(reference: Tensor, extent: Extent) -> Tensor:
    """For ``channel_lags``: of each sample's step to the next.

    Around its maximum the correlation hardly changes from lag to lag: single precision tells its steps, not its values.

    Shape: (items, channels, padded) -> (items, channels, bins).
    """
    points = _lag_points(extent)
    step = constant(_step, points, dtype=reference.dtype.to_complex(), device=reference.device)
    return torch.fft.rfft(extent.cut(reference), points) * step


def _step(points: int) -> NDArray[np.complex128]:
    step: NDArray[np.complex128] = np.expm1(2j * np.pi * np.arange(points // 2 + 1) / points)
    return step


def _lag_points(extent: Extent) -> int:
    return fft_length(extent.longest + _LONGEST_LAG, 2)


def channel_lags(reference: Tensor, processed: Tensor, extent: Extent) -> Tensor:
    """Samples by which each channel is to be moved later to match the reference's: the largest cross-correlation's.

    Args:
        reference: ``lag_spectrum`` of the reference's envelope or motion.
        processed: envelope or motion. Shape: (items, channels, padded).

    Returns: (items, channels) from -2399 to 2400, int64.
    """
    with torch.no_grad():
        points, most = _lag_points(extent), min(_LONGEST_LAG, extent.longest)
        spectrum = torch.fft.rfft(extent.cut(processed), points)
        steps = torch.fft.irfft(reference * spectrum.conj(), points)
        near = torch.cat((steps[..., points - most + 1 :], steps[..., :most]), -1)
        correlation = functional.pad(near.double().cumsum(-1), (1, 0))
        return correlation.argmax(-1) - (most - 1)


def shift(
    signal: Tensor, delays: Tensor, ends: Sequence[int], stops: Sequence[int], size: int
) -> Tensor:
    """Move channels later by whole samples: ``output[t] = signal[t - delay]`` up to the item's stop, 0 elsewhere.

    Args:
        signal: (items, channels, time).
        delays: (items, channels), whole numbers; negative ones move earlier.
        ends: samples of each item that are signal; the rest counts as 0.
        stops: samples of each item's output that may hold something.
        size: of the output's time.

    Returns: (items, channels, size).
    """
    moved: Tensor = _Shift.apply(signal, delays, tuple(ends), tuple(stops), size)
    return moved


class _Shift(torch.autograd.Function):
    """Its gradient is moved back, where that of slices would be a tensor of zeros for each."""

    @staticmethod
    def forward(
        ctx: Any,
        signal: Tensor,
        delays: Tensor,
        ends: tuple[int, ...],
        stops: tuple[int, ...],
        size: int,
    ) -> Tensor:
        ctx.settings = (delays, ends, stops, signal.shape[-1])
        return _shifted(signal, delays, ends, stops, size)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None, None]:
        delays, ends, stops, size = ctx.settings
        return _shifted(gradient, -delays, stops, ends, size), None, None, None, None


def _shifted(
    signal: Tensor, delays: Tensor, ends: tuple[int, ...], stops: tuple[int, ...], size: int
) -> Tensor:
    if signal.device.type != "cpu":
        return _gathered(signal, delays, ends, stops, size)
    moved = signal.new_empty((*signal.shape[:-1], size))
    for item, (end, stop) in enumerate(zip(ends, stops, strict=True)):
        for row, out, delay in zip(signal[item], moved[item], delays[item].tolist(), strict=True):
            start = min(max(delay, 0), size)
            last = max(start, min(end + delay, stop))
            out[:start] = 0.0
            out[start:last] = row[start - delay : last - delay]
            out[last:] = 0.0
    return moved


def _gathered(
    signal: Tensor, delays: Tensor, ends: tuple[int, ...], stops: tuple[int, ...], size: int
) -> Tensor:
    device = signal.device
    target = torch.arange(size, device=device)
    source = target - delays.unsqueeze(-1)
    end, stop = (integers(limits, device)[:, None, None] for limits in (ends, stops))
    inside = (source >= 0) & (source < end) & (target < stop)
    return torch.where(inside, signal.gather(-1, source.clamp(0, signal.shape[-1] - 1)), 0.0)


def group_delays(bandwidth: Tensor, channels: slice) -> Tensor:
    """Of the gammatones at 0 Hz, in whole samples. Shape: (items, channels) -> (items, channels), int64."""
    decay = (
        bandwidth.detach()
        * constant(_decay_of_normal, dtype=torch.float64, device=bandwidth.device)[channels]
    )
    pole = torch.exp(-decay)
    return (4.0 * pole / (1.0 + 2.0 * pole) + 4.0 * pole / (1.0 - pole)).round().long()


def longest_group_delay(signal: Tensor, ear: HairCells, extent: Extent) -> Tensor:
    """Of all channels, which are delayed to match it. Shape: (items, padded) -> (items, 1).

    It is one of the three lowest channels': a filter widens by up to 1.28 there, and the fourth is 1.37 times as wide
    as the first.
    """
    low = slice(0, 3)
    width = bandwidths(control_power(signal, low), ear[low], low, extent)
    return group_delays(width, low).amax(-1, keepdim=True)


# -- inner hair cells --------------------------------------------------------------------------------------------------


def sensation(power: Tensor, inner: Tensor) -> Tensor:
    """Level over the threshold in dB, 0 or more. Shape: (items, channels, padded), (items or 1, channels) -> as power."""
    floor = 10.0 ** (inner.to(power).unsqueeze(-1) / 10.0)
    level = torch.maximum(power, floor).log().mul_(10.0 / math.log(10.0))
    return level.sub_(inner.to(power).unsqueeze(-1))


def adapted(level: Tensor) -> Tensor:
    """With the overshoot at onsets of the inner hair cells' adaptation. Shape: (..., padded) -> (..., padded)."""
    return adaptation(level.device, level.dtype)(level).flatten(-2).clamp_min(0.0)
