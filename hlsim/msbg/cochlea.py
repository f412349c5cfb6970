"""The cochlea of MSBG: a filter bank and recruitment, from a spectrum to a spectrum.

``simulate_cochlea`` runs each channel at the sample rate that its band needs, which is fast. It
treats signals as periodic, with enough silence behind them that their end does not reach their
beginning. ``simulate_cochlea_at_full_rate`` runs all channels at 44.1 kHz, and treats the end of a
signal as pyclarity does.
"""

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
    detect,
    envelope,
    envelope_lowpass,
    partial_means,
    smooth,
)
from hlsim.msbg.filter_bank import FilterBank, gammatone_response
from hlsim.msbg.filtfilt_end import end_correction
from hlsim.msbg.multirate import RateBand, multirate_bank
from hlsim.msbg.recruitment import apply_gains, expand, recruitment_gains
from hlsim.torchtools import constant

_TAIL = 3200
"""Samples of zero-padding behind a signal, 73 ms.

This is more than the longest advance (485 samples) and the time in which the narrowest channel
decays by 80 dB (about 2300 samples) together.
"""

_END_SAMPLES = 4096
"""Number of last samples of a long unaligned output for which all channels run at 44.1 kHz."""

_END_LEAD_SAMPLES = 7296
"""Number of samples before the last ``_END_SAMPLES`` that influence them."""

_MAX_COMMON_PERIOD = 10000
"""Largest period in samples at 44.1 kHz of which FFT lengths that suit two rates are multiples."""


def cochlea_fft_length(length: int, rate: int, rate_divisor: int = 1) -> int:
    """Choose the length of the Fourier transforms with which MSBG filters a signal.

    The length spans whole envelope steps. Unless ``common_period`` is 0, it also spans a whole
    number of samples at the sample rate of the output. Then a spectrum can be converted to that
    rate without returning to the time domain.

    Args:
        length: Number of samples of the signal at 44.1 kHz.
        rate: Sample rate of the output in Hz.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    Returns:
        Length as a number of samples at 44.1 kHz, including silence behind the signal.

    >>> cochlea_fft_length(44100, rate=16000)
    49392
    """
    period = common_period(rate, rate_divisor) or _whole_steps(rate_divisor)
    odd = fft_length(length + _TAIL, period)
    even = fft_length(length + _TAIL, 2 * period)
    # MKL takes twice as long for odd numbers of steps, but few transforms have this length.
    return odd if 1.1 * odd < even else even


def common_period(rate: int, rate_divisor: int = 1) -> int:
    """Return a time that is a whole number of samples at a rate and of envelope steps.

    If a Fourier transform spans a multiple of this time, its spectrum can be converted to that
    rate. An envelope step is the time between two computed values of an envelope. In samples at
    44.1 kHz, it is 24, or 24.5 if signals run at 22.05 kHz.

    Args:
        rate: Sample rate in Hz.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    Returns:
        Duration in samples at 44.1 kHz, or 0 if that is more than 10000: then no FFT length is
        short enough for both rates.

    >>> common_period(16000)
    3528
    """
    samples_of_whole_number = MSBG_RATE // math.gcd(MSBG_RATE, rate)
    period = math.lcm(_whole_steps(rate_divisor), samples_of_whole_number)
    return period if period <= _MAX_COMMON_PERIOD else 0


def _whole_steps(rate_divisor: int) -> int:
    """Return a duration in samples at 44.1 kHz of which FFT lengths may be multiples.

    The duration spans whole envelope steps (times between two values of an envelope) and an even
    number of samples: 24 for signals at 44.1 kHz, which is one step, or 196 for signals at
    22.05 kHz, which is eight steps of 24.5.

    Args:
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
    """
    return STEP if rate_divisor == 1 else round(8 * HALF_RATE_STEP)


