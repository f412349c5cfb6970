"""The fixed response of MSBG with every gain at 1: what a normal ear hears, and what a filter bank does to any signal.

The bank's channels add up to a level response within a few dB, but not to a linear phase: at 1 to 2 kHz what is heard is
nearer to the polarity-inverted signal than to the signal. Waveforms, phases and complex spectra can only be compared with
a signal that has the same phase.
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

_HALF_SECONDS = 0.064
_SPACING = 2.5  # Hz, at most: of the grid, whose period is several times what the responses last
_FAINT = 0.1


def fixed_response(bank: FilterBank, rate: int, points: int) -> NDArray[np.complex128]:
    """Response of all of MSBG, aligned, with every gain at 1, on the grid of ``rfft`` at a rate.

    Args:
        points: FFT length at ``rate`` that is a whole number of samples at 44.1 kHz too.

    Returns: (points // 2 + 1,), 0 above 22.05 kHz.
    """
    inner = points * MSBG_RATE // rate
    bins = min(points, inner) // 2 + 1
    omega = 2.0 * np.pi * np.arange(bins) / inner
    total = gammatone_response(bank, inner, bins=bins).sum(0)
    for taps in (ear_filter(), ear_filter(backward=True), lowpass_filter()):
        total = total * np.fft.rfft(taps, inner)[:bins]
    total = total * np.exp(1j * omega * STRUCTURAL_DELAY) * 10.0 ** (-bank.recombination_db / 20.0)
    return np.pad(total, (0, points // 2 + 1 - bins))


def with_phase_of_bank(
    waveform: Tensor, thresholds: Tensor, rate: int, *, normal: bool = False
) -> Tensor:
    """A signal with the phase that MSBG's bank of each ear's severity gives it, and the magnitude as it is.

    Where the response ends, from 20 dB down, the magnitude goes with it.

    Shape: (items, time), (items, 8) dB HL -> (items, time).

    Args:
        normal: the signal is what a normal ear hears: the phase of that ear's bank is taken off.
    """
    severity = severity_index(thresholds)
    taps = constant_like(waveform, _phases, rate, normal)[severity]
    moved = filter_without_delay(waveform, taps)
    # a normal ear's stays as it is to the bit, for phases of what is nearly silent depend on rounding
    return torch.where((severity == 0).unsqueeze(-1), waveform, moved) if normal else moved


def hear_normally(waveform: Tensor, thresholds: Tensor, rate: int) -> Tensor:
    """What MSBG makes of a signal at 0 dB HL, where it is linear, with the phase of the bank of each ear's severity.

    The phase is that of what this ear hears, with which it is to be compared. Without a loss it is MSBG's output, 69 dB
    SNR at 16 kHz and 105 dB at 44.1 kHz, for the time of two transforms.

    Shape: (items, time), (items, 8) dB HL -> (items, time).
    """
    return filter_without_delay(
        waveform, constant_like(waveform, _as_normal, rate)[severity_index(thresholds)]
    )


def _as_normal(rate: int) -> NDArray[np.float64]:
    """Impulse response of a normal ear with each severity's phase. Returns as ``impulses``."""
    responses, points = _responses(rate)
    return impulses(np.abs(responses[0]) * np.exp(1j * np.angle(responses)), points, rate)


def _phases(rate: int, normal: bool) -> NDArray[np.float64]:
    """Impulse response of each severity's phase. Returns as ``impulses``."""
    responses, points = _responses(rate)
    if normal:
        phases = np.exp(1j * (np.angle(responses) - np.angle(responses[0])))
    else:
        magnitude = np.abs(responses)
        phases = responses / np.maximum(magnitude, _FAINT * magnitude.max(-1, keepdims=True))
    return impulses(phases, points, rate)


def _responses(rate: int) -> tuple[NDArray[np.complex128], int]:
    """Response of each severity's bank, (severities, points // 2 + 1), and the points of the grid."""
    shared = math.gcd(rate, MSBG_RATE)
    points = rate // shared * 2 * math.ceil(shared / (2.0 * _SPACING))
    return np.stack(
        [fixed_response(BANKS[severity], rate, points) for severity in SEVERITIES]
    ), points


def half_length(rate: int) -> int:
    """Samples of the impulse responses to either side of zero."""
    return math.ceil(_HALF_SECONDS * rate)


def impulses(spectra: NDArray[np.complex128], points: int, rate: int) -> NDArray[np.float64]:
    """Impulse response of each, its zero in the middle. Returns (severities, 2 half)."""
    half = half_length(rate)
    return np.roll(np.fft.irfft(spectra, points), half, -1)[:, : 2 * half]
