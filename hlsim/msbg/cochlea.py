"""The nonlinear stages of MSBG, filter bank and recruitment, with each channel at its own rate."""

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
from hlsim.msbg.filtfilt_end import end_oscillation, end_responses, end_weights
from hlsim.msbg.multirate import MultirateBank, RateBand
from hlsim.msbg.recruitment import apply_gains, expand, pad_periodically, recruitment_gains
from hlsim.torchtools import constant_like

BANK_TAIL = 3200
"""Samples of silence behind a signal on an FFT grid, 73 ms.

This is as long as the longest advance, and as the narrowest channel takes to decay by 80 dB.
"""

MAX_SHARED_MULTIPLE = 10000
"""Largest number of samples of which FFT lengths that two rates share are multiples."""


def bank_points(length: int, rate: int, step: int = 1) -> int:
    """Choose the FFT length at 44.1 kHz for a signal.

    If this costs little, the length is a whole number of samples at another rate, too.

    Args:
        length: Number of samples of the signal at 44.1 kHz.
        rate: The other rate in Hz.
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    >>> bank_points(44100, rate=16000)
    49392
    """
    multiple = shared_multiple(rate, step) or _samples_of_whole_steps(step)
    odd = fft_length(length + BANK_TAIL, multiple)
    even = fft_length(length + BANK_TAIL, 2 * multiple)
    # MKL takes twice as long for odd numbers of steps, but few transforms have this length.
    return odd if 1.1 * odd < even else even


def shared_multiple(rate: int, step: int = 1) -> int:
    """Find the number of samples at 44.1 kHz that are whole steps and whole samples at a rate.

    Args:
        rate: Sample rate in Hz.
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    Returns: The smallest such number, or 0 if it is above ``MAX_SHARED_MULTIPLE``.

    >>> shared_multiple(16000)
    3528
    """
    samples_of_whole_number = MSBG_RATE // math.gcd(MSBG_RATE, rate)
    multiple = math.lcm(_samples_of_whole_steps(step), samples_of_whole_number)
    return multiple if multiple <= MAX_SHARED_MULTIPLE else 0


def _samples_of_whole_steps(step: int) -> int:
    """Samples at 44.1 kHz that are whole steps, and an even number at 44.1 kHz / step."""
    return STEP if step == 1 else round(8 * HALF_RATE_STEP)


def simulate_cochlea(spectrum: Tensor, ratios: Tensor, bank: MultirateBank, slight: bool) -> Tensor:
    """Apply filter bank and recruitment to periodic signals, with each channel at its own rate.

    Shape: complex (items, bins), (items, channels) -> complex (items, bins).

    Args:
        spectrum: Spectrum of the signals.
        ratios: Expansion ratio of each channel.
        slight: Correct the gain's kinks with slight losses (see ``apply_gains``). After smearing,
            they are masked.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> from hlsim.msbg.multirate import multirate_bank
    >>> options = {"dtype": torch.float32, "device": torch.device("cpu")}
    >>> bank = multirate_bank(BANKS["severe"], points=4800, step=1, highest=22050.0, **options)
    >>> spectrum = torch.fft.rfft(torch.randn(1, 4800))
    >>> simulate_cochlea(spectrum, torch.full((1, 19), 2.0), bank, slight=False).shape
    torch.Size([1, 2401])
    """
    waves = []
    sums = []
    for band in bank.bands:
        wave, band_sums = filter_and_rectify(spectrum, band)
        waves.append(wave)
        sums.append(band_sums)
    envelopes = smooth(torch.cat(sums, -3), bank.lowpass)
    ratios = ratios[..., : len(bank.lowpass)]
    gains = pad_periodically(recruitment_gains(envelopes, ratios))

    # Bands at the same rate are added up before their common Fourier transform.
    expanded: dict[tuple[int, bool], Tensor] = {}
    for band, wave in zip(bank.bands, waves, strict=True):
        channels = band.channels
        slight_loss = (envelopes[..., channels, :], ratios[..., channels]) if slight else None
        part = apply_gains(wave, gains[..., channels, :], band.interpolation, slight_loss)
        is_analytic = band.detector == "modulus"
        kind = (band.points, is_analytic)
        expanded[kind] = expanded[kind] + part if kind in expanded else part
    return add_spectra(expanded, spectrum)