def simulate_cochlea(
    signals: Tensor,
    ratios: Tensor,
    bank: FilterBank,
    points: int,
    *,
    rate_divisor: int = 1,
    highest: float = MSBG_RATE / 2,
    corrects_kinks: bool = True,
) -> Tensor:
    """Simulate the cochlea of impaired ears: split signals into channels, and expand each channel.

    A filter bank splits the signals into band-pass signals, the channels. Recruitment multiplies
    each channel by a gain that follows its envelope, and the channels are added up. Each channel is
    computed at a sample rate that its band allows, and channels far above ``highest`` as one.

    Shape: (items, time), (items, channels) -> complex (items, points // (2 * rate_divisor) + 1).

    Args:
        signals: Signals in Pa, which are zero-padded to ``points // rate_divisor`` samples and then
            treated as periodic.
        ratios: dB by which each channel changes per dB of input, from ``expansion_ratios`` in
            ``hlsim.msbg.recruitment``.
        bank: Filter bank for the severity of the ears.
        points: FFT length in samples at 44.1 kHz, from ``cochlea_fft_length``.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency in Hz that the output needs.
        corrects_kinks: Whether gains of slight losses are corrected where they change suddenly (see
            ``apply_gains``). This is not audible after smearing.

    Returns:
        Fourier transforms of the sums of the channels.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> signals, ratios = torch.randn(1, 1000), torch.full((1, 19), 2.0)
    >>> simulate_cochlea(signals, ratios, BANKS["severe"], points=4800).shape
    torch.Size([1, 2401])
    """
    spectrum = rfft(signals, points // rate_divisor)
    multirate = multirate_bank(bank, points, rate_divisor, highest, signals.dtype, signals.device)
    channels_of_bands = []
    sums = []
    for band in multirate.bands:
        channels, sums_of_band = _filter_and_rectify(spectrum, band)
        channels_of_bands.append(channels)
        sums.append(sums_of_band)
    envelopes = smooth(torch.cat(sums, -3), multirate.lowpass)
    ratios = ratios[..., : len(multirate.lowpass)]
    gains = recruitment_gains(envelopes, ratios)

    # Bands with the same rate are added up before their common Fourier transform.
    expanded: dict[tuple[int, bool], Tensor] = {}
    for band, channels in zip(multirate.bands, channels_of_bands, strict=True):
        members = band.channels
        slight = (envelopes[..., members, :], ratios[..., members]) if corrects_kinks else None
        total = apply_gains(channels, gains[..., members, :], band.interpolation, slight)
        kind = band.points, band.detector == "modulus"
        expanded[kind] = expanded[kind] + total if kind in expanded else total

    output = torch.zeros_like(spectrum)
    for (points, is_analytic), signal in expanded.items():
        if is_analytic:
            part = torch.fft.fft(torch.view_as_complex(signal.unflatten(-1, (-1, 2))))
        else:
            part = rfft(signal, points)
        output[..., : part.shape[-1]].add_(part[..., : output.shape[-1]])
    return output


def _filter_and_rectify(spectrum: Tensor, band: RateBand) -> tuple[Tensor, Tensor]:
    """Compute the channels of a rate band, and the sums from which ``smooth`` gets envelopes.

    Channels at a reduced rate are not in Pa: their Fourier transforms have the scale of
    ``spectrum``, at fewer points. The three sums per step, in Pa, are parts of three neighbouring
    envelopes, see ``partial_means``.

    Shape: complex (items, bins) -> (items, channels, time), (items, channels, 3, steps), where time
        is ``band.points``, or twice as many for the detector ``"modulus"``, whose channels are
        analytic signals with alternating real and imaginary parts.

    Args:
        spectrum: Fourier transforms of the signals in Pa.
        band: Channels with a common sample rate.
    """
    band_spectrum = spectrum[..., None, : band.response.shape[-1]] * band.response
    if band.detector == "itself":
        channels = torch.fft.irfft(band_spectrum, band.points)
        return channels, partial_means(channels.abs(), band.mean_weights)
    analytic = torch.fft.ifft(band_spectrum, band.points)
    rectified = detect(analytic, harmonics=band.detector == "harmonics")
    sums = partial_means(rectified, band.mean_weights)
    if band.detector == "modulus":
        return torch.view_as_real(analytic).flatten(-2), sums
    return analytic.real, sums


def simulate_delayed_cochlea(
    signals: Tensor, ratios: Tensor, bank: FilterBank, smears: bool, is_last: bool
) -> Tensor:
    """Simulate the cochlea so that each sample is close to pyclarity's, for output with its delay.

    The delay of the outer and middle ear and of smearing is already in the input, and stays there.
    If the signals end here, their last samples (or all, if they are short or have not been smeared)
    are computed with all channels at 44.1 kHz and with pyclarity's treatment of the end.

    Shape: (items, time), (items, channels) -> (items, time) in Pa.

    Args:
        signals: Input of the cochlea at 44.1 kHz in Pa.
        ratios: dB by which each channel changes per dB of input, from ``expansion_ratios``.
        bank: Filter bank for the severity of the ears.
        smears: Whether the signals have been smeared.
        is_last: Whether the signals end here, and are not cut from longer ones.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> ratios, bank = torch.full((1, 19), 2.0), BANKS["severe"]
    >>> simulate_delayed_cochlea(torch.randn(1, 1000), ratios, bank, True, True).shape
    torch.Size([1, 1000])
    """
    length = signals.shape[-1]
    # With a slight loss and without smearing, nothing masks what lower rates change where the
    # envelope is near 0.
    if is_last and (length <= _END_SAMPLES + _END_LEAD_SAMPLES or not smears):
        return simulate_cochlea_at_full_rate(signals, ratios, bank)
    points = cochlea_fft_length(length, MSBG_RATE)
    spectrum = simulate_cochlea(signals, ratios, bank, points, corrects_kinks=not smears)
    output = torch.fft.irfft(spectrum, points)[..., :length]
    if not is_last:
        return output
    end_input = signals[..., -_END_SAMPLES - _END_LEAD_SAMPLES :]
    end = simulate_cochlea_at_full_rate(end_input, ratios, bank)
    return torch.cat((output[..., :-_END_SAMPLES], end[..., -_END_SAMPLES:]), -1)


def simulate_cochlea_at_full_rate(waveform: Tensor, ratios: Tensor, bank: FilterBank) -> Tensor:
    """Simulate the cochlea of impaired ears with pyclarity's treatment of the end of a signal.

    ``simulate_cochlea`` is faster. The inverse transform of its result is nearly the same signal,
    except near the end: it treats signals as periodic, whereas this function, as pyclarity, fills
    the end of each channel with zeros.

    A filter bank splits the signals into band-pass signals, the channels. Recruitment multiplies
    each channel by a gain that follows its envelope, and the channels are added up. All channels
    run at 44.1 kHz. Each is advanced by its delay, so that the result is not late.

    Shape: (items, time), (items, channels) -> (items, time).

    Args:
        waveform: Signals at 44.1 kHz in Pa.
        ratios: dB by which each channel changes per dB of input, from ``expansion_ratios`` in
            ``hlsim.msbg.recruitment``.
        bank: Filter bank for the severity of the ears.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> waveform = torch.randn(1, 1000)
    >>> simulate_cochlea_at_full_rate(waveform, torch.full((1, 19), 2.0), BANKS["severe"]).shape
    torch.Size([1, 1000])
    """
    length = waveform.shape[-1]
    points = fft_length(length + _TAIL, 2 * STEP)
    response = gammatone_response(bank, points, like=waveform)
    spectrum = rfft(waveform, points).unsqueeze(-2) * response
    before_end = _before_advanced_end(bank, points, length, like=waveform)
    channels = torch.fft.irfft(spectrum, points) * before_end
    envelopes = envelope(channels, envelope_lowpass(bank, points, like=waveform))
    envelopes = envelopes + end_correction(channels, bank, length)
    return expand(channels, envelopes, ratios)[..., :length]


@constant
def _before_advanced_end(bank: FilterBank, points: int, length: int) -> NDArray[np.bool]:
    """Compute a mask, bool (channels, points), which is True before the end of each channel.

    The signal has ``length`` samples at 44.1 kHz. pyclarity advances each channel by dropping its
    first samples, and fills the end with zeros.
    """
    return np.arange(points) < length - np.array(bank.advances)[:, None]
