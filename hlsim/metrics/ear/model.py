"""Kates' model of the ear: from a sound to the levels that reach the auditory nerve.

The model divides a sound into 32 channels, band-passes from 80 Hz to 8 kHz. In each channel:

1. A gammatone filter splits off the band. Its complex output has a magnitude, the *envelope*, and a
   real part, the *motion* of the basilar membrane. Loud sounds and a hearing loss widen the filter.
2. The outer hair cells amplify soft sounds more than loud ones. A wide *control* filter measures
   how loud the sound is. A hearing loss reduces this gain.
3. The inner hair cells turn the envelope into a level in dB over the threshold of hearing, and
   adapt: they emphasise onsets. A hearing loss reduces the level.

Between steps 2 and 3, the scores align each channel of the output of an aid in time with the same
channel of the clean signal, because aids delay frequencies differently.

Signals are in multiples of 20 uPa at 24 kHz, so that amplitude 1 is 0 dB SPL. They have the shape
(items, padded) before the filters and (items, channels, padded) after them, where ``padded`` is a
multiple of 64 samples; the padding has no effect. Channels are computed a few at a time, because
all of them do not fit into caches.

Source: Kates 2013, "An auditory model for intelligibility and quality predictions", Proceedings of
Meetings on Acoustics 19, 050184. The constants are those of pyclarity 0.9.0, whose results this
model reproduces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import EllipsisType

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram import FREQUENCIES
from hlsim.dsp.interpolation import interpolation_weights
from hlsim.metrics.ear.extent import Extent, integers
from hlsim.metrics.ear.recursions import (
    RATE,
    Recursion,
    adaptation,
    apply_filter,
    gain_lowpass,
    gammatone,
)
from hlsim.torchtools import compute_once, constant

CHANNELS = 32
"""Number of channels of the ear."""

MIN_CENTRE_HZ, MAX_CENTRE_HZ = 80.0, 8000.0
"""Centre frequencies of the first and of the last channel in Hz."""

EAR_Q, MIN_ERB_HZ = 9.26449, 24.7
"""Constants of the equivalent rectangular bandwidth (ERB) of Moore and Glasberg (1983).

The ERB at f Hz is ``MIN_ERB_HZ + f / EAR_Q`` Hz.
"""

AUDIOMETRIC_HZ = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0)
"""Frequencies in Hz whose thresholds matter. Those at 3 and 8 kHz do not."""

AUDIOMETRIC_INDICES = tuple(FREQUENCIES.index(hz) for hz in AUDIOMETRIC_HZ)
"""Positions of ``AUDIOMETRIC_HZ`` among the eight frequencies of an audiogram."""

KNEE_SPL, CEILING_SPL = 30.0, 100.0
"""Levels in dB SPL between which a normal ear compresses."""

WIDENING_SPL = 50.0
"""Level in dB SPL above which filters widen. From 100 dB SPL on they are widest."""

CONTROL_LOSS = 100.0
"""Hearing loss in dB HL that gives the bandwidth of the control filters."""

CPU_CHUNK, GPU_CHUNK = 2**19, 2**25
"""Number of samples, over all items and channels, that are computed at once.