def filter_and_rectify(spectrum: Tensor, band: RateBand) -> tuple[Tensor, Tensor]:
    """Compute the channels of a rate band, and the sums of their rectified samples per step.

    Shape: complex (items, bins) -> (items, channels, time), (items, channels, 3, steps), where time
        is points or, for analytic signals, 2 * points.

    Returns: The channels, where real and imaginary parts of analytic signals alternate, and the
        sums for ``smooth``.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> from hlsim.msbg.multirate import multirate_bank
    >>> options = {"dtype": torch.float32, "device": torch.device("cpu")}
    >>> bank = multirate_bank(BANKS["severe"], points=4800, step=1, highest=22050.0, **options)
    >>> channels, sums = filter_and_rectify(torch.fft.rfft(torch.randn(1, 4800)), bank.bands[0])
    >>> channels.shape, sums.shape
    (torch.Size([1, 4, 1200]), torch.Size([1, 4, 3, 200]))
    """
    band_spectrum = spectrum[..., None, : band.response.shape[-1]] * band.response
    if band.detector == "itself":
        channels = torch.fft.irfft(band_spectrum, band.points)
        return channels, decimate(channels.abs(), band.decimation)
    analytic = torch.fft.ifft(band_spectrum, band.points)
    rectified = detect(analytic, harmonics=band.detector == "harmonics")
    sums = decimate(rectified, band.decimation)
    if band.detector == "modulus":
        return torch.view_as_real(analytic).flatten(-2), sums
    return analytic.real, sums


def add_spectra(signals: dict[tuple[int, bool], Tensor], like: Tensor) -> Tensor:
    """Compute the spectrum of the sum of signals at several rates.

    Shape: (items, time) each, complex (items, bins) -> complex (items, bins).

    Args:
        signals: Signals by FFT length and by whether they are analytic.
        like: Tensor with the shape and the type of the result.

    >>> tone = torch.tensor([[1.0, 0.0, -1.0, 0.0]])
    >>> add_spectra({(4, False): tone}, like=torch.zeros(1, 3, dtype=torch.complex64)).real
    tensor([[0., 2., 0.]])
    """
    total = torch.zeros_like(like)
    for (points, is_analytic), signal in signals.items():
        if is_analytic:
            pairs = signal.unflatten(-1, (-1, 2))
            spectrum = torch.fft.fft(torch.view_as_complex(pairs))
        else:
            spectrum = rfft(signal, points)
        total[..., : spectrum.shape[-1]].add_(spectrum[..., : total.shape[-1]])
    return total


def simulate_cochlea_at_full_rate(waveform: Tensor, ratios: Tensor, bank: FilterBank) -> Tensor:
    """Apply filter bank and recruitment as the reference does, up to the last sample.

    All channels run at 44.1 kHz, and the envelopes end as those of ``filtfilt``.

    Shape: (items, time), (items, channels) -> (items, time).

    Args:
        waveform: Signals at 44.1 kHz in Pa.
        ratios: Expansion ratio of each channel.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> waveform = torch.randn(1, 1000)
    >>> simulate_cochlea_at_full_rate(waveform, torch.full((1, 19), 2.0), BANKS["severe"]).shape
    torch.Size([1, 1000])
    """
    length = waveform.shape[-1]
    points = fft_length(length + BANK_TAIL, 2 * STEP)
    response = constant_like(waveform, gammatone_response, bank, points)
    spectrum = rfft(waveform, points).unsqueeze(-2) * response
    before_end = constant_like(waveform, _before_advanced_end, bank, points, length)
    channels = torch.fft.irfft(spectrum, points) * before_end

    envelopes = envelope(channels, constant_like(waveform, envelope_lowpass, bank, points))
    weights = constant_like(waveform, end_weights, bank)
    length_in_step = (length - 1) % STEP + 1
    responses = constant_like(waveform, end_responses, bank, length_in_step)
    envelopes = envelopes + end_oscillation(channels, weights, responses, length)
    return expand(channels, envelopes, ratios)[..., :length]


def _before_advanced_end(bank: FilterBank, points: int, length: int) -> NDArray[np.bool]:
    """Compute a mask that is 0 from the advanced end of each channel on.

    The reference advances each channel by dropping its first samples, and fills the end with zeros.

    Returns: Mask of shape (channels, points).
    """
    return np.arange(points) < length - np.array(bank.advances)[:, None]
