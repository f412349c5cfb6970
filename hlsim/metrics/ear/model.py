"""Kates' model of the auditory periphery, for normal and impaired ears.

The stages of a channel are:

1. A control gammatone, as wide as with a loss of 100 dB, determines the bandwidth of the channel
and
   the gain of the outer hair cells.
2. A gammatone of that bandwidth filters the signal, and the gain is applied.
3. The output is aligned with the reference and converted to dB over the threshold of hearing.
4. The inner hair cells adapt.

Signals are in multiples of 20 uPa, so that amplitude 1 is 0 dB SPL. They are padded to a multiple
of ``BLOCK`` samples, and the padding does not matter. Channels lie in the last dimension but one,
and are computed a few at a time.

Source: Kates 2013, "An auditory model for intelligibility and quality predictions", Proceedings of
Meetings on Acoustics 19, 050184. The constants are those of pyclarity 0.9.0, which this model
equals.
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
    cached_filter,
    gain_lowpass,
    gammatone,
)
from hlsim.torchtools import constant

CHANNELS = 32
"""Number of channels of the ear."""

MIN_CENTRE_HZ, MAX_CENTRE_HZ = 80.0, 8000.0
"""Centre frequencies of the first and of the last channel."""

EAR_Q, MIN_ERB_HZ = 9.26449, 24.7
"""Constants of the equivalent rectangular bandwidth (Moore and Glasberg 1983)."""

AUDIOMETRIC_HZ = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0)
"""Frequencies in Hz whose thresholds matter. Those at 3 and 8 kHz do not."""

AUDIOMETRIC_INDICES = tuple(FREQUENCIES.index(hz) for hz in AUDIOMETRIC_HZ)
"""Positions of these frequencies in an audiogram."""

KNEE_SPL, CEILING_SPL = 30.0, 100.0
"""Levels in dB SPL between which a normal ear compresses."""

WIDENING_SPL = 50.0
"""Level in dB SPL above which filters widen. At twice that level they are widest."""

CONTROL_LOSS = 100.0
"""Hearing loss in dB HL that gives the bandwidth of the control filters."""

MAX_LAG = 2400
"""Largest shift of a channel in samples, 100 ms."""

CPU_CHUNK, GPU_CHUNK = 2**19, 2**25
"""Samples of channels that are computed at once, so that they fit into caches or memory."""


def centre_frequencies() -> NDArray[np.float64]:
    """Return the centre frequencies of the channels in Hz, evenly spaced on the ERB scale: (32,).

    >>> centre_frequencies()[[0, -1]].round()
    array([  80., 8000.])
    """
    offset = EAR_Q * MIN_ERB_HZ
    steps = np.linspace(
        math.log(MIN_CENTRE_HZ + offset), math.log(MAX_CENTRE_HZ + offset), CHANNELS
    )
    centres: NDArray[np.float64] = np.exp(steps) - offset
    return centres


def _normal_decay() -> NDArray[np.float64]:
    """Return the decay per sample of the gammatones of normal bandwidth: (32,)."""
    erb: NDArray[np.float64] = MIN_ERB_HZ + centre_frequencies() / EAR_Q
    return 2.0 * math.pi / RATE * 1.019 * erb


@dataclass(frozen=True)
class HairCells:
    """State of the hair cells in each channel. Shape of all: (..., 32), float64.

    Attributes:
        attenuation: Attenuation by the outer hair cells in dB.
        bandwidth: Bandwidth of the filters at low levels, relative to normal hearing.
        knee: Level in dB SPL above which the channel compresses.
        ratio: Compression ratio.
        inner: Attenuation by the inner hair cells in dB.

    >>> cells = hair_cells(torch.zeros(8))
    >>> cells[0:2].knee
    tensor([30., 30.], dtype=torch.float64)
    """

    attenuation: Tensor
    bandwidth: Tensor
    knee: Tensor
    ratio: Tensor
    inner: Tensor

    def __getitem__(self, channels: slice) -> HairCells:
        return HairCells(*(field[..., channels] for field in vars(self).values()))

    def select_items(self, items: slice) -> HairCells:
        """Return the hair cells of some items. Shape of all: (items, 32)."""
        return HairCells(*(field[items] for field in vars(self).values()))


def hair_cells(thresholds: Tensor) -> HairCells:
    """Divide a hearing loss between outer and inner hair cells. Shape: (..., 8) dB HL.

    Source: Moore et al. 1999, J. Acoust. Soc. Am. 106(5), 2761-2778.

    >>> float(hair_cells(torch.full((8,), 40.0)).inner[0].round())
    26.0
    """
    indices = integers(AUDIOMETRIC_INDICES, thresholds.device)
    weights = constant(_interpolation, dtype=torch.float64, device=thresholds.device)
    loss = (thresholds.detach().double().index_select(-1, indices) @ weights).clamp_min(0.0)
    normal = torch.linspace(1.25, 3.5, CHANNELS, dtype=torch.float64, device=loss.device)
    # With this loss of the outer hair cells, no compression remains.
    max_outer = 70.0 * (1.0 - 1.0 / normal)
    outer = torch.minimum(0.8 * loss, max_outer)
    inner = torch.where(loss < 1.25 * max_outer, 0.2 * loss, loss - max_outer)
    bandwidth = 1.0 + outer / 50.0 + 2.0 * (outer / 50.0) ** 6
    knee = outer + KNEE_SPL
    ratio = (CEILING_SPL - knee) / (KNEE_SPL + 70.0 / normal + outer - knee)
    return HairCells(outer, bandwidth, knee, ratio, inner)


def _interpolation() -> NDArray[np.float64]:
    """Return the weights of the audiometric frequencies in the channels: (6, 32).

    They interpolate linearly in Hz, and extend the first and the last threshold.
    """
    return np.stack([np.interp(centre_frequencies(), AUDIOMETRIC_HZ, row) for row in np.eye(6)])


@cached_filter
def _control_bandwidth(device: torch.device) -> Tensor:
    """Return the bandwidth of the control filters, relative to normal hearing. Shape: (32,)."""
    return hair_cells(torch.full((8,), CONTROL_LOSS, device=device)).bandwidth


@lru_cache(maxsize=64)
def integers(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Return integers as a tensor on a device, for which the host does not wait.

    Shape: -> (len(values),), int64.

    >>> integers((3, 5), torch.device("cpu"))
    tensor([3, 5])
    """
    with torch.inference_mode(False):  # the cached tensor may serve a training later
        return torch.tensor(values).to(device, non_blocking=device.type != "cpu")


