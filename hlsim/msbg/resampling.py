"""The way into the cochlea and out of it, with resampling on the same FFT grids.

Where two rates meet, the lower one's spectrum ends softly, and so with nothing at half that rate, a frequency that the
higher one has twice.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.fft import fade_out_weights, fft_length, rfft
from hlsim.dsp.fir import BLOCK_POINTS, filter_in_blocks
from hlsim.msbg.cochlea import shared_multiple
from hlsim.msbg.ear import EAR_DELAY, MSBG_RATE, ear_filter, lowpass_filter
from hlsim.torchtools import constant_like

_FIR_TAIL = 2 * EAR_DELAY + 132  # with the low-pass on the way out


def to_cochlea(signals: Tensor, rate: int, length: int, step: int) -> Tensor:
    """Resample to 44.1 kHz / step and pass outer and middle ear. Shape: (items, time) -> (items, length)."""
    if rate == MSBG_RATE and step == 1:
        return filter_in_blocks(signals, constant_like(signals, _inward_blocks), length)
    up, down = _ratio(rate, step)
    least = max(signals.shape[-1], math.ceil(length * down / up)) + math.ceil(
        _FIR_TAIL * down / up / step
    )
    outer, inner = _grid(least, up, down)
    bins = min(outer, inner) // 2 + 1
    response = constant_like(signals, _inward, inner * step, bins, up / down, rate)
    return torch.fft.irfft(rfft(signals, outer)[..., :bins] * response, inner)[..., :length]


def from_spectrum(
    spectrum: Tensor, points: int, step: int, rate: int, samples: int, *, gain: float, delay: int
) -> Tensor:
    """Back out of the ear, low-pass, advance by ``delay`` and return to ``rate``, from the cochlea's spectrum.

    Shape: (items, points // (2 step) + 1) -> (items, samples).

    Args:
        gain: factor on all of it.
        points: FFT length at 44.1 kHz of the spectrum.
        step: the spectrum is of a signal at 44.1 kHz / step.
        delay: samples at 44.1 kHz.
    """
    inner, outer = points // step, points * rate // MSBG_RATE
    if not shared_multiple(rate, step):
        heard = torch.fft.irfft(spectrum, inner)
        return from_cochlea(heard, rate, samples, gain=gain, step=step, delay=delay)
    bins = min(inner, outer) // 2 + 1
    response = constant_like(spectrum, _outward, points, delay, bins, gain * outer / inner, rate)
    return torch.fft.irfft(spectrum[..., :bins] * response, outer)[..., :samples]


def from_cochlea(
    heard: Tensor, rate: int, samples: int, *, gain: float, step: int = 1, delay: int = 0
) -> Tensor:
    """``from_spectrum`` of a waveform. Shape: (items, length) -> (items, samples)."""
    up, down = _ratio(rate, step)
    outer, inner = _grid(math.ceil((heard.shape[-1] + _FIR_TAIL) * down / up), up, down)
    bins = min(outer, inner) // 2 + 1
    response = constant_like(heard, _outward, inner * step, delay, bins, gain * down / up, rate)
    return torch.fft.irfft(rfft(heard, inner)[..., :bins] * response, outer)[..., :samples]


def to_inner(signals: Tensor, rate: int) -> Tensor:
    """Resample to 44.1 kHz. Shape: (items, time) -> (items, ceil(time * 44100 / rate))."""
    if rate == MSBG_RATE:
        return signals
    up, down = _ratio(rate, 1)
    outer, inner = _grid(signals.shape[-1], up, down)
    bins = min(outer, inner) // 2 + 1
    response = constant_like(signals, _resampling, inner, bins, up / down, rate)
    heard = torch.fft.irfft(rfft(signals, outer)[..., :bins] * response, inner)
    return heard[..., : math.ceil(signals.shape[-1] * up / down)]


def _inward_blocks() -> NDArray[np.complex128]:
    """The way in for ``filter_in_blocks``."""
    return np.fft.rfft(ear_filter(), BLOCK_POINTS)


def _inward(points: int, bins: int, gain: float, rate: int) -> NDArray[np.complex128]:
    """The way in, on an FFT grid of ``points`` at 44.1 kHz. Returns (bins,)."""
    return gain * np.fft.rfft(ear_filter(), points)[:bins] * _end(points, bins, rate)


def _outward(points: int, delay: int, bins: int, gain: float, rate: int) -> NDArray[np.complex128]:
    """The way out with the low-pass, ahead by ``delay``. Returns (bins,)."""
    response = np.fft.rfft(ear_filter(backward=True), points) * np.fft.rfft(
        lowpass_filter(), points
    )
    advance = np.exp(2j * np.pi * np.arange(bins) * delay / points)
    return gain * response[:bins] * advance * _end(points, bins, rate)


def _resampling(points: int, bins: int, gain: float, rate: int) -> NDArray[np.float64]:
    """No filter but the end of the lower rate's band. Returns (bins,)."""
    return gain * _end(points, bins, rate)


def _end(points: int, bins: int, rate: int) -> NDArray[np.float64]:
    """How the spectrum ends where a signal's rate is not the model's."""
    if rate == MSBG_RATE:
        return np.ones(bins)
    return fade_out_weights(bins, MSBG_RATE / points, min(rate, MSBG_RATE) / 2)


def _ratio(rate: int, step: int) -> tuple[int, int]:
    """Smallest whole numbers in proportion to 44.1 kHz / step and ``rate``."""
    common = math.gcd(MSBG_RATE // step, rate)
    return MSBG_RATE // step // common, rate // common


def _grid(samples: int, up: int, down: int) -> tuple[int, int]:
    """FFT lengths at ``down`` and at ``up`` that span the same time, at least ``samples`` at ``down``."""
    parts = fft_length(math.ceil(samples / down), 4)
    return parts * down, parts * up
