"""MSBG as a linear filter: its effect on a signal where the gains of all channels are 1.

This is all that MSBG does for a normal ear. The channels of its filter bank add up to a flat
magnitude within a few decibels, but they shift the phase: at 1 to 2 kHz a normal ear's output
resembles the input with opposite sign more than the input. The phase depends on the filter bank,
and so on the severity of the loss. Waveforms, phases and complex spectra of the output of MSBG can
therefore only be compared with signals whose phase was shifted by the same filter bank.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import SEVERITIES, severity_index
from hlsim.dsp.fir import filter_without_delay
from hlsim.msbg.ear import MSBG_RATE, ear_filter, lowpass_filter
from hlsim.msbg.filter_bank import BANKS, FilterBank, gammatone_response
from hlsim.msbg.model import STRUCTURAL_DELAY
from hlsim.torchtools import constant

_HALF_LENGTH_SECONDS = 0.064
"""Time in seconds that impulse responses cover before and after time 0."""

_MAX_SPACING_HZ = 2.5
"""Largest distance in Hz between frequencies on which responses are computed.

Its reciprocal is several times as long as the impulse responses.
"""

_MIN_RELATIVE_MAGNITUDE = 0.1
"""Magnitude relative to the maximum of a response below which the phase filter attenuates."""


def fixed_response(bank: FilterBank, rate: int, points: int) -> NDArray[np.complex128]:
    """Compute the frequency response of MSBG for sounds that it does not make softer.

    MSBG without smearing is linear where the gains of all channels of its filter bank are 1, as for
    a normal ear. The response is that of aligned MSBG, without a delay.

    Args:
        bank: Filter bank of a severity, a value of ``hlsim.msbg.filter_bank.BANKS``.
        rate: Sample rate in Hz.
        points: FFT length at ``rate``, whose duration is a whole number of samples at 44.1 kHz.

    Returns:
        Complex response, (points // 2 + 1,), which is 0 above 22.05 kHz.

    >>> response = fixed_response(BANKS["none"], rate=16000, points=16000)
    >>> print(abs(response[1000]).round(2))
    1.04
    """
    inner_points = points * MSBG_RATE // rate
    bins = min(points, inner_points) // 2 + 1
    omega = 2.0 * np.pi * np.arange(bins) / inner_points
    response = gammatone_response(bank, inner_points, bins=bins).sum(0)
    for taps in (ear_filter(), ear_filter(backward=True), lowpass_filter()):
        response = response * np.fft.rfft(taps, inner_points)[:bins]
    advance = np.exp(1j * omega * STRUCTURAL_DELAY)
    response = response * advance * 10.0 ** (-bank.recombination_db / 20.0)
    return np.pad(response, (0, points // 2 + 1 - bins))


def apply_bank_phase(
    waveform: Tensor, thresholds: Tensor, rate: int, *, normal: bool = False
) -> Tensor:
    """Shift the phase of signals as MSBG's filter bank for each ear does, and keep the magnitude.

    Signals can then be compared with the output of MSBG for the ear. Where the response of MSBG
    (``fixed_response``) is more than 20 dB below its maximum, the magnitude falls with it (unless
    ``normal`` is true).

    Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.

    Args:
        waveform: Signals, such as clean speech.
        thresholds: Audiograms in dB HL, whose severity selects the filter bank.
        rate: Sample rate in Hz.
        normal: Whether the waveform is MSBG's output for a normal ear. Then the phase shift of the
            filter bank for normal ears is replaced by that for the impaired ears.

    >>> apply_bank_phase(torch.randn(1, 1600), torch.full((1, 8), 40.0), 16000).shape
    torch.Size([1, 1600])
    """
    severity = severity_index(thresholds)
    filters = _taps(rate, "difference" if normal else "phase", like=waveform)
    # Indexing by a tensor without dimensions, the severity of one ear, synchronises with a GPU.
    taps = functional.embedding(severity, filters)
    filtered = filter_without_delay(waveform, taps)
    if not normal:
        return filtered
    # For ears without a loss, the waveform keeps its bits, because rounding changes the phase of
    # frequencies that are nearly silent.
    has_no_loss = (severity == 0).unsqueeze(-1)
    return torch.where(has_no_loss, waveform, filtered)


def simulate_normal_ear(waveform: Tensor, thresholds: Tensor, rate: int) -> Tensor:
    """Simulate what a normal ear perceives, with the phase shift of each impaired ear.

    The result can be compared with MSBG's output for the impaired ear. It takes two Fourier
    transforms, because MSBG is linear at 0 dB HL. For speech and ears without a loss, it equals
    MSBG's output with an SNR of 70 dB or more, apart from the last 80 Hz below half the sample
    rate, which it keeps, and which MSBG fades out at rates below 44.1 kHz.

    Shape: (..., time), (..., 8) -> (..., time); the leading dimensions broadcast.

    Args:
        waveform: Clean speech.
        thresholds: Audiograms of the impaired ears in dB HL, whose severity selects the filter bank
            that shifts the phase.
        rate: Sample rate in Hz.

    >>> simulate_normal_ear(torch.randn(1, 1600), torch.full((1, 8), 40.0), 16000).shape
    torch.Size([1, 1600])
    """
    filters = _taps(rate, "normal ear", like=waveform)
    taps = functional.embedding(severity_index(thresholds), filters)
    return filter_without_delay(waveform, taps)


@constant
def _taps(rate: int, kind: str) -> NDArray[np.float64]:
    """Compute one impulse response for each severity, from ``fixed_response`` of its filter bank.

    Let R be this frequency response, and R0 that for ears without a loss.

    Args:
        rate: Sample rate in Hz.
        kind: ``"phase"`` for the phase of R and the magnitude 1, or less where R is below a tenth
            of its maximum; ``"difference"`` for the phase of R minus that of R0 and the magnitude
            1; ``"normal ear"`` for the phase of R and the magnitude of R0.

    Returns:
        Coefficients, (severities, 2 * half_length(rate)).
    """
    common = math.gcd(rate, MSBG_RATE)
    points = rate // common * 2 * math.ceil(common / (2.0 * _MAX_SPACING_HZ))
    responses = np.stack([fixed_response(BANKS[name], rate, points) for name in SEVERITIES])
    magnitude = np.abs(responses)
    angle = np.angle(responses)
    if kind == "phase":
        floor = _MIN_RELATIVE_MAGNITUDE * magnitude.max(-1, keepdims=True)
        spectra = responses / np.maximum(magnitude, floor)
    elif kind == "difference":
        spectra = np.exp(1j * (angle - angle[0]))
    else:
        spectra = magnitude[0] * np.exp(1j * angle)
    return impulse_responses(spectra, points, rate)


def half_length(rate: int) -> int:
    """Return half the length in samples of MSBG's linear impulse responses, 64 ms.

    The impulse responses (of MSBG for sounds that it does not make softer) have this number of
    samples before time 0, and as many from time 0 on.

    Args:
        rate: Sample rate in Hz.

    >>> half_length(16000)
    1024
    """
    return math.ceil(_HALF_LENGTH_SECONDS * rate)


def impulse_responses(
    spectra: NDArray[np.complex128], points: int, rate: int
) -> NDArray[np.float64]:
    """Compute impulse responses from frequency responses, with time 0 in the middle.

    Shape: complex (responses, points // 2 + 1) -> (responses, 2 * half), where half is
        ``half_length(rate)``.

    Args:
        spectra: Frequency responses.
        points: FFT length of the frequency responses.
        rate: Sample rate in Hz.

    >>> impulse_responses(np.ones((1, 4001)), points=8000, rate=16000)[0, 1023:1026]
    array([0., 1., 0.])
    """
    half = half_length(rate)
    centred = np.roll(np.fft.irfft(spectra, points), half, -1)
    return centred[:, : 2 * half]
