"""Loudness recruitment: each channel is expanded by a gain that follows its envelope.

The envelope is low-passed at 75 Hz or less, so that it and the gain are computed at a sixteenth of the rate and the gain
is interpolated, or, where the envelope is near zero, the envelope.
"""

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import ellip, freqz
from torch import Tensor

from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import PASCAL_SPL
from hlsim.msbg.ear import RATE
from hlsim.msbg.filterbank import FilterBank, erb

CATCH_UP_SPL = 105.0
"""Level in dB SPL at which the impaired ear hears as loud as a normal one."""

STEP = 16
"""Samples from one value of the gain to the next."""

# pyclarity limits the envelope to 1e-9 of its full scale of 120 dB SPL
_LOWEST_ENVELOPE = 1e-9 * 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
_HIGHEST_ENVELOPE = 10.0 ** ((CATCH_UP_SPL - PASCAL_SPL) / 20.0)
_BOXES = 3  # three running means of 16 samples put zeros of third order where decimation would alias to 0 Hz
_TAPS = 6

AHEAD = _TAPS // 2
"""Steps ahead of a sample that its gain is interpolated from."""

_SLIGHT = 1.3  # expansion ratio at 24 dB HL


def expansion_ratios(thresholds: Tensor, bank: FilterBank) -> Tensor:
    """Ratio 105 / (105 - threshold) by which each channel's level is expanded.

    Thresholds are interpolated linearly over Hz and extended flat below 250 and above 8000 Hz.

    Shape: (..., 8) dB HL -> (..., channels).
    """
    weights = torch.from_numpy(_interpolation(bank.centre_frequencies)).to(thresholds)
    return CATCH_UP_SPL / (CATCH_UP_SPL - thresholds @ weights)


def envelope(channels: Tensor, lowpass: Tensor) -> Tensor:
    """Full-wave rectify and low-pass, zero-phase, at a sixteenth of the rate.

    Shape: (..., channels, time), (channels, time // 32 + 1) -> (..., channels, time // 16), the values at samples 0, 16,
    ...; ``time`` is a multiple of 32 and the signal is taken as periodic.
    """
    blocks = channels.abs().unflatten(-1, (-1, STEP))
    kernel = torch.from_numpy(_decimation_kernel()).to(channels)
    before, here, after = (blocks @ kernel).unbind(-1)
    slow = before.roll(1, -1) + here + after.roll(-1, -1)
    return torch.fft.irfft(torch.fft.rfft(slow) * lowpass, slow.shape[-1])


def expand(channels: Tensor, envelopes: Tensor, ratios: Tensor) -> Tensor:
    """Apply the recruitment gain (envelope / catch-up level) ** (ratio - 1) and sum the channels.

    Shape: (..., channels, time), (..., channels, time // 16), (..., channels) -> (..., time).
    """
    kernel = torch.from_numpy(_interpolation_kernel()).to(channels)
    gain = _around(_gain(envelopes, ratios.unsqueeze(-1))) @ kernel
    # The low-pass overshoots, and where the envelope goes through zero the gain has kinks. A small loss does not bury
    # them, and the way out of the ear lifts their upper end by 40 dB, so that there the envelope is interpolated instead.
    slight = (ratios != 1.0) & (ratios < _SLIGHT)
    if bool(slight.any()):
        floored = envelopes.detach().clamp_min(_LOWEST_ENVELOPE)
        low = torch.minimum(floored, floored.roll(-1, -1))
        high = torch.maximum(floored, floored.roll(-1, -1))
        steep = low < 0.3 * torch.maximum(high.roll(1, -1), high.roll(-1, -1))
        steep = steep & slight.unsqueeze(-1)
        own = ratios.unsqueeze(-1).expand(steep.shape)[steep].unsqueeze(-1)
        gain[steep] = _gain(_around(envelopes)[steep] @ kernel, own)
    full = gain.flatten(-2)
    if torch.is_grad_enabled() and (channels.requires_grad or full.requires_grad):
        return (channels * full).sum(-2)
    total = torch.zeros_like(channels[..., 0, :])
    # in place, a channel at a time: it stays in the processor's cache
    for channel in range(channels.shape[-2]):
        total.addcmul_(channels[..., channel, :], full[..., channel, :])
    return total


def _gain(envelopes: Tensor, ratios: Tensor) -> Tensor:
    level = envelopes.clamp(_LOWEST_ENVELOPE, _HIGHEST_ENVELOPE).div(_HIGHEST_ENVELOPE).log()
    return (level * (ratios - 1.0)).exp()


def _around(values: Tensor) -> Tensor:
    """The six values about each step. Shape: (..., steps) -> (..., steps, 6)."""
    return torch.cat((values[..., 1 - AHEAD :], values, values[..., :AHEAD]), -1).unfold(-1, _TAPS, 1)


@lru_cache(maxsize=16)
def envelope_lowpass(bank: FilterBank, points: int) -> NDArray[np.complex128]:
    """Response that turns the rfft of the block means into that of the envelope at samples 0, 16, ...

    The low-pass is ``ellip(2, 0.25, 35)`` at 3/4 of 100 Hz or of the channel's ERB if less, run forwards and backwards
    as pyclarity does with ``filtfilt``; what that does at the end is in ``hlsim.msbg.ending``.

    Returns: (channels, points // 32 + 1).
    """
    omega = 2.0 * np.pi * np.arange(points // STEP // 2 + 1) / points
    rows = [np.abs(freqz(*coefficients, omega)[1]) ** 2 for coefficients in envelope_filters(bank)]
    with np.errstate(invalid="ignore"):
        box = np.sin(STEP * omega / 2.0) / (STEP * np.sin(omega / 2.0))
    box[0] = 1.0
    return np.array(rows) / box**_BOXES * np.exp(-7.5j * omega)


def envelope_filters(bank: FilterBank) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Numerator and denominator of each channel's low-pass."""
    widths = erb(np.array(bank.centre_frequencies))
    return [ellip(2, 0.25, 35, 0.75 * min(100.0, width) / (RATE / 2.0)) for width in widths]


@lru_cache(maxsize=8)
def _interpolation(centre_frequencies: tuple[float, ...]) -> NDArray[np.float64]:
    return np.array([np.interp(centre_frequencies, FREQUENCIES, row) for row in np.eye(len(FREQUENCIES))])


@lru_cache(maxsize=1)
def _decimation_kernel() -> NDArray[np.float64]:
    """Weights of a block's samples in the mean around the block after it, itself and the one before. Returns (16, 3)."""
    box = np.full(STEP, 1.0 / STEP)
    kernel = np.pad(np.convolve(np.convolve(box, box), box), 1)
    return np.ascontiguousarray(kernel.reshape(_BOXES, STEP).T)


@lru_cache(maxsize=1)
def _interpolation_kernel() -> NDArray[np.float64]:
    """Lagrange weights of six neighbours for the sixteen samples from the third on. Returns (6, 16)."""
    nodes = np.arange(_TAPS) - (_TAPS // 2 - 1.0)
    place = np.arange(STEP) / STEP
    weights = np.ones((_TAPS, STEP))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            weights[i] *= (place - other) / (node - other)
    return weights
