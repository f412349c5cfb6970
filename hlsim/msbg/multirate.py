"""The filter bank with each channel at a sample rate that its band needs.

A gammatone channel occupies a band. It is kept up to five bandwidths above its centre frequency,
where its gain is -57 dB, or up to the highest frequency of interest. The rate, and the computation
of the envelope, depend on the channel:

- Narrow channels are analytic signals at about 5.5 kHz, or at about 11 kHz (9 kHz where the highest
  frequency of interest allows it). The modulus of an analytic signal is its envelope. A rectifier
  would add harmonics of the band, but the low-pass of the envelope removes them.
- With severe losses, channels are so wide for their centre frequency that harmonics reach down to
  0 Hz. Two harmonics complete the modulus of these channels.
- The lowest channels, and the widest ones at 44.1 kHz, are rectified as in the reference, whose
  harmonics alias at this rate.

Channels whose centre frequency is far above the highest frequency of interest respond to the
frequencies next to it with their skirts, and all of them expand by the threshold at 8 kHz. They are
computed as one channel, their sum.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.dsp.fft import fade_out_weights
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import HALF_RATE_STEP, STEP, decimation_kernel, envelope_lowpass
from hlsim.msbg.filterbank import FilterBank, gammatone_response
from hlsim.msbg.recruitment import interpolation_kernel
from hlsim.msbg.smearing import SKIRT_HZ
from hlsim.torchtools import as_tensor

_BANDWIDTHS_ABOVE_CENTRE = 5.0
"""Bandwidths above its centre frequency up to which a channel is kept."""

_MAX_BROADENING_WITHOUT_HARMONICS = 2.5
"""Broadening of channels above which a rectifier's harmonics reach down to 0 Hz."""

_RECTIFIED_BELOW_HZ = 400.0
"""Centre frequency below which the channels themselves are rectified."""

_MERGED_ABOVE = 1.75
"""Centre frequency above which channels are merged, relative to the highest of interest."""

_MERGED_RATIO = 1.3
"""Expansion ratio at which the gain of merged channels is exact, that of a loss of 24 dB.

At larger ratios they are softer, so that errors matter less.
"""

_SAMPLES_PER_BAND = 2_000_000
"""Samples of a rate band on a CPU, few enough for its cache."""

_SLOW_SAMPLES = 3
"""Samples per step of channels at about 5.5 kHz."""

_FAST_SAMPLES = 6
"""Samples per step of channels at about 11 kHz."""

_WINDOW_STEPS = (8, 9, 7, 10, 6, 5)
"""Numbers of steps that one row of a matrix product may interpolate, the preferred one first."""

Detector = Literal["itself", "modulus", "harmonics"]
"""Signal from which the envelope is computed: the rectified channel itself, the modulus of the
analytic signal, or this modulus with two harmonics."""


@dataclass(frozen=True)
class RateBand:
    """Neighbouring channels that run at one sample rate.

    Attributes:
        channels: Indices of the channels in the bank.
        points: FFT length at the band's rate.
        detector: Signal from which envelopes are computed.
        response: Responses of the channels with shape (channels, points // 2 + 1), or of their
            analytic signals with shape (channels, points).
        decimation: Weights of the samples of a step. Shape: (3, samples).
        interpolation: Weights from ``interpolation_kernel``, repeated for the real and imaginary
            parts of analytic signals.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> lowest = bank.bands[0]
    >>> lowest.channels, lowest.detector
    (slice(0, 4, None), 'itself')
    """

    channels: slice
    points: int
    detector: Detector
    response: Tensor
    decimation: Tensor
    interpolation: Tensor


@dataclass(frozen=True)
class MultirateBank:
    """Filter bank for signals of one length.

    Attributes:
        bands: Rate bands, from the lowest channels up.
        lowpass: Responses of the envelopes' low-passes, one row per channel of the bands. Shape:
            (channels, steps // 2 + 1).

    >>> from hlsim.msbg.filterbank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> bank.lowpass.shape
    torch.Size([19, 101])
    """

    bands: tuple[RateBand, ...]
    lowpass: Tensor

    @property
    def nbytes(self) -> int:
        """Size of the largest tensors in bytes."""
        return self.lowpass.nbytes + sum(band.response.nbytes for band in self.bands)


