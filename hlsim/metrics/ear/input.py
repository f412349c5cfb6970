"""What Kates' ear does to a pair of signals before it listens: 24 kHz, bulk alignment, silent ends cut, middle ear."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.fft import fft_length
from hlsim.metrics.ear.recursions import RATE
from hlsim.torchtools import constant

_ZEROS, _BETA = 10, 5.0  # of the resampling filter: scipy's ``resample_poly``
_TOGETHER = 64  # outputs, about, that share a row of inputs
_RING = 4096  # samples in which the Chebyshev filters fade out

_HEADROOM = RATE // 500
"""2 ms by which the processed signal is left late, for dispersion."""

_AUDIBLE_PART = 0.001  # of the reference's maximum: what is quieter at its ends is cut


def to_ear_rate(signal: Tensor, sample_rate: int) -> Tensor:
    """One signal at 24 kHz, its RMS kept; from rates above, the RMS of what lies below 10.5 kHz.

    A Kaiser-windowed sinc as in scipy's ``resample_poly``; the level is matched afterwards, as Kates does.

    Shape: (time,) -> (ceil(time * 24000 / sample_rate),).
    """
    if sample_rate == RATE:
        return signal
    common = math.gcd(RATE, sample_rate)
    up, down = RATE // common, sample_rate // common
    length = -(-signal.shape[-1] * up // down)
    periods = max(1, _TOGETHER // up)
    kernel = constant(_kernel, up, down, periods, dtype=signal.dtype, device=signal.device)
    inputs, outputs = kernel.shape
    rows = -(-length // outputs)
    lead = _reach(up, down)
    padded = functional.pad(
        signal, (lead, max(0, (rows - 1) * down * periods + inputs - lead - len(signal)))
    )
    resampled = (padded.unfold(-1, inputs, down * periods)[:rows] @ kernel).flatten()[:length]
    if sample_rate < RATE:
        powers = (signal.square().mean(), resampled.square().mean())
    else:
        powers = (_power_below(signal, sample_rate), _power_below(resampled, RATE))
    heard = powers[1] > 0.0  # of silence there is no level to match
    return (
        resampled * torch.where(heard, powers[0] / torch.where(heard, powers[1], 1.0), 1.0).sqrt()
    )


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


def _power_below(signal: Tensor, rate: int) -> Tensor:
    """Mean power of what lies below 10.5 kHz, by Kates' Chebyshev filter of seventh order."""
    time = signal.shape[-1]
    points = fft_length(time + _RING, 2)
    response = constant(_chebyshev, rate, points, dtype=torch.complex128, device=signal.device)
    spectrum = torch.fft.rfft(signal, points) * response.to(signal.dtype.to_complex())
    return torch.fft.irfft(spectrum, points)[:time].square().mean()


def _chebyshev(rate: int, points: int) -> NDArray[np.complex128]:
    sections = scipy.signal.cheby2(7, 30, 21000.0 / rate, output="sos")
    response: NDArray[np.complex128] = scipy.signal.sosfreqz(
        sections, 2.0 * np.pi * np.arange(points // 2 + 1) / points
    )[1]
    return response


def audible_part(reference: Tensor) -> slice:
    """Where a reference begins and ends, silence left out. Shape: (time,)."""
    loud = reference.detach().abs()
    places = (loud > _AUDIBLE_PART * loud.max()).nonzero()
    return slice(int(places[0]), int(places[-1]) + 1)


def spectrum_for_alignment(signal: Tensor) -> Tensor:
    """Of a signal without its mean, long enough for lags of its whole length. Shape: (time,) -> (bins,)."""
    steady = signal.detach() - signal.detach().mean()
    return torch.fft.rfft(steady, fft_length(2 * signal.shape[-1], 2))


def bulk_delay(reference_spectrum: Tensor, processed: Tensor) -> int:
    """Samples by which the processed signal is to be moved, later where positive: to 2 ms behind the reference.

    By the largest magnitude of the cross-covariance; of equal ones the first.

    Args:
        reference_spectrum: by ``spectrum_for_alignment``, of a reference as long as the processed signal.
    """
    time, points = processed.shape[-1], fft_length(2 * processed.shape[-1], 2)
    with torch.no_grad():
        spectrum = reference_spectrum * spectrum_for_alignment(processed).conj()
        covariance = torch.fft.irfft(spectrum, points).abs()
        # by ascending lag, from 1 - time to time - 1
        place = int(torch.cat((covariance[points - time + 1 :], covariance[:time])).argmax())
    return place - (time - 1) + _HEADROOM


def moved(signal: Tensor, delay: int, part: slice) -> Tensor:
    """A part of a signal moved later by ``delay`` samples (earlier where negative), with zeros for what is not there."""
    time = signal.shape[-1]
    start, stop = part.start - delay, part.stop - delay
    inside = signal[..., min(max(start, 0), time) : max(min(stop, time), 0)]
    before = min(max(-start, 0), stop - start)
    return functional.pad(inside, (before, stop - start - before - inside.shape[-1]))


def stacked(signals: Sequence[Tensor], length: int) -> Tensor:
    """Signals of several lengths in one tensor, silent after their ends. Shape: (time,) each -> (items, length)."""
    return torch.stack(
        [functional.pad(signal, (0, length - signal.shape[-1])) for signal in signals]
    )
