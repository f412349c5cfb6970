"""Insertion gains of an aid, measured with noise that has the spectrum of average speech."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators.filter_bank import RATE, SPEECH_SPL, speech_density
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_number
from hlsim.dsp.fft import power
from hlsim.torchtools import constant_like


@torch.no_grad()
def measure_gains(
    process: Callable[[Tensor, Tensor], Tensor],
    audiogram: AudiogramLike,
    level: float,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    """Measure gains in thirds of an octave around the eight ``FREQUENCIES``.

    Args:
        process: Function from the input of an aid, (items, time) in pascals, and the thresholds of
            ears, (items, 8), to its output, (items, time).
        audiogram: One or more ears.
        level: Level of the noise in dB SPL, 0 to 120.
        dtype: Type of the noise.
        device: Device of the noise.

    Returns: Gains in dB, (8,) for one ear, else (..., 8).

    Raises:
        ValueError: An ear or the level is not valid.

    >>> gains = measure_gains(
    ...     lambda noise, ears: 10.0 * noise, "N3", 65.0, torch.float32, torch.device("cpu")
    ... )
    >>> gains.round()
    tensor([20., 20., 20., 20., 20., 20., 20., 20.])
    """
    check_number("level", level, 0.0, 120.0)
    thresholds = as_thresholds(audiogram, consumer="an aid").to(device, dtype)
    ears = thresholds.reshape(-1, len(FREQUENCIES))
    noise = constant_like(ears, speech_noise) * 10.0 ** ((level - SPEECH_SPL) / 20.0)
    # The first second, in which gains settle, does not count.
    output = process(noise.repeat(len(ears), 2), ears)[:, RATE:]
    thirds = constant_like(ears, _thirds_of_octave)
    output_power, noise_power = (
        power(torch.fft.rfft(signal)) @ thirds for signal in (output, noise)
    )
    return (10.0 * (output_power / noise_power).log10()).reshape(thresholds.shape)


def speech_noise() -> NDArray[np.float64]:
    """Return one second of noise with the spectrum of average speech at 65 dB SPL.

    Samples are in pascals at 16 kHz, with shape (16000,). The noise can be repeated without a jump.

    >>> speech_noise().shape
    (16000,)
    """
    spectrum = np.zeros(RATE // 2 + 1, dtype=complex)
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, RATE // 2)
    spectrum[1:] = np.sqrt(speech_density(RATE)) * np.exp(1j * phases)
    noise = np.fft.irfft(spectrum)
    rms = 10.0 ** ((SPEECH_SPL - PASCAL_SPL) / 20.0)
    return noise * rms / np.sqrt(np.square(noise).mean())


def _thirds_of_octave() -> NDArray[np.float64]:
    """Return 1 for each whole frequency in Hz in each third of an octave, else 0, (8001, 8)."""
    ratio = np.arange(RATE // 2 + 1)[:, None] / np.array(FREQUENCIES)
    return ((ratio > 2.0 ** (-1.0 / 6.0)) & (ratio < 2.0 ** (1.0 / 6.0))).astype(float)
