"""What Kates' ear does to a pair of signals before it listens: 24 kHz, bulk alignment, silent ends cut, middle ear."""

from __future__ import annotations

import math

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.model import Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

_ZEROS, _BETA = 10, 5.0  # of the resampling filter: scipy's ``resample_poly``
_TOGETHER = 64  # outputs, about, that share a row of inputs
_RING = 4096  # samples in which the Chebyshev filters fade out

_HEADROOM = RATE // 500
"""2 ms by which the processed signal is left late, for dispersion."""

_AUDIBLE_PART = 0.001  # of the reference's maximum: what is quieter at its ends is cut


def at_ear_rate(extent: Extent, sample_rate: int) -> Extent:
    """Return the lengths of resampled items."""
    return Extent(tuple(-(-end * RATE // sample_rate) for end in extent.ends))


def to_ear_rate(signals: Tensor, sample_rate: int, extent: Extent) -> Tensor:
    """Resample signals to 24 kHz and keep their RMS; from higher rates, the RMS of what lies below 10.5 kHz.

    The filter is a Kaiser-windowed sinc as in scipy's ``resample_poly``. The level is matched afterwards, as Kates does.

    Args:
        signals: zero after the end of each item.
        extent: lengths of the items at ``sample_rate``.

    Shape: (items, time) -> (items, longest of ``at_ear_rate(extent, sample_rate)``), zero after the ends.
    """
    if sample_rate == RATE:
        return signals
    resampled_extent = at_ear_rate(extent, sample_rate)
    common = math.gcd(RATE, sample_rate)
    up, down = RATE // common, sample_rate // common
    periods = max(1, _TOGETHER // up)
    kernel = constant(_kernel, up, down, periods, dtype=signals.dtype, device=signals.device)
    inputs, outputs = kernel.shape
    rows = -(-resampled_extent.longest // outputs)
    lead = _reach(up, down)
    behind = (rows - 1) * down * periods + inputs - lead - signals.shape[-1]
    padded = functional.pad(signals, (lead, max(0, behind)))
    windows = padded.unfold(-1, inputs, down * periods)[:, :rows]
    resampled = resampled_extent.cut((windows @ kernel).flatten(1))
    if sample_rate < RATE:
        before, after = extent.mean(signals.square()), resampled_extent.mean(resampled.square())
    else:
        before = _power_below(signals, sample_rate, extent)
        after = _power_below(resampled, RATE, resampled_extent)
    is_audible = after > 0.0  # silence has no level to match
    ratio = torch.where(is_audible, before / torch.where(is_audible, after, 1.0), 1.0)
    return resampled * ratio.sqrt().unsqueeze(-1)


def _reach(up: int, down: int) -> int:
    """Inputs before an output that count for it."""
    return -(-_ZEROS * max(up, down) // up)


def _kernel(up: int, down: int, periods: int) -> NDArray[np.float64]:
    """Weights of a row of inputs in a row of outputs: (inputs, periods * up)."""
    half = _ZEROS * max(up, down)
    taps = up * scipy.signal.firwin(2 * half + 1, 1.0 / max(up, down), window=("kaiser", _BETA))
    output = np.arange(periods * up)
    inputs = 2 * _reach(up, down) + down * periods
    # input j of a row lies at (j - reach) * up on the grid that both rates share, output k at k * down
    place = half + output[None, :] * down - (np.arange(inputs)[:, None] - _reach(up, down)) * up
    inside = (place >= 0) & (place <= 2 * half)
    return np.where(inside, taps[np.clip(place, 0, 2 * half)], 0.0)


def _power_below(signals: Tensor, rate: int, extent: Extent) -> Tensor:
    """Mean power of what lies below 10.5 kHz, by Kates' Chebyshev filter of seventh order.

    Shape: (items, time) -> (items,).
    """
    points = fft_length(extent.longest + _RING, 2)
    response = constant(_chebyshev, rate, points, dtype=torch.complex128, device=signals.device)
    spectrum = torch.fft.rfft(signals, points) * response.to(signals.dtype.to_complex())
    return extent.mean(torch.fft.irfft(spectrum, points).square())


def _chebyshev(rate: int, points: int) -> NDArray[np.complex128]:
    sections = scipy.signal.cheby2(7, 30, 21000.0 / rate, output="sos")
    response: NDArray[np.complex128] = scipy.signal.sosfreqz(
        sections, 2.0 * np.pi * np.arange(points // 2 + 1) / points
    )[1]
    return response


def audible_ends(references: Tensor) -> tuple[Tensor, Tensor]:
    """First and last sample of each reference that is not silence. Shape: (items, time) -> (items,) twice."""
    magnitude = references.detach().abs()
    time = references.shape[-1]
    loud = magnitude > _AUDIBLE_PART * magnitude.amax(-1, keepdim=True)
    places = torch.arange(time, device=references.device)
    return torch.where(loud, places, time).amin(-1), torch.where(loud, places, -1).amax(-1)


def spectrum_for_alignment(signals: Tensor, extent: Extent) -> Tensor:
    """Spectra of signals without their means, fine enough for lags of their whole length.

    Shape: (items, time) -> (items, bins).
    """
    points = fft_length(2 * extent.longest, 2)
    return torch.fft.rfft(extent.centred(signals.detach()), points)


def bulk_delays(reference_spectrum: Tensor, processed: Tensor, extent: Extent) -> Tensor:
    """Samples by which processed signals are to be moved, later where positive: to 2 ms behind the reference.

    The largest magnitude of the cross-covariance decides, and the first one of several that are equal.

    Args:
        reference_spectrum: returned by ``spectrum_for_alignment`` for references of the same lengths.
        processed: (items, time).

    Returns: (items,), int64.
    """
    time, points = extent.longest, fft_length(2 * extent.longest, 2)
    with torch.no_grad():
        spectrum = reference_spectrum * spectrum_for_alignment(processed, extent).conj()
        covariance = torch.fft.irfft(spectrum, points).abs()
        # by ascending lag, from 1 - time to time - 1
        by_lag = torch.cat((covariance[:, points - time + 1 :], covariance[:, :time]), -1)
        return by_lag.argmax(-1) - (time - 1) + _HEADROOM