def assign_rates(
    bank: FilterBank, step: int, highest: float = MSBG_RATE / 2
) -> list[tuple[slice, int, Detector]]:
    """Divide the channels of a bank into bands with a common rate and detector.

    Channels above ``highest`` are left out; the last channel of the result is used for them.

    Args:
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency of interest in Hz, at most 11025 if ``step`` is 2.

    Returns: The channels of each band, the number of its samples in 24 samples at 44.1 kHz, and the
        signal from which its envelopes are computed: the channel itself, or the modulus of its
        analytic signal. The lowest band comes first.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> for channels, samples, detector in assign_rates(BANKS["moderate"], step=2, highest=8000.0):
    ...     print(channels.start, channels.stop, samples, detector)
    0 6 6 itself
    6 15 3 modulus
    15 27 5 modulus
    """
    centre_hz = np.array(bank.centre_frequencies)
    bandwidths_above = _BANDWIDTHS_ABOVE_CENTRE * bank.broadening
    is_wide = bank.broadening > _MAX_BROADENING_WITHOUT_HARMONICS
    kinds = [
        _rate_and_detector(hz, hz + bandwidths_above * float(width), is_wide, step, highest)
        for hz, width in zip(bank.centre_frequencies, erb(centre_hz), strict=True)
    ]
    kinds = kinds[: _count_channels(bank, highest)]
    changes = [channel for channel in range(1, len(kinds)) if kinds[channel] != kinds[channel - 1]]
    bounds = [0, *changes, len(kinds)]
    return [(slice(start, stop), *kinds[start]) for start, stop in itertools.pairwise(bounds)]


def _rate_and_detector(
    centre: float, top: float, is_wide: bool, step: int, highest: float
) -> tuple[int, Detector]:
    """Choose the samples per step and the detector of a channel.

    Args:
        centre: Centre frequency in Hz.
        top: Frequency in Hz up to which the channel is kept.
        is_wide: Whether harmonics of the channel reach down to 0 Hz.
        step, highest: Arguments of ``assign_rates``.
    """
    steps_per_second = MSBG_RATE / envelope_step(step)
    if centre < _RECTIFIED_BELOW_HZ:
        return _FAST_SAMPLES, "itself"
    if top <= _SLOW_SAMPLES * steps_per_second:
        return (_FAST_SAMPLES, "harmonics") if is_wide else (_SLOW_SAMPLES, "modulus")
    if step == 2:
        return int((highest + SKIRT_HZ) / steps_per_second) + 1, "modulus"
    if top <= _FAST_SAMPLES * steps_per_second and not is_wide:
        return _FAST_SAMPLES, "modulus"
    return STEP, "itself"


