"""The nonlinear half of MSBG: gammatone filter bank and recruitment, each channel at the rate it needs."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.msbg.ear import RATE
from hlsim.msbg.ending import ending
from hlsim.msbg.filterbank import BANKS
from hlsim.msbg.filters import Filters
from hlsim.msbg.fourier import fft_length, irfft, rfft
from hlsim.msbg.recruitment import (
    STEP,
    around,
    decimate,
    envelope,
    expand,
    expansion_ratios,
    gains,
    is_slight,
    rectify,
    smooth,
    weigh,
)
from hlsim.msbg.tiers import Plan

BANK_TAIL = 3200
"""Samples, 73 ms: the longest advance, and what it takes the narrowest channel to decay by 80 dB."""

_SHARED_MULTIPLE = 10000
"""Samples up to which the lengths that a rate shares with 44.1 kHz may be multiples of."""


@dataclass(frozen=True)
class Kind:
    """Ears that are simulated together, and what is known of them without asking the device.

    Attributes:
        none: they hear everything at its level: 0 dB HL throughout.
        slight: of each channel, whether an ear expands it a little.
    """

    severity: str
    none: bool
    slight: tuple[bool, ...]

    @classmethod
    def of(cls, severity: str, thresholds: Tensor, none: bool) -> "Kind":
        """Shape: (items, 8) dB HL, on the CPU."""
        slight = is_slight(expansion_ratios(thresholds, BANKS[severity])).any(0)
        return cls(severity, none, tuple(slight.tolist()))


def bank_points(length: int, rate: int) -> int:
    """FFT length at 44.1 kHz for a signal of ``length``: one that ``rate`` shares, if that costs little."""
    multiple = shared_multiple(rate) or 2 * STEP
    return fft_length(length + BANK_TAIL, multiple)


def shared_multiple(rate: int) -> int:
    """Samples at 44.1 kHz, a multiple of 16, that are a whole number of ``rate``'s; 0 if too many."""
    if rate == RATE:
        return 2 * STEP
    multiple = math.lcm(STEP, RATE // math.gcd(RATE, rate))
    return multiple if multiple <= _SHARED_MULTIPLE else 0


def hear(spectrum: Tensor, ratios: Tensor, plan: Plan, kind: Kind) -> Tensor:
    """Filter bank and recruitment of a periodic signal.

    Shape: (items, points // (2 step) + 1), (items, channels) -> as the first, where points and step are the plan's.
    """
    if kind.none:
        return spectrum * plan.total
    waves, slow = [], []
    for tier in plan.tiers:
        bins = spectrum[..., : tier.points // 2 + 1].unsqueeze(-2)
        if tier.series is None:
            wave = torch.fft.irfft(bins * tier.response, tier.points)
            rectified = wave.abs()
        else:
            both = torch.fft.irfft(bins.unsqueeze(-3) * tier.response, tier.points)
            wave, quadrature = both.unbind(-3)
            rectified = rectify(wave, quadrature, tier.series)
        waves.append(wave)
        slow.append(decimate(rectified, tier.decimation))
    envelopes = smooth(torch.cat(slow, -2), plan.lowpass)
    gain = around(gains(envelopes, ratios))

    total: Tensor | None = None
    for tier, wave in zip(reversed(plan.tiers), reversed(waves), strict=True):
        own = tier.channels
        slight = any(kind.slight[own])
        summed = weigh(
            wave,
            gain[..., own, :, :],
            tier.interpolation,
            envelopes[..., own, :] if slight else None,
            ratios[..., own] if slight else None,
        )
        part = rfft(summed, tier.points) * (tier.step / plan.step)
        if total is None:
            total = part
        else:
            total = total + functional.pad(part, (0, total.shape[-1] - part.shape[-1]))
    assert total is not None
    return total


def hear_ending(heard: Tensor, ratios: Tensor, kind: Kind, filters: Filters) -> Tensor:
    """Filter bank and recruitment of a signal that ends as the reference's do, all channels at 44.1 kHz.

    Shape: (items, time), (items, channels) -> (items, time).
    """
    length, severity = heard.shape[-1], kind.severity
    points = fft_length(length + BANK_TAIL, 2 * STEP)
    spectrum = rfft(heard, points).unsqueeze(-2) * filters.get("bank", severity, points)
    channels = irfft(spectrum, points) * filters.get("kept", severity, points, length)
    weights = filters.get("ending weights", severity)
    response = filters.get("ending response", severity, (length - 1) % STEP + 1)
    envelopes = envelope(channels, filters.get("lowpass", severity, points))
    envelopes = envelopes + ending(channels, weights, response, length)
    return expand(channels, envelopes, ratios, any(kind.slight))[..., :length]
