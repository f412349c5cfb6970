"""The linear response that MSBG has where the gains of all channels are 1.

This is the response of MSBG for a normal ear. The channels of its filter bank add up to a flat
magnitude within a few decibels, but not to a linear phase: at 1 to 2 kHz the output resembles the
polarity-inverted input more than the input. Waveforms, phases and complex spectra of the output can
therefore only be compared with signals that have the same phase.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram import SEVERITIES, severity_index
from hlsim.dsp.fir import filter_without_delay
from hlsim.msbg.ear import MSBG_RATE, ear_filter, lowpass_filter
from hlsim.msbg.filterbank import BANKS, FilterBank, gammatone_response
from hlsim.msbg.model import STRUCTURAL_DELAY
from hlsim.torchtools import constant_like

HALF_LENGTH_SECONDS = 0.064
"""Time in seconds that impulse responses cover before and after time 0."""

MAX_SPACING_HZ = 2.5
"""Largest distance in Hz between frequencies on which responses are computed.

Its reciprocal is several times as long as the impulse responses.
"""

MIN_RELATIVE_MAGNITUDE = 0.1
"""Magnitude of a response relative to its maximum, below which the magnitude is not normalised."""


def fixed_response(bank: FilterBank, rate: int, points: int) -> NDArray[np.complex128]:
    """Compute the response of aligned MSBG with a gain of 1 in all channels.

    Args:
        rate: Sample rate in Hz.
        points: FFT length at ``rate``, whose duration is a whole number of samples at 44.1 kHz.

    Returns: Response of shape (points // 2 + 1,), which is 0 above 22.05 kHz.

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
    """Apply the phase of MSBG's filter bank for each ear, and keep the magnitude.

    Where the response of the bank is more than 20 dB below its maximum, the magnitude falls with
    it.

    Shape: (items, time), (items, 8) -> (items, time).

    Args:
        thresholds: Audiograms in dB HL, whose severity selects the bank.
        rate: Sample rate in Hz.
        normal: The waveform is MSBG's output for a normal ear, so that the phase of the bank for
            normal ears is removed.

    >>> apply_bank_phase(torch.randn(1, 1600), torch.full((1, 8), 40.0), 16000).shape
    torch.Size([1, 1600])
    """
    severity = severity_index(thresholds)
    taps = constant_like(waveform, _phase_taps, rate, normal)[severity]
    filtered = filter_without_delay(waveform, taps)
    if not normal:
        return filtered
    # For ears without a loss, the waveform keeps its bits, because rounding changes the phase of
    # frequencies that are nearly silent.
    has_no_loss = (severity == 0).unsqueeze(-1)
    return torch.where(has_no_loss, waveform, filtered)


def simulate_normal_ear(waveform: Tensor, thresholds: Tensor, rate: int) -> Tensor:
    """Simulate a normal ear with the phase of the filter bank for each impaired ear.

    The result can be compared with MSBG's output for the impaired ear. It takes two Fourier
    transforms, because MSBG is linear at 0 dB HL. For ears without a loss it equals MSBG's output
    with an SNR of 69 dB at 16 kHz and 105 dB at 44.1 kHz.

    Shape: (items, time), (items, 8) -> (items, time).

    Args:
        thresholds: Audiograms in dB HL, whose severity selects the bank.
        rate: Sample rate in Hz.

    >>> simulate_normal_ear(torch.randn(1, 1600), torch.full((1, 8), 40.0), 16000).shape
    torch.Size([1, 1600])
    """
    taps = constant_like(waveform, _normal_ear_taps, rate)[severity_index(thresholds)]
    return filter_without_delay(waveform, taps)


def _normal_ear_taps(rate: int) -> NDArray[np.float64]:
    """Compute impulse responses with a normal ear's magnitude and each severity's phase.

    Returns: Taps of shape (severities, 2 * half).
    """
    responses, points = _responses(rate)
    phases = np.exp(1j * np.angle(responses))
    return impulse_responses(np.abs(responses[0]) * phases, points, rate)


def _phase_taps(rate: int, normal: bool) -> NDArray[np.float64]:
    """Compute impulse responses with each severity's phase.

    Args:
        normal: Subtract the phase of the bank for normal ears.

    Returns: Taps of shape (severities, 2 * half).
    """
    responses, points = _responses(rate)
    if normal:
        phases = np.exp(1j * (np.angle(responses) - np.angle(responses[0])))
    else:
        magnitude = np.abs(responses)
        floor = MIN_RELATIVE_MAGNITUDE * magnitude.max(-1, keepdims=True)
        phases = responses / np.maximum(magnitude, floor)
    return impulse_responses(phases, points, rate)


def _responses(rate: int) -> tuple[NDArray[np.complex128], int]:
    """Compute the response of each severity's bank.

    Returns: Responses of shape (severities, points // 2 + 1), and the FFT length ``points``.
    """
    common = math.gcd(rate, MSBG_RATE)
    points = rate // common * 2 * math.ceil(common / (2.0 * MAX_SPACING_HZ))
    responses = [fixed_response(BANKS[severity], rate, points) for severity in SEVERITIES]
    return np.stack(responses), points


def half_length(rate: int) -> int:
    """Number of samples that impulse responses have before time 0, and from it on.

    >>> half_length(16000)
    1024
    """
    return math.ceil(HALF_LENGTH_SECONDS * rate)


def impulse_responses(
    spectra: NDArray[np.complex128], points: int, rate: int
) -> NDArray[np.float64]:
    """Compute impulse responses with time 0 in the middle from frequency responses.

    Shape: (severities, points // 2 + 1) -> (severities, 2 * half), where half is ``half_length``
        of the rate.

    Args:
        points: FFT length of the responses.
        rate: Sample rate in Hz.

    >>> impulse_responses(np.ones((1, 4001)), points=8000, rate=16000)[0, 1023:1026]
    array([0., 1., 0.])
    """
    half = half_length(rate)
    centred = np.roll(np.fft.irfft(spectra, points), half, -1)
    return centred[:, : 2 * half]