@dataclass(frozen=True)
class Extent:
    """Lengths of the items of a padded batch.

    Args:
        ends: Number of samples of each item.

    >>> extent = Extent((100, 30))
    >>> extent.longest, extent.padded
    (100, 128)
    """

    ends: tuple[int, ...]

    def __getitem__(self, items: slice) -> Extent:
        return Extent(self.ends[items])

    @property
    def longest(self) -> int:
        return max(self.ends)

    @property
    def padded(self) -> int:
        """Length of the longest item, rounded up to whole blocks."""
        return -(-self.longest // BLOCK) * BLOCK

    def cut(self, signal: Tensor) -> Tensor:
        """Remove the padding, and set the samples behind the end of each item to zero.

        Shape: (items, ..., padded) -> (items, ..., longest).
        """
        signal = signal[..., : self.longest]
        if self.is_even:
            return signal
        inside = self.inside(signal.device).view(-1, *[1] * (signal.ndim - 2), self.longest)
        return torch.where(inside, signal, 0.0)

    def mean(self, signal: Tensor) -> Tensor:
        """Return the mean of each item over time. Shape: (items, ..., padded) -> (items, ...)."""
        ends = integers(self.ends, signal.device).to(signal.dtype)
        return self.cut(signal).sum(-1) / ends.view(-1, *[1] * (signal.ndim - 2))

    def centred(self, signal: Tensor) -> Tensor:
        """Subtract the mean of each item, and set the samples behind its end to zero.

        Shape: (items, ..., padded) -> (items, ..., longest).
        """
        return self.cut(signal[..., : self.longest] - self.mean(signal).unsqueeze(-1))

    def inside(self, device: torch.device) -> Tensor:
        """Return whether samples lie before the end of their item.

        Shape: -> bool (items, longest).
        """
        return torch.arange(self.longest, device=device) < integers(self.ends, device)[:, None]

    @property
    def is_even(self) -> bool:
        """Whether all items are equally long."""
        return min(self.ends) == self.longest


def channel_chunks(items: int, samples: int, device: torch.device) -> Iterator[slice]:
    """Split the channels so that caches or memory hold those of a chunk, from low to high.

    >>> len(list(channel_chunks(1, 48000, torch.device("cpu"))))
    4
    """
    size = CPU_CHUNK if device.type == "cpu" else GPU_CHUNK
    step = min(CHANNELS, max(1, size // (items * samples)))
    step = -(-CHANNELS // -(-CHANNELS // step))  # chunks of equal size
    return (slice(start, min(start + step, CHANNELS)) for start in range(0, CHANNELS, step))


# -- filters and compression -----------------------------------------------------------------------


@cached_filter
def _control_filters(
    channels: tuple[int, int], device: torch.device, dtype: torch.dtype
) -> Recursion:
    chosen = slice(*channels)
    decay = (
        constant(_normal_decay, dtype=torch.float64, device=device)[chosen]
        * _control_bandwidth(device)[chosen]
    )
    return gammatone(decay, _centre_angles(device)[chosen], _filter_memory(chosen), dtype)


def _filter_memory(channels: slice) -> int:
    """Return the samples after which the response of normal and wider filters has vanished."""
    return math.ceil(50.0 / float(_normal_decay()[channels.start]))


def _centre_angles(device: torch.device) -> Tensor:
    return constant(centre_frequencies, dtype=torch.float64, device=device) * (2.0 * math.pi / RATE)


def _apply_filters(filters: Recursion, signal: Tensor) -> tuple[Tensor, Tensor]:
    """Return the real and the imaginary part of the filtered signals in blocks.

    Shape: (items, padded) -> (items, channels, padded / BLOCK, BLOCK) twice.
    """
    items = len(signal)
    channels = len(filters.through) // items
    rows = signal if items == 1 else signal.repeat_interleave(channels, 0)
    real, imaginary = filters(rows).unflatten(0, (items, channels)).split(BLOCK, -1)
    return real, imaginary


def _envelope_power(real: Tensor, imaginary: Tensor) -> Tensor:
    return (real * real).addcmul_(imaginary, imaginary).flatten(-2)


def control_power(signal: Tensor, channels: slice) -> Tensor:
    """Return the power of the control filters' envelopes.

    Args:
        signal: Output of the middle ear.
        channels: Channels to compute.

    Shape: (items, padded) -> (items, channels, padded).

    >>> control_power(torch.zeros(1, 128), slice(0, 3)).shape
    torch.Size([1, 3, 128])
    """
    filters = _control_filters((channels.start, channels.stop), signal.device, signal.dtype)
    if len(signal) > 1:
        filters = filters.repeated(len(signal))
    return _envelope_power(*_apply_filters(filters, signal))


def bandwidths(control: Tensor, ear: HairCells, channels: slice, extent: Extent) -> Tensor:
    """Return the bandwidths of the filters, which widen with the level, relative to normal hearing.

    Args:
        control: Power of the control filters' envelopes.
        ear: Hair cells of these channels.
        channels: The channels.
        extent: Lengths of the items.

    Shape: (items, channels, padded) -> (items, channels).

    >>> control, ear = torch.zeros(1, 3, 128), hair_cells(torch.zeros(8))
    >>> bandwidths(control, ear[0:3], slice(0, 3), Extent((128,)))
    tensor([[1., 1., 1.]], dtype=torch.float64)
    """
    mean = extent.mean(control).double()
    level = 10.0 * torch.log10(mean.clamp_min(10.0 ** (WIDENING_SPL / 10.0)))
    share = ((level - WIDENING_SPL) / WIDENING_SPL).clamp_max(1.0)
    return ear.bandwidth + share * (_control_bandwidth(control.device)[channels] - ear.bandwidth)


@dataclass(frozen=True)
class CochlearOutput:
    """Output of the cochlea in some channels.

    Attributes:
        power: Power of the compressed envelope. Shape: (items, channels, padded).
        motion: Compressed motion of the basilar membrane, or None where it was not requested.
            Shape: (items, channels, padded).
        bandwidth: Bandwidth of the filters, relative to normal hearing. Shape: (items, channels),
            float64.
        mean_power: Mean power of the envelope before compression. Shape: (items, channels).
        mean_control: Mean power of the control filters' envelope. Shape: (items, channels).

    >>> ear = hair_cells(torch.zeros(8))
    >>> cochlea = simulate_cochlea(torch.zeros(1, 128), ear, slice(0, 3), Extent((128,)))
    >>> cochlea.power.shape
    torch.Size([1, 3, 128])
    """

    power: Tensor
    motion: Tensor | None
    bandwidth: Tensor
    mean_power: Tensor
    mean_control: Tensor


def simulate_cochlea(
    signal: Tensor, ear: HairCells, channels: slice, extent: Extent, *, motion: bool = False
) -> CochlearOutput:
    """Filter the output of the middle ear in some channels, and compress it.

    Args:
        signal: Output of the middle ear. Shape: (items, padded).
        ear: Hair cells of all channels. Shape: (items, 32) or (32,).
        channels: Channels to compute.
        extent: Lengths of the items.
        motion: Return the motion of the basilar membrane, too.

    >>> signal, ear = torch.zeros(1, 128), hair_cells(torch.zeros(8))
    >>> cochlea = simulate_cochlea(signal, ear, slice(0, 3), Extent((128,)), motion=True)
    >>> cochlea.motion.shape
    torch.Size([1, 3, 128])
    """
    cells = ear[channels]
    control = control_power(signal, channels)
    width = bandwidths(control, cells, channels, extent)
    decay = width * constant(_normal_decay, dtype=torch.float64, device=signal.device)[channels]
    angle = _centre_angles(signal.device)[channels].expand_as(decay)
    filters = gammatone(decay.flatten(), angle.flatten(), _filter_memory(channels), signal.dtype)
    real, imaginary = _apply_filters(filters, signal)
    power = _envelope_power(real, imaginary)
    gain = compression_gain(control, cells)
    compressed = power * gain.square()
    if not motion:  # HASPI needs neither the motion nor the means
        return CochlearOutput(compressed, None, width, power[..., 0], control[..., 0])
    compressed_motion = real.flatten(-2) * gain
    return CochlearOutput(
        compressed, compressed_motion, width, extent.mean(power), extent.mean(control)
    )


def compression_gain(control: Tensor, cells: HairCells) -> Tensor:
    """Return the gain of the outer hair cells on amplitudes.

    Args:
        control: Power of the control filters' envelopes.
        cells: Hair cells of these channels.

    Shape: (..., channels, padded) -> (..., channels, padded).

    >>> compression_gain(torch.zeros(1, 2, 64), hair_cells(torch.zeros(8))[0:2])[0, 0, :2]
    tensor([0.0951, 0.2672])
    """
    knee, ratio, loss = (
        field.to(control).unsqueeze(-1) for field in (cells.knee, cells.ratio, cells.attenuation)
    )
    highest = knee.new_full((), 10.0 ** (CEILING_SPL / 10.0))
    level = control.clamp(10.0 ** (knee / 10.0), highest).log()
    # The gain in nepers is -loss - (level - knee) (1 - 1 / ratio).
    exponent = 0.5 * (1.0 / ratio - 1.0)
    neper = math.log(10.0) / 20.0
    gain = torch.addcmul(-neper * (loss + 2.0 * exponent * knee), level, exponent).exp_()
    return gain_lowpass(control.device, control.dtype)(gain).flatten(-2)


def mean_level(cochlea: CochlearOutput, cells: HairCells) -> Tensor:
    """Return the long-term level of each channel in dB over threshold.

    Args:
        cochlea: Output of ``simulate_cochlea`` with ``motion=True``.
        cells: Hair cells of these channels.

    Returns:
        Levels of 0 dB or more. Shape: (items, channels).

    >>> signal, ear = torch.zeros(1, 128), hair_cells(torch.zeros(8))
    >>> cochlea = simulate_cochlea(signal, ear, slice(0, 3), Extent((128,)), motion=True)
    >>> mean_level(cochlea, ear[0:3])
    tensor([[0., 0., 0.]])
    """
    knee = 10.0 ** (cells.knee / 10.0)
    control = torch.maximum(
        cochlea.mean_control.double().clamp_max(10.0 ** (CEILING_SPL / 10.0)), knee
    )
    gain = -cells.attenuation - (10.0 * torch.log10(control) - cells.knee) * (
        1.0 - 1.0 / cells.ratio
    )
    level = 10.0 * torch.log10(cochlea.mean_power.double().clamp_min(1.0))
    return (level + gain - cells.inner).clamp_min(0.0).to(cochlea.power.dtype)


# -- alignment of channels -------------------------------------------------------------------------


def lag_spectrum(reference: Tensor, extent: Extent) -> Tensor:
    """Return the spectrum of the differences of neighbouring samples, for ``channel_lags``.

    Near its maximum, a correlation hardly changes from lag to lag. Single precision resolves its
    steps, but not its values.

    Args:
        reference: Envelope or motion.
        extent: Lengths of the items.

    Shape: (items, channels, padded) -> (items, channels, bins).

    >>> lag_spectrum(torch.zeros(1, 2, 128), Extent((128,))).shape
    torch.Size([1, 2, 1297])
    """
    points = _lag_points(extent)
    step = constant(
        _step_response, points, dtype=reference.dtype.to_complex(), device=reference.device
    )
    return torch.fft.rfft(extent.cut(reference), points) * step


def _step_response(points: int) -> NDArray[np.complex128]:
    step: NDArray[np.complex128] = np.expm1(2j * np.pi * np.arange(points // 2 + 1) / points)
    return step


def _lag_points(extent: Extent) -> int:
    return fft_length(extent.longest + MAX_LAG, 2)


def channel_lags(reference: Tensor, processed: Tensor, extent: Extent) -> Tensor:
    """Return the shift of each channel that gives the largest cross-correlation with the reference.

    Args:
        reference: ``lag_spectrum`` of the reference's envelope or motion.
        processed: Envelope or motion. Shape: (items, channels, padded).
        extent: Lengths of the items.

    Returns:
        Samples by which to delay each channel, from -2399 to 2400, int64. Shape: (items, channels).

    >>> reference = torch.zeros(1, 1, 128)
    >>> reference[..., 50] = 1.0
    >>> extent = Extent((128,))
    >>> channel_lags(lag_spectrum(reference, extent), reference.roll(-7, -1), extent)
    tensor([[7]])
    """
    with torch.no_grad():
        points, max_lag = _lag_points(extent), min(MAX_LAG, extent.longest)
        spectrum = torch.fft.rfft(extent.cut(processed), points)
        steps = torch.fft.irfft(reference * spectrum.conj(), points)
        near = torch.cat((steps[..., points - max_lag + 1 :], steps[..., :max_lag]), -1)
        correlation = functional.pad(near.double().cumsum(-1), (1, 0))
        return correlation.argmax(-1) - (max_lag - 1)


def shift(
    signal: Tensor, delays: Tensor, ends: Sequence[int], stops: Sequence[int], size: int
) -> Tensor:
    """Delay channels by whole samples.

    The output is ``signal[t - delay]`` before the stop of each item, and 0 elsewhere.

    Args:
        signal: Signals. Shape: (items, channels, time).
        delays: Delays in samples; negative ones advance. Shape: (items, channels), int64.
        ends: Number of samples of each item; later ones count as 0.
        stops: Number of samples of each item's output; later ones are 0.
        size: Length of the output.

    Returns:
        Delayed signals. Shape: (items, channels, size).

    >>> signal = torch.tensor([[[1.0, 2.0, 3.0]]])
    >>> shift(signal, torch.tensor([[1]]), ends=(3,), stops=(3,), size=4)
    tensor([[[0., 1., 2., 0.]]])
    """
    delayed: Tensor = _Shift.apply(signal, delays, tuple(ends), tuple(stops), size)
    return delayed


class _Shift(torch.autograd.Function):
    """Shift each channel by an integer delay.

    The backward pass applies the opposite shift. Slices would allocate a tensor of zeros each.
    """

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
        return _shift_rows(signal, delays, ends, stops, size)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None, None]:
        delays, ends, stops, size = ctx.settings
        return _shift_rows(gradient, -delays, stops, ends, size), None, None, None, None


def _shift_rows(
    signal: Tensor, delays: Tensor, ends: tuple[int, ...], stops: tuple[int, ...], size: int
) -> Tensor:
    if signal.device.type != "cpu":
        return _gather_rows(signal, delays, ends, stops, size)
    delayed = signal.new_empty((*signal.shape[:-1], size))
    for item, (end, stop) in enumerate(zip(ends, stops, strict=True)):
        for row, out, delay in zip(signal[item], delayed[item], delays[item].tolist(), strict=True):
            start = min(max(delay, 0), size)
            last = max(start, min(end + delay, stop))
            out[:start] = 0.0
            out[start:last] = row[start - delay : last - delay]
            out[last:] = 0.0
    return delayed


def _gather_rows(
    signal: Tensor, delays: Tensor, ends: tuple[int, ...], stops: tuple[int, ...], size: int
) -> Tensor:
    device = signal.device
    target = torch.arange(size, device=device)
    source = target - delays.unsqueeze(-1)
    end, stop = (integers(limits, device)[:, None, None] for limits in (ends, stops))
    inside = (source >= 0) & (source < end) & (target < stop)
    return torch.where(inside, signal.gather(-1, source.clamp(0, signal.shape[-1] - 1)), 0.0)


def group_delays(bandwidth: Tensor, channels: slice) -> Tensor:
    """Return the delay of each gammatone at its centre frequency in whole samples.

    Channels are shifted to 0 Hz before they are filtered, so it is the group delay at 0 Hz.

    Args:
        bandwidth: Bandwidths of the filters, relative to normal hearing.
        channels: The channels.

    Shape: (items, channels) -> int64 (items, channels).

    >>> group_delays(torch.ones(1, 2), slice(0, 2))
    tensor([[449, 404]])
    """
    normal_decay = constant(_normal_decay, dtype=torch.float64, device=bandwidth.device)
    decay = bandwidth.detach() * normal_decay[channels]
    pole = torch.exp(-decay)
    return (4.0 * pole / (1.0 + 2.0 * pole) + 4.0 * pole / (1.0 - pole)).round().long()


def longest_group_delay(signal: Tensor, ear: HairCells, extent: Extent) -> Tensor:
    """Return the longest group delay of all channels, to which they are delayed.

    It is that of one of the first three channels: these filters widen by a factor of 1.28 at most,
    and the fourth filter is 1.37 times as wide as the first.

    Args:
        signal: Output of the middle ear.
        ear: Hair cells of all channels.
        extent: Lengths of the items.

    Shape: (items, padded) -> int64 (items, 1).

    >>> longest_group_delay(torch.zeros(1, 128), hair_cells(torch.zeros(8)), Extent((128,)))
    tensor([[449]])
    """
    low = slice(0, 3)
    width = bandwidths(control_power(signal, low), ear[low], low, extent)
    return group_delays(width, low).amax(-1, keepdim=True)


# -- inner hair cells ------------------------------------------------------------------------------


def sensation(power: Tensor, inner: Tensor) -> Tensor:
    """Return the level over the threshold in dB, 0 or more.

    Args:
        power: Power of the compressed envelopes. Shape: (items, channels, padded).
        inner: Attenuation by the inner hair cells in dB. Shape: (items or 1, channels).

    Returns:
        Levels. Shape: (items, channels, padded).

    >>> sensation(torch.full((1, 1, 2), 1e4), torch.tensor([[10.0]]))
    tensor([[[30., 30.]]])
    """
    floor = 10.0 ** (inner.to(power).unsqueeze(-1) / 10.0)
    level = torch.maximum(power, floor).log().mul_(10.0 / math.log(10.0))
    return level.sub_(inner.to(power).unsqueeze(-1))


def apply_adaptation(level: Tensor) -> Tensor:
    """Apply the adaptation of the inner hair cells, which emphasises onsets.

    Shape: (..., padded) -> (..., padded).

    >>> levels = apply_adaptation(torch.full((1, 12800), 30.0))
    >>> levels[0, [0, -1]].round()
    tensor([60., 30.])
    """
    return adaptation(level.device, level.dtype)(level).flatten(-2).clamp_min(0.0)