def multirate_bank(
    bank: FilterBank,
    points: int,
    step: int,
    highest: float,
    dtype: torch.dtype,
    device: torch.device,
) -> MultirateBank:
    """Build a filter bank for signals of one length, with each channel at its own rate.

    Args:
        points: FFT length at 44.1 kHz, a multiple of the 24 samples between two values of an
        envelope.
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.
        highest: Highest frequency of interest in Hz.
        dtype: Precision of real tensors, and of the parts of complex ones.
        device: Device of the tensors.

    >>> from hlsim.msbg.filterbank import BANKS
    >>> device = torch.device("cpu")
    >>> bank = multirate_bank(BANKS["severe"], 4800, 1, 22050.0, torch.float32, device)
    >>> [band.points for band in bank.bands]
    [1200, 1200, 4800]
    """
    steps = round(points / envelope_step(step))
    bands = []
    lowpasses = []
    for channels, samples, detector in _split_for_cache(
        assign_rates(bank, step, highest), steps, device
    ):
        is_analytic = detector != "itself"
        band_points = steps * samples
        bins_of_band = band_points if is_analytic else band_points // 2 + 1
        bins = min(bins_of_band, points // step // 2 + 1)
        response = gammatone_response(bank, points, channels, bins)
        lowpass = envelope_lowpass(bank, points, samples, channels, envelope_step(step))
        count = _count_channels(bank, highest)
        if channels.stop == count < bank.channels:
            merged = gammatone_response(bank, points, slice(count - 1, None), bins)
            response[-1] = merged.sum(0)
            lowpass[-1] *= _merged_envelope_factor(merged[:, round(highest * points / MSBG_RATE)])

        # The inverse transform of a band divides by fewer points than that of the signal, so that
        # the channels are too loud by the ratio of the rates. The spectrum of their sum is to have
        # this scale, but the envelopes are not.
        decimation = decimation_kernel(samples) * (step * samples / envelope_step(step))
        if detector == "modulus":
            # These analytic signals are half as large as usual, so that their spectrum is that of
            # the real signal. The mean of a rectified signal is 2 / pi times twice their modulus.
            response[:, 0] *= 0.5
            decimation = decimation * (4.0 / math.pi)
        elif detector == "harmonics":
            response[:, 1:] *= 2.0
            decimation = decimation * (2.0 / math.pi)
        if samples < STEP:
            band_rate = band_points * MSBG_RATE / points
            response *= fade_out_weights(
                bins, MSBG_RATE / points, band_rate if is_analytic else band_rate / 2
            )
        steps_per_window = next((n for n in _WINDOW_STEPS if steps % n == 0), _WINDOW_STEPS[0])
        repeats = 2 if detector == "modulus" else 1
        interpolation = interpolation_kernel(samples, repeats, steps_per_window)
        bands.append(
            RateBand(
                channels,
                band_points,
                detector,
                as_tensor(response, dtype, device),
                as_tensor(decimation, dtype, device),
                as_tensor(interpolation, dtype, device),
            )
        )
        lowpasses.append(lowpass)
    return MultirateBank(tuple(bands), as_tensor(np.concatenate(lowpasses), dtype, device))


def envelope_step(step: int) -> float:
    """Samples at 44.1 kHz from one value of an envelope to the next.

    Args:
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    >>> envelope_step(2)
    24.5
    """
    return STEP if step == 1 else HALF_RATE_STEP


def _count_channels(bank: FilterBank, highest: float) -> int:
    """Count the channels, where all that are far above the highest frequency count as one."""
    limit = _MERGED_ABOVE * highest
    return min(bank.channels, 1 + sum(hz <= limit for hz in bank.centre_frequencies))


def _merged_envelope_factor(responses: NDArray[np.complex128]) -> float:
    """Compute the factor on the envelope of merged channels that gives them the gain of their sum.

    Args:
        responses: Responses of the channels at one frequency. Shape: (channels,).
    """
    exponent = _MERGED_RATIO - 1.0
    total = abs(responses.sum())
    expanded = abs((responses * np.abs(responses) ** exponent).sum())
    gain = expanded / total
    return float(gain ** (1.0 / exponent) / total)


def total_response(bank: FilterBank, points: int, step: int) -> NDArray[np.complex128]:
    """Compute the response of the sum of all channels, for ears without any loss.

    Args:
        points: FFT length at 44.1 kHz.
        step: 1 for signals at 44.1 kHz, 2 for signals at 22.05 kHz.

    Returns: Response of shape (points // step // 2 + 1,).

    >>> from hlsim.msbg.filterbank import BANKS
    >>> total_response(BANKS["none"], points=4800, step=2).shape
    (1201,)
    """
    signal_points = points // step
    total = gammatone_response(bank, points, bins=signal_points // 2 + 1).sum(0)
    if step > 1 and signal_points % 2 == 0:
        total[-1] = 0.0
    return total


def _split_for_cache(
    bands: list[tuple[slice, int, Detector]], steps: int, device: torch.device
) -> list[tuple[slice, int, Detector]]:
    """Split bands on a CPU into parts whose samples fit into its cache.

    Args:
        bands: Result of ``assign_rates``.
        steps: Number of steps of the envelopes.
    """
    if device.type != "cpu":
        return bands
    parts = []
    for channels, samples, detector in bands:
        count = channels.stop - channels.start
        values_per_sample = 1 if detector == "itself" else 2
        pieces = min(
            count, math.ceil(count * values_per_sample * steps * samples / _SAMPLES_PER_BAND)
        )
        bounds = [channels.start + count * piece // pieces for piece in range(pieces + 1)]
        for start, stop in itertools.pairwise(bounds):
            parts.append((slice(start, stop), samples, detector))
    return parts
