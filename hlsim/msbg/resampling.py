"""From the input to the cochlea and from the cochlea to the output, with resampling on the way.

Fourier transforms do the filtering and the resampling together: a signal is transformed at its
sample rate, and the product of its spectrum and a frequency response is transformed back at another
rate. The *outer* rate is that of input and output, and the *inner* rate that of the cochlea, 44.1
or 22.05 kHz.

Where the two rates differ, the spectrum fades out towards the lower Nyquist frequency, and is 0 at
this frequency, which the spectrum at the higher rate has twice.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.fft import fade_out_weights, fft_length, rfft
from hlsim.dsp.fir import BLOCK_POINTS, filter_in_blocks
from hlsim.msbg.ear import EAR_DELAY, MSBG_RATE, ear_filter, lowpass_filter
from hlsim.torchtools import constant

_FIR_TAIL = 2 * EAR_DELAY + 132
"""Number of samples at 44.1 kHz by which the inverse ear and the low-pass lengthen a signal."""


def to_cochlea(signals: Tensor, rate: int, length: int, rate_divisor: int) -> Tensor:
    """Filter input with the outer and middle ear, and resample it to the rate of the cochlea.

    The result has the delay of the ear's filter (``EAR_DELAY`` samples at 44.1 kHz).

    Shape: (items, time) -> (items, length).

    Args:
        signals: Input signals.
        rate: Sample rate of the input in Hz.
        length: Number of samples of the result, which is cut, or ends in the filter's tail and
            silence.
        rate_divisor: 1 for a result at 44.1 kHz, 2 for a result at 22.05 kHz.

    >>> to_cochlea(torch.randn(2, 16000), rate=16000, length=44100, rate_divisor=1).shape
    torch.Size([2, 44100])
    """
    if rate == MSBG_RATE and rate_divisor == 1:
        return filter_in_blocks(signals, _inward_block_response(like=signals), length)
    up, down = _rate_ratio(rate, rate_divisor)
    tail = math.ceil(_FIR_TAIL * down / up / rate_divisor)
    samples = max(signals.shape[-1], math.ceil(length * down / up)) + tail
    outer_points, inner_points = _fft_lengths(samples, up, down)
    bins = min(outer_points, inner_points) // 2 + 1
    points = inner_points * rate_divisor
    response = _inward_response(points, bins, up / down, rate, like=signals)
    spectrum = rfft(signals, outer_points)[..., :bins] * response
    return torch.fft.irfft(spectrum, inner_points)[..., :length]


def from_spectrum(
    spectrum: Tensor,
    points: int,
    rate_divisor: int,
    rate: int,
    samples: int,
    *,
    gain: float,
    delay: int,
) -> Tensor:
    """Compute the output of MSBG from the spectrum of the signal that leaves the cochlea.

    This applies the inverse of the outer and middle ear, the final low-pass and a gain, removes the
    delay, and resamples to the rate of the output.

    Shape: complex (items, points // (2 * rate_divisor) + 1) -> (items, samples).

    Args:
        spectrum: Spectra of signals that are followed by silence.
        points: FFT length of the spectrum, in samples at 44.1 kHz. It spans a whole number of
            samples of the output (``hlsim.msbg.cochlea.common_period``).
        rate_divisor: 1 for spectra of signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        rate: Sample rate of the output in Hz.
        samples: Number of samples of the output.
        gain: Linear gain of the output.
        delay: Samples at 44.1 kHz by which the output is advanced.

    >>> spectrum = torch.fft.rfft(torch.randn(1, 49392))
    >>> from_spectrum(spectrum, 49392, 1, 16000, 16000, gain=1.0, delay=1047).shape
    torch.Size([1, 16000])
    """
    inner_points = points // rate_divisor
    outer_points = points * rate // MSBG_RATE
    bins = min(inner_points, outer_points) // 2 + 1
    total_gain = gain * outer_points / inner_points
    response = _outward_response(points, delay, bins, total_gain, rate, like=spectrum)
    return torch.fft.irfft(spectrum[..., :bins] * response, outer_points)[..., :samples]


def from_cochlea(
    waveform: Tensor,
    rate: int,
    samples: int,
    *,
    gain: float,
    rate_divisor: int = 1,
    delay: int = 0,
) -> Tensor:
    """Compute the output of MSBG from the signal that leaves the cochlea.

    This applies the inverse of the outer and middle ear, the final low-pass and a gain, removes the
    delay, and resamples to the rate of the output.

    Shape: (items, time) -> (items, samples).

    Args:
        waveform: Signals that leave the cochlea.
        rate: Sample rate of the output in Hz.
        samples: Number of samples of the output.
        gain: Linear gain of the output.
        rate_divisor: 1 for a waveform at 44.1 kHz, 2 for a waveform at 22.05 kHz.
        delay: Samples at 44.1 kHz by which the output is advanced.

    >>> from_cochlea(torch.randn(1, 44100), rate=16000, samples=16000, gain=1.0).shape
    torch.Size([1, 16000])
    """
    up, down = _rate_ratio(rate, rate_divisor)
    outer_samples = math.ceil((waveform.shape[-1] + _FIR_TAIL) * down / up)
    _, inner_points = _fft_lengths(outer_samples, up, down)
    spectrum = rfft(waveform, inner_points)
    points = inner_points * rate_divisor
    return from_spectrum(spectrum, points, rate_divisor, rate, samples, gain=gain, delay=delay)


@constant
def _inward_block_response() -> NDArray[np.complex128]:
    """Compute the frequency response of outer and middle ear at 44.1 kHz, complex (2049,).

    The response is for ``filter_in_blocks``, whose transforms have ``BLOCK_POINTS`` points.
    """
    return np.fft.rfft(ear_filter(), BLOCK_POINTS)


@constant
def _inward_response(points: int, bins: int, gain: float, rate: int) -> NDArray[np.complex128]:
    """Compute the frequency response of outer and middle ear and of resampling, with a gain.

    Args:
        points: FFT length at 44.1 kHz.
        bins: Number of frequencies.
        gain: Linear gain.
        rate: Sample rate in Hz from which signals are resampled.

    Returns:
        Complex response at the lowest ``bins`` frequencies, (bins,).
    """
    return gain * np.fft.rfft(ear_filter(), points)[:bins] * _band_end(points, bins, rate)


@constant
def _outward_response(
    points: int, delay: int, bins: int, gain: float, rate: int
) -> NDArray[np.complex128]:
    """Compute the frequency response from the cochlea to the output: inverse ear and low-pass.

    A gain and an advance in time are part of the response.

    Args:
        points: FFT length at 44.1 kHz.
        delay: Samples at 44.1 kHz by which signals are advanced.
        bins: Number of frequencies.
        gain: Linear gain.
        rate: Sample rate in Hz to which signals are resampled.

    Returns:
        Complex response at the lowest ``bins`` frequencies, (bins,).
    """
    inverse_ear = np.fft.rfft(ear_filter(backward=True), points)
    response = inverse_ear * np.fft.rfft(lowpass_filter(), points)
    advance = np.exp(2j * np.pi * np.arange(bins) * delay / points)
    return gain * response[:bins] * advance * _band_end(points, bins, rate)


def _band_end(points: int, bins: int, rate: int) -> NDArray[np.float64]:
    """Compute weights that fade a spectrum out at the lower Nyquist frequency of two rates.

    The weights are all 1 if the outer rate is 44.1 kHz, so that nothing is resampled.

    Args:
        points: FFT length at 44.1 kHz.
        bins: Number of frequencies.
        rate: Outer rate in Hz, that of input or output. The other rate is 44.1 kHz, or 22.05 kHz
            if this one is at most 20 kHz.

    Returns:
        Weights from 0 to 1, (bins,).
    """
    if rate == MSBG_RATE:
        return np.ones(bins)
    return fade_out_weights(bins, MSBG_RATE / points, min(rate, MSBG_RATE) / 2)


def _rate_ratio(rate: int, rate_divisor: int) -> tuple[int, int]:
    """Return the inner and the outer rate, divided by their greatest common divisor.

    Args:
        rate: Outer rate in Hz, that of input or output.
        rate_divisor: Divisor of 44.1 kHz for the inner rate, that of the cochlea: 1 or 2.
    """
    inner_rate = MSBG_RATE // rate_divisor
    common = math.gcd(inner_rate, rate)
    return inner_rate // common, rate // common


def _fft_lengths(samples: int, up: int, down: int) -> tuple[int, int]:
    """Return FFT lengths at the outer and at the inner rate that span the same time.

    The outer rate is that of input and output, the inner one that of the model.

    Args:
        samples: Smallest length at the outer rate.
        up: Inner rate, in the same unit as ``down``.
        down: Outer rate.
    """
    units = fft_length(math.ceil(samples / down), 4)
    return units * down, units * up