On a CPU they fit into its caches. On a GPU they take 128 MB per tensor in float32.
"""


@constant
def centre_frequencies() -> NDArray[np.float64]:
    """Return the centre frequencies of all channels in Hz, (32,), evenly spaced on the ERB scale.

    >>> centre_frequencies()[[0, -1]].round()
    array([  80., 8000.])
    """
    offset = EAR_Q * MIN_ERB_HZ
    steps = np.linspace(
        math.log(MIN_CENTRE_HZ + offset), math.log(MAX_CENTRE_HZ + offset), CHANNELS
    )
    return np.exp(steps) - offset


@constant
def _normal_decay() -> NDArray[np.float64]:
    """Return the decay of the gammatones of a normal ear, in nepers per sample at 24 kHz.

    The impulse response of a channel contains the factor exp(-decay n) at sample n. Shape: (32,).
    """
    erb: NDArray[np.float64] = MIN_ERB_HZ + centre_frequencies() / EAR_Q
    return 2.0 * math.pi / RATE * 1.019 * erb


@dataclass(frozen=True)
class HairCells:
    """Effect of a hearing loss on the hair cells of each channel.

    Shape of each attribute: (..., 32), or (..., channels) for some of the channels, float64.

    Attributes:
        outer: Loss of the outer hair cells in dB: gain that soft sounds no longer receive.
        bandwidth: Bandwidth of the filters for soft sounds, relative to normal hearing.
        knee: Level in dB SPL above which the channel compresses.
        ratio: Compression ratio: input dB per output dB above the knee.
        inner: Loss of the inner hair cells in dB.

    >>> cells = hair_cells(torch.zeros(8))
    >>> cells[..., 0:2].knee
    tensor([30., 30.], dtype=torch.float64)
    """

    outer: Tensor
    bandwidth: Tensor
    knee: Tensor
    ratio: Tensor
    inner: Tensor

    def __getitem__(self, index: slice | tuple[EllipsisType, slice]) -> HairCells:
        """Return some items, ``cells[items]``, or channels, ``cells[..., channels]``."""
        return HairCells(*(field[index] for field in vars(self).values()))


def hair_cells(thresholds: Tensor) -> HairCells:
    """Divide a hearing loss between outer and inner hair cells.

    The outer hair cells account for 80 % of the loss, up to the loss at which they no longer
    compress, and the inner hair cells for the rest. Thresholds are interpolated linearly in Hz to
    the centre of each channel, and constant below 250 and above 6000 Hz. Interpolated thresholds
    below 0 dB HL count as 0. The result has no gradient.

    Source: Moore et al. 1999, J. Acoust. Soc. Am. 106(5), 2761-2778.

    Args:
        thresholds: Audiogram at 250, 500, 1000, 2000, 3000, 4000, 6000 and 8000 Hz in dB HL. Shape:
            (..., 8).

    Returns:
        Hair cells of the 32 channels. Shape of each attribute: (..., 32).

    >>> float(hair_cells(torch.full((8,), 40.0)).inner[0].round())
    26.0
    """
    indices = integers(AUDIOMETRIC_INDICES, thresholds.device)
    levels = thresholds.detach().double().index_select(-1, indices)
    weights = interpolation_weights(AUDIOMETRIC_HZ, tuple(centre_frequencies()), like=levels)
    loss = (levels @ weights).clamp_min(0.0)
    normal_ratio = torch.linspace(1.25, 3.5, CHANNELS, dtype=torch.float64, device=loss.device)
    # With this loss of the outer hair cells, no compression remains.
    max_outer = 70.0 * (1.0 - 1.0 / normal_ratio)
    outer = torch.minimum(0.8 * loss, max_outer)
    inner = torch.where(loss < 1.25 * max_outer, 0.2 * loss, loss - max_outer)
    bandwidth = 1.0 + outer / 50.0 + 2.0 * (outer / 50.0) ** 6
    knee = outer + KNEE_SPL
    ratio = (CEILING_SPL - knee) / (KNEE_SPL + 70.0 / normal_ratio + outer - knee)
    return HairCells(outer, bandwidth, knee, ratio, inner)


@compute_once
def _control_bandwidth(device: torch.device) -> Tensor:
    """Return the bandwidth of the control filters relative to normal hearing. Shape: (32,)."""
    return hair_cells(torch.full((8,), CONTROL_LOSS, device=device)).bandwidth


def channel_chunks(sound: Tensor) -> Iterator[slice]:
    """Split the 32 channels into groups that fit into the caches of a CPU, or into a GPU's memory.

    Args:
        sound: Sound that is divided into channels. Shape: (items, time).

    Yields:
        Channels of each group, from low to high frequencies.

    >>> len(list(channel_chunks(torch.zeros(1, 48000))))
    4
    """
    size = CPU_CHUNK if sound.device.type == "cpu" else GPU_CHUNK
    step = min(CHANNELS, max(1, size // sound.numel()))
    step = -(-CHANNELS // -(-CHANNELS // step))  # chunks of equal size
    return (slice(start, min(start + step, CHANNELS)) for start in range(0, CHANNELS, step))


# -- filters and compression -----------------------------------------------------------------------


def _decay(bandwidth: Tensor, channels: slice) -> Tensor:
    """Convert the bandwidth of gammatones to their decay in nepers per sample at 24 kHz.

    Args:
        bandwidth: Bandwidths relative to normal hearing. Shape: (..., channels).
        channels: Range of these channels among the 32 of the ear.

    Returns:
        Decays. Shape: (..., channels).
    """
    return bandwidth * _normal_decay(like=bandwidth)[channels]


def _gammatones(bandwidth: Tensor, channels: slice, dtype: torch.dtype) -> Recursion:
    """Design the gammatone filters of some channels.

    Args:
        bandwidth: Bandwidths relative to normal hearing. Shape: (channels,) if all items have the
            same ones, otherwise (items, channels).
        channels: Range of these channels among the 32 of the ear.
        dtype: Precision of the filters.

    Returns:
        Filters, whose leading dimensions are those of ``bandwidth``.
    """
    centres = centre_frequencies(like=bandwidth)[channels]
    # The response of normal and wider filters has vanished after this number of samples.
    memory = math.ceil(50.0 / float(_normal_decay()[channels.start]))
    angles = centres * (2.0 * math.pi / RATE)
    return gammatone(_decay(bandwidth, channels), angles, memory, dtype)


@compute_once
def _control_filters(start: int, stop: int, device: torch.device, dtype: torch.dtype) -> Recursion:
    """Design the wide filters that measure the level in the channels ``[start, stop)``.

    The range is two numbers, because arguments of ``compute_once`` must be hashable.
    """
    channels = slice(start, stop)
    return _gammatones(_control_bandwidth(device)[channels], channels, dtype)


def _apply_gammatones(filters: Recursion, signal: Tensor) -> tuple[Tensor, Tensor]:
    """Filter signals by gammatones, and return the real part and the power of the envelope.

    Args:
        filters: Gammatones of the channels, (channels,), or, for two or more items, of each item,
            (items, channels).
        signal: Signals. Shape: (items, padded).

    Returns:
        Real part and power. Shape of each: (items, channels, padded).
    """
    # Torch rounds products of tensors with a dimension for items differently.
    parts = filters(signal) if len(signal) == 1 else filters(signal[:, None])
    shape = len(signal), -1, signal.shape[-1]
    real, imaginary = (part.reshape(shape) for part in parts)
    return real, (real * real).addcmul_(imaginary, imaginary)


def _control_power(signal: Tensor, channels: slice) -> Tensor:
    """Compute the power of the envelopes of the control filters, whose level decides on the gain.

    Shape: (items, padded) -> (items, channels, padded), where 1 is an amplitude of 20 uPa.
    """
    filters = _control_filters(channels.start, channels.stop, signal.device, signal.dtype)
    return _apply_gammatones(filters, signal)[1]


def _bandwidths(control: Tensor, cells: HairCells, channels: slice, extent: Extent) -> Tensor:
    """Compute the bandwidths of the filters relative to normal hearing; they grow with the level.

    Up to a mean level of 50 dB SPL in the control filter, the bandwidth is that of the hair cells,
    and from 100 dB SPL on that of the control filter. In between it is linear in dB.

    Args:
        control: Power of the control filters' envelopes, 1 at 0 dB SPL. Shape: (items, channels,
            padded).
        cells: Hair cells of these channels.
        channels: Range of these channels among the 32 of the ear.
        extent: Number of samples of each item before padding.

    Returns:
        Bandwidths, float64. Shape: (items, channels).
    """
    mean = extent.mean(control).double()
    level = 10.0 * torch.log10(mean.clamp_min(10.0 ** (WIDENING_SPL / 10.0)))
    share = ((level - WIDENING_SPL) / WIDENING_SPL).clamp_max(1.0)
    return cells.bandwidth + share * (
        _control_bandwidth(control.device)[channels] - cells.bandwidth
    )


@dataclass(frozen=True)
class CochlearOutput:
    """Response of the inner ear to a sound in some channels, before the inner hair cells.

    Attributes:
        power: Power of the envelope after compression, where 1 is 0 dB SPL. Shape: (items,
            channels, padded).
        bandwidth: Bandwidth of the filters, relative to normal hearing. Shape: (items, channels),
            float64.
        motion: Compressed motion of the basilar membrane, in multiples of 20 uPa. Shape: (items,
            channels, padded).
        level: Long-term level in dB over threshold, 0 or more. Shape: (items, channels).

    ``motion`` and ``level`` are empty unless they were requested.

    >>> ear = hair_cells(torch.zeros(8))
    >>> cochlea = simulate_cochlea(torch.zeros(1, 128), ear, slice(0, 3), Extent((128,)))
    >>> cochlea.power.shape
    torch.Size([1, 3, 128])
    """

    power: Tensor
    bandwidth: Tensor
    motion: Tensor
    level: Tensor


def simulate_cochlea(
    signal: Tensor, ear: HairCells, channels: slice, extent: Extent, *, motion: bool = False
) -> CochlearOutput:
    """Filter and compress a sound in some channels, as the cochlea with its outer hair cells does.

    Args:
        signal: Sound behind the middle ear at 24 kHz, in multiples of 20 uPa. Shape: (items,
            padded), where ``padded`` is a multiple of 64 samples.
        ear: Hair cells of all channels. Shape: (items, 32) or (32,).
        channels: Channels to compute, with a start and a stop.
        extent: Number of samples at 24 kHz of each item without its padding.
        motion: Whether to return the motion of the basilar membrane and the long-term level, which
            are empty otherwise.

    Returns:
        Response of the channels, with the shapes that ``CochlearOutput`` describes.

    >>> signal, ear = torch.zeros(1, 128), hair_cells(torch.zeros(8))
    >>> cochlea = simulate_cochlea(signal, ear, slice(0, 3), Extent((128,)), motion=True)
    >>> cochlea.motion.shape, cochlea.level
    (torch.Size([1, 3, 128]), tensor([[0., 0., 0.]]))
    """
    cells = ear[..., channels]
    control = _control_power(signal, channels)
    bandwidth = _bandwidths(control, cells, channels, extent)
    filters = _gammatones(bandwidth.squeeze(0), channels, signal.dtype)
    real, power = _apply_gammatones(filters, signal)
    gain = _compression_gain(control, cells)
    compressed = (power * gain).mul_(gain)
    if not motion:
        empty = compressed.new_empty(0)
        return CochlearOutput(compressed, bandwidth, empty, empty)
    level = _long_term_level(extent.mean(power), extent.mean(control), cells)
    return CochlearOutput(compressed, bandwidth, real * gain, level)


def _compression_gain(control: Tensor, cells: HairCells) -> Tensor:
    """Compute the gain of the outer hair cells, a factor for amplitudes that is smoothed in time.

    Args:
        control: Power of the control filters' envelopes. Shape: (items, channels, padded).
        cells: Hair cells of these channels.

    Returns:
        Gains. Shape: (items, channels, padded).
    """
    knee, ratio, loss = (
        field.to(control).unsqueeze(-1) for field in (cells.knee, cells.ratio, cells.outer)
    )
    # Clamping by a tensor and a number takes a fifth of the time of clamping by two tensors, and
    # operations in place save memory, whose first use is slow.
    level = torch.maximum(control, 10.0 ** (knee / 10.0))
    level = level.clamp_max_(10.0 ** (CEILING_SPL / 10.0)).log_()
    # The gain in nepers is -loss - (level - knee) (1 - 1 / ratio).
    exponent = 0.5 * (1.0 / ratio - 1.0)
    neper = math.log(10.0) / 20.0
    gain = level.mul_(exponent).sub_(neper * (loss + 2.0 * exponent * knee)).exp_()
    return apply_filter(gain_lowpass, gain)


def _long_term_level(mean_power: Tensor, mean_control: Tensor, cells: HairCells) -> Tensor:
    """Compute the level of each channel over the whole signal, in dB over threshold.

    Args:
        mean_power: Mean power of the envelopes before compression, where 1 is 0 dB SPL. Shape:
            (items, channels).
        mean_control: Mean power of the control filters' envelopes. Shape: (items, channels).
        cells: Hair cells of these channels.

    Returns:
        Levels of 0 dB or more. Shape: (items, channels).
    """
    knee = 10.0 ** (cells.knee / 10.0)
    control = torch.maximum(mean_control.double().clamp_max(10.0 ** (CEILING_SPL / 10.0)), knee)
    gain = -cells.outer - (10.0 * torch.log10(control) - cells.knee) * (1.0 - 1.0 / cells.ratio)
    level = 10.0 * torch.log10(mean_power.double().clamp_min(1.0))
    return (level + gain - cells.inner).clamp_min(0.0).to(mean_power.dtype)


# -- inner hair cells ------------------------------------------------------------------------------


def nerve_levels(power: Tensor, inner: Tensor) -> Tensor:
    """Compute the levels that the inner hair cells pass to the auditory nerve.

    The hair cells subtract their loss from the level, and emphasise onsets by adaptation.

    Args:
        power: Power of the compressed envelopes, where 1 is 0 dB SPL. Shape: (items, channels,
            padded).
        inner: Loss of the inner hair cells in dB. Shape: (items, channels) or (channels,).

    Returns:
        Levels in dB over threshold, 0 or more. Shape: (items, channels, padded).

    >>> levels = nerve_levels(torch.full((1, 1, 12800), 1e4), torch.tensor([10.0]))
    >>> levels[0, 0, [0, -1]].round()
    tensor([60., 30.])
    """
    loss = inner.to(power).unsqueeze(-1)
    level = torch.maximum(power, 10.0 ** (loss / 10.0)).log_().mul_(10.0 / math.log(10.0))
    return apply_filter(adaptation, level.sub_(loss)).clamp_min_(0.0)


def group_delays(bandwidth: Tensor, channels: slice) -> Tensor:
    """Compute the group delay of each channel's filter at its centre frequency in whole samples.

    Args:
        bandwidth: Bandwidths of the filters, relative to normal hearing. Shape: (items, channels).
        channels: Range of these channels among the 32 of the ear.

    Returns:
        Delays in samples at 24 kHz. Shape: (items, channels), int64.

    >>> group_delays(torch.ones(1, 2), slice(0, 2))
    tensor([[449, 404]])
    """
    # the delay at 0 Hz, because pyclarity shifts each channel to 0 Hz before it filters
    pole = torch.exp(-_decay(bandwidth.detach(), channels))
    return (4.0 * pole / (1.0 + 2.0 * pole) + 4.0 * pole / (1.0 - pole)).round().long()


def longest_group_delay(signal: Tensor, ear: HairCells, extent: Extent) -> Tensor:
    """Compute the longest group delay of all channels for each item.

    The scores delay all other channels by the difference, so that the channels are synchronous. The
    longest delay is that of the narrowest filter, which is one of the first three: the first filter
    widens by a factor of 1.28 at most, and the fourth is at least 1.37 times as wide as the first
    one in a normal ear.

    Args:
        signal: Sound behind the middle ear, in multiples of 20 uPa at 24 kHz. Shape: (items,
            padded).
        ear: Hair cells of all channels.
        extent: Number of samples of each item before padding.

    Returns:
        Delay in samples at 24 kHz. Shape: (items, 1), int64.

    >>> longest_group_delay(torch.zeros(1, 128), hair_cells(torch.zeros(8)), Extent((128,)))
    tensor([[449]])
    """
    lowest = slice(0, 3)
    control = _control_power(signal, lowest)
    bandwidth = _bandwidths(control, ear[..., lowest], lowest, extent)
    return group_delays(bandwidth, lowest).amax(-1, keepdim=True)
