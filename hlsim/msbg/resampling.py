"""The way into the cochlea and out of it, with resampling on the same FFT grids.

Where two rates meet, the spectrum at the lower rate fades out towards its Nyquist frequency, and is
0 at this frequency. The spectrum at the higher rate has this frequency twice.
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

_FIR_TAIL = 2 * EAR_DELAY + 132
"""Samples at 44.1 kHz by which the filters of the way out lengthen a signal."""


def to_cochlea(signals: Tensor, rate: int, length: int, step: int) -> Tensor:
    """Resample signals and filter them with the outer and the middle ear.

    Shape: (items, time) -> (items, length).

    Args:
        rate: Sample rate of the signals in Hz.
        length: Number of samples of the result.
        step: 1 for a result at 44.1 kHz, 2 for a result at 22.05 kHz.

    >>> to_cochlea(torch.randn(2, 16000), rate=16000, length=44100, step=1).shape
    torch.Size([2, 44100])
    """
    if rate == MSBG_RATE and step == 1:
        return filter_in_blocks(signals, constant_like(signals, _inward_block_response), length)
    up, down = _ratio(rate, step)
    tail = math.ceil(_FIR_TAIL * down / up / step)
    samples = max(signals.shape[-1], math.ceil(length * down / up)) + tail
    outer_points, inner_points = _fft_grid(samples, up, down)
    bins = min(outer_points, inner_points) // 2 + 1
    gain = up / down
    response = constant_like(signals, _inward_response, inner_points * step, bins, gain, rate)
    spectrum = rfft(signals, outer_points)[..., :bins] * response
    return torch.fft.irfft(spectrum, inner_points)[..., :length]


def from_spectrum(
    spectrum: Tensor, points: int, step: int, rate: int, samples: int, *, gain: float, delay: int
) -> Tensor:
    """Compute the output of MSBG from the spectrum of the cochlea's output.

    The way out filters with the inverse of the ear and the low-pass, removes the delay and
    resamples.

    Shape: complex (items, points // (2 * step) + 1) -> (items, samples).

    Args:
        points: FFT length of the spectrum, in samples at 44.1 kHz.
        step: 1 for the spectrum of a signal at 44.1 kHz, 2 for that of a signal at 22.05 kHz.
        rate: Sample rate of the result in Hz.
        samples: Number of samples of the result.
        gain: Linear gain of the result.
        delay: Samples at 44.1 kHz by which the result is advanced.

    >>> spectrum = torch.fft.rfft(torch.randn(1, 49392))
    >>> from_spectrum(spectrum, 49392, 1, 16000, 16000, gain=1.0, delay=1047).shape
    torch.Size([1, 16000])
    """
    inner_points = points // step
    if not shared_multiple(rate, step):
        waveform = torch.fft.irfft(spectrum, inner_points)
        return from_cochlea(waveform, rate, samples, gain=gain, step=step, delay=delay)
    outer_points = points * rate // MSBG_RATE
    bins = min(inner_points, outer_points) // 2 + 1
    total_gain = gain * outer_points / inner_points
    response = constant_like(spectrum, _outward_response, points, delay, bins, total_gain, rate)
    return torch.fft.irfft(spectrum[..., :bins] * response, outer_points)[..., :samples]


def from_cochlea(
    waveform: Tensor, rate: int, samples: int, *, gain: float, step: int = 1, delay: int = 0
) -> Tensor:
    """Compute the output of MSBG from the cochlea's output.

    Shape: (items, length) -> (items, samples).

    Args:
        rate: Sample rate of the result in Hz.
        samples: Number of samples of the result.
        gain: Linear gain of the result.
        step: 1 for a waveform at 44.1 kHz, 2 for a waveform at 22.05 kHz.
        delay: Samples at 44.1 kHz by which the result is advanced.

    >>> from_cochlea(torch.randn(1, 44100), rate=16000, samples=16000, gain=1.0).shape
    torch.Size([1, 16000])
    """
    up, down = _ratio(rate, step)
    outer_samples = math.ceil((waveform.shape[-1] + _FIR_TAIL) * down / up)
    outer_points, inner_points = _fft_grid(outer_samples, up, down)
    bins = min(outer_points, inner_points) // 2 + 1
    points = inner_points * step
    total_gain = gain * down / up
    response = constant_like(waveform, _outward_response, points, delay, bins, total_gain, rate)
    spectrum = rfft(waveform, inner_points)[..., :bins] * response
    return torch.fft.irfft(spectrum, outer_points)[..., :samples]


def resample_to_model_rate(signals: Tensor, rate: int) -> Tensor:
    """Resample signals to 44.1 kHz. Shape: (items, time) -> (items, ceil(time * 44100 / rate)).

    Args:
        rate: Sample rate of the signals in Hz.

    >>> resample_to_model_rate(torch.randn(2, 1600), rate=16000).shape
    torch.Size([2, 4410])
    """
    if rate == MSBG_RATE:
        return signals
    up, down = _ratio(rate, 1)
    outer_points, inner_points = _fft_grid(signals.shape[-1], up, down)
    bins = min(outer_points, inner_points) // 2 + 1
    response = constant_like(signals, _resampling_response, inner_points, bins, up / down, rate)
    spectrum = rfft(signals, outer_points)[..., :bins] * response
    resampled = torch.fft.irfft(spectrum, inner_points)
    return resampled[..., : math.ceil(signals.shape[-1] * up / down)]


def _inward_block_response() -> NDArray[np.complex128]:
    """Response of outer and middle ear for ``filter_in_blocks``."""
    return np.fft.rfft(ear_filter(), BLOCK_POINTS)


def _inward_response(points: int, bins: int, gain: float, rate: int) -> NDArray[np.complex128]:
    """Compute the response of outer and middle ear with a gain.

    Args:
        points: FFT length at 44.1 kHz.
        rate: Sample rate in Hz from which signals are resampled.

    Returns: Response of shape (bins,).
    """
    return gain * np.fft.rfft(ear_filter(), points)[:bins] * _band_end(points, bins, rate)


def _outward_response(
    points: int, delay: int, bins: int, gain: float, rate: int
) -> NDArray[np.complex128]:
    """Compute the response of the inverse ear and the low-pass with a gain and an advance.

    Args:
        points: FFT length at 44.1 kHz.
        delay: Samples at 44.1 kHz by which signals are advanced.
        rate: Sample rate in Hz to which signals are resampled.

    Returns: Response of shape (bins,).
    """
    inverse_ear = np.fft.rfft(ear_filter(backward=True), points)
    response = inverse_ear * np.fft.rfft(lowpass_filter(), points)
    advance = np.exp(2j * np.pi * np.arange(bins) * delay / points)
    return gain * response[:bins] * advance * _band_end(points, bins, rate)


def _resampling_response(points: int, bins: int, gain: float, rate: int) -> NDArray[np.float64]:
    """Compute the response of resampling alone, with a gain. Returns (bins,)."""
    return gain * _band_end(points, bins, rate)


def _band_end(points: int, bins: int, rate: int) -> NDArray[np.float64]:
    """Compute weights that fade a spectrum out at the lower Nyquist frequency.

    They are 1 where nothing is resampled.

    Args:
        points: FFT length at 44.1 kHz.
        rate: Sample rate in Hz of signals outside the model.

    Returns: Weights of shape (bins,).
    """
    if rate == MSBG_RATE:
        return np.ones(bins)
    return fade_out_weights(bins, MSBG_RATE / points, min(rate, MSBG_RATE) / 2)


def _ratio(rate: int, step: int) -> tuple[int, int]:
    """Smallest whole numbers in proportion to the rate inside the model and to ``rate``."""
    inner_rate = MSBG_RATE // step
    common = math.gcd(inner_rate, rate)
    return inner_rate // common, rate // common


def _fft_grid(samples: int, up: int, down: int) -> tuple[int, int]:
    """FFT lengths outside and inside the model that span the same time.

    Args:
        samples: Smallest length outside the model.
        up: Rate inside the model, in the same unit as ``down``.
        down: Rate outside the model.
    """
    units = fft_length(math.ceil(samples / down), 4)
    return units * down, units * up
