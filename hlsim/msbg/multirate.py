"""The filter bank with each channel at a sample rate that its band needs.

A gammatone channel passes a band of frequencies. It is kept at least up to five bandwidths above
its centre frequency, where its gain is -40 to -49 dB, or up to the highest frequency of interest.
Neighbouring channels form a *rate band* with a common sample rate and a common *detector*, the
signal from which their envelopes are computed:

- ``"modulus"``: Narrow channels are analytic signals (complex signals without negative frequencies)
  at about 5.5 kHz, or at 9 to 13 kHz, depending on the highest frequency of interest. The modulus
  of an analytic signal is its envelope. Rectifying the channel would add harmonics, but the
  low-pass of the envelope removes them.
- ``"harmonics"``: With severe losses, channels are so wide for their centre frequency that
  harmonics reach down to 0 Hz. Two harmonics complete the modulus of those below about 5.5 kHz.
- ``"itself"``: The lowest channels, and the widest ones at 44.1 kHz, are rectified as in pyclarity.

Channels whose centre frequency is far above the highest frequency of interest respond only with the
lower edges of their bands, and all of them have the expansion ratio of the threshold at 8 kHz,
unless thresholds at higher frequencies were measured. They are computed as one channel, their sum.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.dsp.fft import fade_out_weights
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP, envelope_lowpass, mean_weights
from hlsim.msbg.filter_bank import FilterBank, gammatone_response
from hlsim.msbg.recruitment import interpolation_kernel
from hlsim.msbg.smearing import SKIRT_HZ
from hlsim.torchtools import as_tensor, compute_once, constant

_BANDWIDTHS_ABOVE_CENTRE = 5.0
"""Bandwidths above its centre frequency up to which a channel is kept."""

_MAX_BROADENING_WITHOUT_HARMONICS = 2.5
"""Broadening of channels above which a rectifier's harmonics reach down to 0 Hz."""

_RECTIFIED_BELOW_HZ = 400.0
"""Centre frequency below which the channels themselves are rectified."""

_MERGED_ABOVE = 1.75
"""Ratio to the highest frequency of interest above which channels are merged into one."""

_MERGED_RATIO = 1.3
"""Expansion ratio at which the gain of merged channels is exact, that of a loss of 24 dB.

At larger ratios they are softer, so that errors matter less.
"""

_SLOW_SAMPLES = 3
"""Samples per step of channels at about 5.5 kHz."""

_FAST_SAMPLES = 6
"""Samples per step of channels at about 11 kHz."""

_WINDOW_STEPS = (8, 9, 7, 10, 6, 5)
"""Numbers of steps that one row of a matrix product may interpolate, the preferred one first."""


@dataclass(frozen=True)
class RateBand:
    """Neighbouring channels of a filter bank that are computed at one sample rate.

    Attributes:
        channels: Indices of the channels in the filter bank.
        points: FFT length at this sample rate.
        detector: Signal from which envelopes are computed: ``"itself"``, the rectified channel;
            ``"modulus"``, the modulus of its analytic signal; or ``"harmonics"``, this modulus with
            two harmonics.
        response: Frequency responses of the channels, (channels, points // 2 + 1), or of their
            analytic signals, (channels, points), without frequencies that the signals do not have.
        mean_weights: Weights for ``hlsim.msbg.envelope.partial_means``, (3, samples per step).
        interpolation: Weights for ``hlsim.msbg.recruitment.interpolate``. For the detector
            ``"modulus"`` each is repeated, for the real and the imaginary part; of the analytic
            signals of ``"harmonics"`` only the real part is used.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> lowest = bank.bands[0]
    >>> lowest.channels, lowest.detector
    (slice(0, 4, None), 'itself')
    """

    channels: slice
    points: int
    detector: str
    response: Tensor
    mean_weights: Tensor
    interpolation: Tensor


@dataclass(frozen=True)
class MultirateBank:
    """Filter bank for signals of one length, in bands of channels that share a sample rate.

    Attributes:
        bands: Rate bands, from the lowest channels up.
        lowpass: Frequency responses of the envelopes' low-passes, one row per channel,
            (channels, steps // 2 + 1).

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> bank.lowpass.shape
    torch.Size([19, 101])
    """

    bands: tuple[RateBand, ...]
    lowpass: Tensor


def _rate_and_detector(
    bank: FilterBank, centre: float, rate_divisor: int, highest: float
) -> tuple[int, str]:
    """Choose the sample rate of a channel, and the detector, from which its envelope is computed.

    A rate is stated in samples per step. A step is the time between two values of an envelope: 24
    samples at 44.1 kHz, or for signals at 22.05 kHz the time of 24.5 samples at 44.1 kHz.

    Args:
        bank: Filter bank of the channel.
        centre: Centre frequency of the channel in Hz.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency in Hz that the output needs.

    Returns:
        Number of samples per step, and the detector (see ``RateBand``).
    """
    steps_per_second = MSBG_RATE / _envelope_step(rate_divisor)
    bandwidth = float(erb(np.array(centre)))
    top = centre + _BANDWIDTHS_ABOVE_CENTRE * bank.broadening * bandwidth
    has_harmonics_at_0_hz = bank.broadening > _MAX_BROADENING_WITHOUT_HARMONICS
    if centre < _RECTIFIED_BELOW_HZ:
        return _FAST_SAMPLES, "itself"
    if top <= _SLOW_SAMPLES * steps_per_second:
        if has_harmonics_at_0_hz:
            return _FAST_SAMPLES, "harmonics"
        return _SLOW_SAMPLES, "modulus"
    if rate_divisor == 2:
        return int((highest + SKIRT_HZ) / steps_per_second) + 1, "modulus"
    if top <= _FAST_SAMPLES * steps_per_second and not has_harmonics_at_0_hz:
        return _FAST_SAMPLES, "modulus"
    return STEP, "itself"


