"""What tells where a sound comes from: differences of level and of time between two ears, by octaves."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import check_two_channels
from hlsim.checks import check_rate, check_waveform
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT
from hlsim.torchtools import constant_like

OCTAVES = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
"""Centres in Hz."""

_LONGEST = 1000  # microseconds that a delay is looked for; a head makes some 700
_TINY = 1e-12  # power, -26 dB SPL, that keeps the gradient near silence finite
_DEPTH = 1e-4  # of the loudest octave's power, where an octave counts half


class Interaural(NamedTuple):
    """By ``OCTAVES``, (..., 5) each; NaN where an ear is silent.

    Attributes:
        level: dB by which the left ear's is higher.
        time: microseconds by which the left ear is first, -1000 to 1000.
        coherence: 0 to 1, of the ears at that delay: what is said of time holds where it is near 1.
    """

    level: Tensor
    time: Tensor
    coherence: Tensor


def interaural(waveform: Tensor, *, sample_rate: int = 16000) -> Interaural:
    """Differences between the ears, over all of a signal; the delay is that with the highest cross-correlation.

    Above 1.5 kHz nobody hears the delay of the waveform, but that of its envelope.

    Shape: (..., 2, time), left and right.

    Raises:
        ValueError: another shape, or a rate out of range.
    """
    check_rate(sample_rate)
    check_two_channels(check_waveform(waveform))
    left, right, cross, octaves = _spectra(waveform.detach().double(), sample_rate)
    delays = torch.arange(-_LONGEST, _LONGEST + 1, device=waveform.device)
    hz = torch.linspace(0.0, sample_rate / 2.0, len(octaves), dtype=left.dtype, device=left.device)
    turn = 2e-6 * math.pi * hz.unsqueeze(-1) * delays
    by_octave = octaves.mT * cross.unsqueeze(-2)
    correlation, place = (by_octave.real @ turn.cos() + by_octave.imag @ turn.sin()).max(-1)
    left, right = left @ octaves, right @ octaves
    coherence = correlation / (left * right).sqrt()
    values = (10.0 * torch.log10(left / right), delays[place].to(left), coherence)
    return Interaural(*(torch.where(coherence.isfinite(), one, torch.nan) for one in values))


def interaural_change(before: Tensor, after: Tensor, *, sample_rate: int = 16000) -> Interaural:
    """What an aid makes of ``interaural``: its levels and times after it, less those before, and the coherence after.

    Shape and errors: as ``interaural``, twice.
    """
    first, last = (interaural(one, sample_rate=sample_rate) for one in (before, after))
    return Interaural(last.level - first.level, last.time - first.time, last.coherence)


def interaural_loss(processed: Tensor, clean: Tensor, sample_rate: int) -> Tensor:
    """How far the differences between the ears are from the clean signal's; a gain or delay of both ears changes nothing.

    Mean over the octaves that the clean signal has of the error of the level difference, 1 for 10 dB, and of 1 less the
    cosine of the error of the phase difference.

    Shape: (..., 2, time) twice, in pascals -> (...).
    """
    left, right, cross, octaves = _spectra(processed, sample_rate)
    true_left, true_right, true_cross, _ = _spectra(clean, sample_rate)
    levels = [torch.log10(one @ octaves + _TINY) for one in (left, right, true_left, true_right)]
    error = (levels[0] - levels[1] - levels[2] + levels[3]).abs()
    # as deep as the floor of the powers, or the phase of an ear that is mute would have a gradient of a million
    phase = cross / (power(cross) + _TINY * (left + right + _TINY)).sqrt()
    size = (power(true_cross) + _TINY**2).sqrt() @ octaves
    powers = (true_left + true_right).detach() @ octaves
    weights = powers / (powers + _DEPTH * powers.amax(-1, keepdim=True) + _TINY)
    cosine = (phase * true_cross.conj()).real @ octaves / size
    return (weights * (error + 1.0 - cosine)).sum(-1) / (weights.sum(-1) + _TINY)


def _spectra(waveform: Tensor, sample_rate: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Power of the left and of the right ear, the cross-spectrum, and which frequencies each octave has.

    Shape: (..., 2, time) -> (..., frequencies) three times, (frequencies, 5).
    """
    hop = round(0.016 * sample_rate)
    stft = STFT(2 * hop, 2 * hop, hop)
    spectra = (
        stft.analyse(waveform.reshape(-1, waveform.shape[-1]))
        * (2.0 / (stft.fft * stft.window * 0.375)) ** 0.5
    )
    left, right = spectra.reshape(*waveform.shape[:-1], *spectra.shape[-2:]).unbind(-3)
    means = [one.mean(-2) for one in (power(left), power(right), left * right.conj())]
    return means[0], means[1], means[2], constant_like(means[0], _octaves, stft.fft, sample_rate)


def _octaves(points: int, sample_rate: int) -> NDArray[np.float64]:
    """1 where a frequency of an FFT lies in an octave. Returns (points / 2 + 1, 5)."""
    octaves = np.log2(
        np.maximum(np.arange(points // 2 + 1) * sample_rate / points, 1.0)[:, None]
        / np.array(OCTAVES)
    )
    return ((octaves >= -0.5) & (octaves < 0.5)).astype(np.float64)
