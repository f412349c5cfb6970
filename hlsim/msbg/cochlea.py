"""The nonlinear half of MSBG: gammatone filter bank and recruitment, each channel at the rate it needs."""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.fft import fft_length, rfft
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import (
    HALF_RATE_STEP,
    STEP,
    decimate,
    detect,
    envelope,
    envelope_lowpass,
    smooth,
)
from hlsim.msbg.filterbank import FilterBank, gammatone_response
from hlsim.msbg.filtfilt_end import ending, ending_response, ending_weights
from hlsim.msbg.multirate import MultirateBank, RateBand
from hlsim.msbg.recruitment import around, expand, gains, weigh
from hlsim.torchtools import constant_like

BANK_TAIL = 3200
"""Samples, 73 ms: the longest advance, and what it takes the narrowest channel to decay by 80 dB."""

_SHARED_MULTIPLE = 10000
"""Samples up to which the lengths that a rate shares with 44.1 kHz may be multiples of."""


def bank_points(length: int, rate: int, step: int = 1) -> int:
    """FFT length at 44.1 kHz for a signal of ``length``: one that ``rate`` shares, if that costs little.

    Args:
        step: the signal runs at 44.1 kHz / step.
    """
    multiple = shared_multiple(rate, step) or _whole_steps(step)
    odd, even = (fft_length(length + BANK_TAIL, some) for some in (multiple, 2 * multiple))
    # MKL takes twice as long for odd numbers of steps, but few of its transforms are of steps
    return odd if 1.1 * odd < even else even


def shared_multiple(rate: int, step: int = 1) -> int:
    """Samples at 44.1 kHz, whole steps of the envelopes, that are a whole number of ``rate``'s; 0 if too many."""
    multiple = math.lcm(_whole_steps(step), MSBG_RATE // math.gcd(MSBG_RATE, rate))
    return multiple if multiple <= _SHARED_MULTIPLE else 0


def _whole_steps(step: int) -> int:
    """Samples at 44.1 kHz that are whole steps of the envelopes, and an even number at 44.1 kHz / step."""
    return STEP if step == 1 else round(8 * HALF_RATE_STEP)


def hear(spectrum: Tensor, ratios: Tensor, bank: MultirateBank, slight: bool) -> Tensor:
    """Filter bank and recruitment of a periodic signal.

    Shape: (items, points // (2 step) + 1), (items, channels) -> as the first, where points and step are the bank's.

    Args:
        slight: look after the kinks of slight losses, which a smeared signal buries.
    """
    waves, sums = zip(*(filter_and_rectify(spectrum, band) for band in bank.bands), strict=True)
    envelopes = smooth(torch.cat(sums, -3), bank.lowpass)
    ratios = ratios[..., : len(bank.lowpass)]
    recruitment = around(gains(envelopes, ratios))
    heard: dict[tuple[int, bool], Tensor] = {}
    for band, wave in zip(bank.bands, waves, strict=True):
        channels, kind = band.channels, (band.points, band.detector == "modulus")
        kinks = (envelopes[..., channels, :], ratios[..., channels]) if slight else None
        part = weigh(wave, recruitment[..., channels, :], band.interpolation, kinks)
        heard[kind] = heard[kind] + part if kind in heard else part
    return recombine(heard, spectrum)


def filter_and_rectify(spectrum: Tensor, band: RateBand) -> tuple[Tensor, Tensor]:
    """A rate band's channels as signals, analytic ones with their parts in turn, and for ``smooth`` their rectified sums.

    Shape: (items, bins) -> (items, channels, points or 2 points), (items, channels, 3, steps).
    """
    bins = spectrum[..., None, : band.response.shape[-1]] * band.response
    if band.detector == "itself":
        wave = torch.fft.irfft(bins, band.points)
        return wave, decimate(wave.abs(), band.decimation)
    both = torch.fft.ifft(bins, band.points)
    rectified = detect(both, harmonics=band.detector == "harmonics")
    wave = torch.view_as_real(both).flatten(-2) if band.detector == "modulus" else both.real
    return wave, decimate(rectified, band.decimation)


def recombine(heard: dict[tuple[int, bool], Tensor], like: Tensor) -> Tensor:
    """The spectrum of the sum of signals at several rates, by their FFT lengths and whether they are analytic.

    Shape: (items, time) each, ``like`` (items, bins) -> as ``like``.
    """
    total = torch.zeros_like(like)
    for (points, analytic), part in heard.items():
        if analytic:
            bins = torch.fft.fft(torch.view_as_complex(part.unflatten(-1, (-1, 2))))
        else:
            bins = rfft(part, points)
        total[..., : bins.shape[-1]].add_(bins[..., : total.shape[-1]])
    return total


def hear_ending(heard: Tensor, ratios: Tensor, bank: FilterBank) -> Tensor:
    """Filter bank and recruitment of a signal that ends as the reference's do, all channels at 44.1 kHz.

    Shape: (items, time), (items, channels) -> (items, time).
    """
    length = heard.shape[-1]
    points = fft_length(length + BANK_TAIL, 2 * STEP)
    spectrum = rfft(heard, points).unsqueeze(-2) * constant_like(
        heard, gammatone_response, bank, points
    )
    channels = torch.fft.irfft(spectrum, points) * constant_like(
        heard, _not_advanced, bank, points, length
    )
    weights = constant_like(heard, ending_weights, bank)
    response = constant_like(heard, ending_response, bank, (length - 1) % STEP + 1)
    envelopes = envelope(channels, constant_like(heard, envelope_lowpass, bank, points))
    envelopes = envelopes + ending(channels, weights, response, length)
    return expand(channels, envelopes, ratios)[..., :length]


def _not_advanced(bank: FilterBank, points: int, length: int) -> NDArray[np.bool]:
    """The advance has nothing to bring in at the end, where the reference puts zeros. Returns (channels, points)."""
    return np.arange(points) < length - np.array(bank.advances)[:, None]