@compute_once
def multirate_bank(
    bank: FilterBank,
    points: int,
    rate_divisor: int,
    highest: float,
    dtype: torch.dtype,
    device: torch.device,
) -> MultirateBank:
    """Build a filter bank for signals of one length, in bands of channels that share a sample rate.

    Args:
        bank: Parameters of the filter bank.
        points: FFT length of the signals at 44.1 kHz, from ``cochlea_fft_length`` in
            ``hlsim.msbg.cochlea``.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency in Hz that the output needs.
        dtype: Precision of real tensors, and of the parts of complex ones.
        device: Device of the tensors.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> [band.points for band in bank.bands]
    [1200, 1200, 4800]
    """
    step = _envelope_step(rate_divisor)
    steps = round(points / step)
    steps_per_window = next((n for n in _WINDOW_STEPS if steps % n == 0), _WINDOW_STEPS[0])
    # All channels far above the highest frequency make one.
    channels_below = sum(hz <= _MERGED_ABOVE * highest for hz in bank.centre_frequencies)
    count = min(bank.channels, channels_below + 1)
    choices = [
        _rate_and_detector(bank, centre, rate_divisor, highest)
        for centre in bank.centre_frequencies[:count]
    ]
    bands = []
    lowpasses = []
    for (samples, detector), members in itertools.groupby(range(count), choices.__getitem__):
        indices = list(members)
        channels = slice(indices[0], indices[-1] + 1)
        is_analytic = detector != "itself"
        band_points = steps * samples
        bins_of_band = band_points if is_analytic else band_points // 2 + 1
        bins = min(bins_of_band, points // rate_divisor // 2 + 1)
        response = gammatone_response(bank, points, channels, bins)
        lowpass = envelope_lowpass(bank, points, samples, channels, step)
        if channels.stop == count < bank.channels:
            merged = gammatone_response(bank, points, slice(count - 1, None), bins)
            response[-1] = merged.sum(0)
            lowpass[-1] *= _merged_envelope_factor(merged[:, round(highest * points / MSBG_RATE)])

        # The inverse transform of a band divides by fewer points than that of the signal, so that
        # the channels are too loud by the ratio of the rates. The spectrum of their sum is to have
        # this scale, but the envelopes are not.
        weights = mean_weights(samples) * (rate_divisor * samples / step)
        if detector == "modulus":
            # These analytic signals are half as large as usual, so that their spectrum is that of
            # the real signal. The mean of a rectified signal is 2 / pi times twice their modulus.
            response[:, 0] *= 0.5
            weights = weights * (4.0 / math.pi)
        elif detector == "harmonics":
            response[:, 1:] *= 2.0
            weights = weights * (2.0 / math.pi)
        if samples < STEP:
            band_rate = band_points * MSBG_RATE / points
            end = band_rate if is_analytic else band_rate / 2
            response *= fade_out_weights(bins, MSBG_RATE / points, end)
        repeats = 2 if detector == "modulus" else 1
        interpolation = interpolation_kernel(samples, repeats, steps_per_window)
        tensors = [as_tensor(array, dtype, device) for array in (response, weights, interpolation)]
        bands.append(RateBand(channels, band_points, detector, *tensors))
        lowpasses.append(lowpass)
    return MultirateBank(tuple(bands), as_tensor(np.concatenate(lowpasses), dtype, device))


def _envelope_step(rate_divisor: int) -> float:
    """Return the number of samples at 44.1 kHz from one value of an envelope to the next.

    Args:
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
    """
    return STEP if rate_divisor == 1 else HALF_RATE_STEP


def _merged_envelope_factor(responses: NDArray[np.complex128]) -> float:
    """Compute the factor that corrects the envelope of channels that are merged into one.

    With this factor on its envelope, the merged channel has the gain that the sum of separately
    expanded channels would have. It is exact at the frequency of ``responses``, and if channels
    change by ``_MERGED_RATIO`` dB per dB of their input.

    Args:
        responses: Complex responses of the channels at one frequency, (channels,).
    """
    exponent = _MERGED_RATIO - 1.0
    total = abs(responses.sum())
    expanded = abs((responses * np.abs(responses) ** exponent).sum())
    gain = expanded / total
    return float(gain ** (1.0 / exponent) / total)


@constant
def total_response(bank: FilterBank, points: int, rate_divisor: int) -> NDArray[np.complex128]:
    """Compute the frequency response of the sum of all channels, for ears without any loss.

    Args:
        bank: Filter bank, whose channels are added up.
        points: FFT length of the signals at 44.1 kHz.
        rate_divisor: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    Returns:
        Complex response, (points // rate_divisor // 2 + 1,).

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> total_response(BANKS["none"], points=4800, rate_divisor=2).shape
    (1201,)
    """
    signal_points = points // rate_divisor
    total = gammatone_response(bank, points, bins=signal_points // 2 + 1).sum(0)
    if rate_divisor > 1:
        total[-1] = 0.0
    return total
