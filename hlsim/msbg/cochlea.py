"""The nonlinear half of MSBG: gammatone filter bank and recruitment, each channel at the rate it needs."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.msbg.ear import RATE
from hlsim.msbg.ending import ending
from hlsim.msbg.filters import Filters
from hlsim.msbg.fourier import fft_length, irfft, rfft
from hlsim.msbg.recruitment import (
    STEP,
    around,
    decimate,
    envelope,
    expand,
    gains,
    rectify,
    smooth,
    weigh,
)
from hlsim.msbg.tiers import Plan

BANK_TAIL = 3200
"""Samples, 73 ms: the longest advance, and what it takes the narrowest channel to decay by 80 dB."""

_SHARED_MULTIPLE = 10000
"""Samples up to which the lengths that a rate shares with 44.1 kHz may be multiples of."""


def bank_points(length: int, rate: int) -> int:
    """FFT length at 44.1 kHz for a signal of ``length``: one that ``rate`` shares, if that costs little."""
    multiple = 2 * (shared_multiple(rate) or STEP)  # MKL takes twice as long for odd numbers of steps
    return fft_length(length + BANK_TAIL, multiple)


def shared_multiple(rate: int) -> int:
    """Samples at 44.1 kHz, a multiple of 16, that are a whole number of ``rate``'s; 0 if too many."""
    multiple = math.lcm(STEP, RATE // math.gcd(RATE, rate))
    return multiple if multiple <= _SHARED_MULTIPLE else 0


def hear(spectrum: Tensor, ratios: Tensor, plan: Plan, slight: bool) -> Tensor:
    """Filter bank and recruitment of a periodic signal.

    Shape: (items, points // (2 step) + 1), (items, channels) -> as the first, where points and step are the plan's.

    Args:
        slight: look after the kinks of slight losses, which a smeared signal buries.
    """
    waves, sums = [], []
    for tier in plan.tiers:
        bins = spectrum[..., None, : tier.points // 2 + 1]
        if tier.series is None:
            wave = torch.fft.irfft(bins * tier.response, tier.points)
            rectified = wave.abs()
        else:
            both = torch.fft.irfft(bins.unsqueeze(-3) * tier.response, tier.points)
            wave, quadrature = both.unbind(-3)
            rectified = rectify(wave, quadrature, tier.series)
        waves.append(wave)
        sums.append(decimate(rectified, tier.decimation))
    envelopes = smooth(torch.cat(sums, -3), plan.lowpass)
    gain = around(gains(envelopes, ratios))

    heard: dict[int, Tensor] = {}
    for tier, wave in zip(plan.tiers, waves, strict=True):
        own = tier.channels
        kinks = (envelopes[..., own, :], ratios[..., own]) if slight else None
        part = weigh(wave, gain[..., own, :, :], tier.interpolation, kinks)
        heard[tier.step] = heard[tier.step] + part if tier.step in heard else part
    count = plan.points // plan.step // 2 + 1
    parts = [rfft(part, part.shape[-1]) * (step / plan.step) for step, part in heard.items()]
    return torch.stack([functional.pad(part, (0, count - part.shape[-1])) for part in parts]).sum(0)


def hear_ending(heard: Tensor, ratios: Tensor, severity: str, filters: Filters) -> Tensor:
    """Filter bank and recruitment of a signal that ends as the reference's do, all channels at 44.1 kHz.

    Shape: (items, time), (items, channels) -> (items, time).
    """
    length = heard.shape[-1]
    points = fft_length(length + BANK_TAIL, 2 * STEP)
    spectrum = rfft(heard, points).unsqueeze(-2) * filters.get("bank", severity, points)
    channels = irfft(spectrum, points) * filters.get("kept", severity, points, length)
    weights = filters.get("ending weights", severity)
    response = filters.get("ending response", severity, (length - 1) % STEP + 1)
    envelopes = envelope(channels, filters.get("lowpass", severity, points))
    envelopes = envelopes + ending(channels, weights, response, length)
    return expand(channels, envelopes, ratios)[..., :length]
