"""Sounds of the digits-in-noise test: triplets of digits, masking noise, and noise of the ear."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import soundfile
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.data.bundled import DIGIT_DBFS, DIGITS, SLOT_SAMPLES
from hlsim.metrics.sii import INTERNAL_NOISE, SII_BANDS

DIGITS_PER_TRIPLET = 3

LEAD_SAMPLES = NEURO_RATE // 2
"""Number of samples of noise before the first digit, during which the gains of an aid settle."""

TAIL_SAMPLES = NEURO_RATE // 4
"""Number of samples of noise after the slot of the last digit."""

TRIPLET_SAMPLES = LEAD_SAMPLES + DIGITS_PER_TRIPLET * SLOT_SAMPLES + TAIL_SAMPLES
"""Length of a triplet, 3 s, in samples at 16 kHz."""

_SPECTRUM_SAMPLES = 4096
"""Length of the frames from which the spectrum of the digits is computed."""

INTERNAL_NOISE_HZ = (50, 100, *SII_BANDS)
"""Frequencies in Hz of ``INTERNAL_NOISE_DB``: third octaves, and 50 and 100 Hz."""

INTERNAL_NOISE_DB = (4.0, 2.0, *INTERNAL_NOISE)
"""Spectrum level in dB SPL per Hz of the internal noise of a normal ear, at ``INTERNAL_NOISE_HZ``.

Source: ANSI S3.5-1997, table 3, from 160 Hz; below, an extrapolation.
"""


class Triplets(NamedTuple):
    """Triplets of digits with their noises, which all ears and aids of a test share.

    Signals have 16 kHz and last 3 s (``TRIPLET_SAMPLES``): 0.5 s of noise, three digits of 0.75 s
    each, and 0.25 s of noise.

    Attributes:
        speech: Digits without noise, each with RMS 1 without the silence around it, (triplets,
            time), or at several microphones, (triplets, ..., time).
        noise: Masking noise with RMS 1 and the long-term spectrum of the digits, in the shape of
            ``speech``.
        internal: Internal noise of a normal ear in pascals, (triplets, time).
        digits: Spoken digits, 0 to 9, (triplets, 3).

    >>> draw_triplets(2, torch.Generator().manual_seed(0)).speech.shape
    torch.Size([2, 48000])
    """

    speech: Tensor
    noise: Tensor
    internal: Tensor
    digits: Tensor


@cache
def load_digits() -> Tensor:
    """Load the bundled digits, each scaled so that its spoken part has RMS 1.

    All calls return the same tensor, which must not be changed.

    Returns:
        Samples at 16 kHz, (voices, 10, SLOT_SAMPLES), where the second index is the digit, 0 to 9.

    >>> load_digits().shape
    torch.Size([8, 10, 12000])
    """
    voices = [soundfile.read(path, dtype="float32")[0] for path in sorted(DIGITS.glob("*.flac"))]
    samples = torch.from_numpy(np.stack(voices)) / 10.0 ** (DIGIT_DBFS / 20.0)
    return samples.reshape(len(voices), -1, SLOT_SAMPLES)


def draw_triplets(count: int, generator: torch.Generator) -> Triplets:
    """Draw triplets of digits with noises. One voice speaks all digits of a triplet.

    Args:
        count: Number of triplets.
        generator: Source of the random numbers.

    Returns:
        Speech, masking noise, internal noise and digits, see ``Triplets``.

    >>> draw_triplets(2, torch.Generator().manual_seed(0)).digits.shape
    torch.Size([2, 3])
    """
    bank = load_digits()
    voices = torch.randint(len(bank), (count, 1), generator=generator)
    digits = torch.randint(10, (count, DIGITS_PER_TRIPLET), generator=generator)
    speech = nn.functional.pad(bank[voices, digits].flatten(1), (LEAD_SAMPLES, TAIL_SAMPLES))
    noise = _draw_noise(count, _speech_amplitudes(), generator)
    internal = _draw_noise(count, _internal_amplitudes(), generator)
    return Triplets(speech, noise / noise.square().mean(-1, keepdim=True).sqrt(), internal, digits)


def present(triplets: Triplets, snr: Tensor, noise_spl: float | Tensor) -> Tensor:
    """Mix the digits with the masking noise, at a level and a signal-to-noise ratio.

    Args:
        triplets: Digits and noises.
        snr: Level of a digit minus that of the noise in dB, per triplet.
        noise_spl: Level of the noise in dB SPL, for all triplets or per triplet.

    Returns:
        Samples in pascals at 16 kHz, in the shape of ``triplets.speech``.

    >>> triplets = draw_triplets(1, torch.Generator().manual_seed(0))
    >>> present(triplets, torch.tensor([0.0]), 65.0).shape
    torch.Size([1, 48000])
    """
    noise_gain = 10.0 ** ((torch.as_tensor(noise_spl) - PASCAL_SPL) / 20.0)
    like_signals = (-1, *[1] * (triplets.speech.ndim - 1))
    mixture = triplets.noise + triplets.speech * 10.0 ** (snr.reshape(like_signals) / 20.0)
    return mixture * noise_gain.reshape(like_signals)


def perceive(signals: Tensor, thresholds: Tensor, simulator: nn.Module, internal: Tensor) -> Tensor:
    """Simulate what ears perceive of signals, and add the internal noise of a normal ear.

    For a normal ear, this noise masks what is below its threshold. A simulator makes a sound as
    soft as it is for the impaired ear, so the same noise also masks what is below the threshold of
    that ear.

    Args:
        signals: Signals in pascals at 16 kHz, (triplets, time).
        thresholds: Thresholds of the ears in dB HL, (triplets, 8), or (8,) for one ear.
        simulator: Simulator of the hearing loss, which is called with signals and thresholds.
        internal: Internal noise of a normal ear in pascals, (triplets, time).

    Returns:
        Perceived signals with the internal noise in pascals, (triplets, time).

    >>> from hlsim.simulators import load_simulator
    >>> triplets = draw_triplets(1, torch.Generator().manual_seed(0))
    >>> sound = present(triplets, torch.tensor([0.0]), 65.0)
    >>> ears = torch.full((1, 8), 40.0)
    >>> perceive(sound, ears, load_simulator("msbg"), triplets.internal).shape
    torch.Size([1, 48000])
    """
    return simulator(signals, thresholds) + internal


def _draw_noise(count: int, amplitudes: Tensor, generator: torch.Generator) -> Tensor:
    """Draw Gaussian noise whose spectrum is shaped by a factor per frequency.

    Args:
        count: Number of signals.
        amplitudes: Factors at the frequencies of a triplet's real Fourier transform,
            (TRIPLET_SAMPLES / 2 + 1,).
        generator: Source of the random numbers.

    Returns: Samples, (count, TRIPLET_SAMPLES).
    """
    white = torch.randn(count, TRIPLET_SAMPLES, generator=generator)
    return torch.fft.irfft(torch.fft.rfft(white) * amplitudes, TRIPLET_SAMPLES)


@cache
def _speech_amplitudes() -> Tensor:
    """Compute the long-term magnitude spectrum of all digits, on any scale.

    Returns: Magnitudes at the frequencies of a triplet's real Fourier transform, (TRIPLET_SAMPLES /
        2 + 1,).
    """
    words = load_digits().double()
    speech = words[words != 0.0]
    frames = speech[: len(speech) // _SPECTRUM_SAMPLES * _SPECTRUM_SAMPLES]
    frames = frames.reshape(-1, _SPECTRUM_SAMPLES) * torch.hann_window(_SPECTRUM_SAMPLES).double()
    amplitudes = torch.fft.rfft(frames).abs().square().mean(0).sqrt().numpy()
    return _interpolate(amplitudes, np.linspace(0.0, NEURO_RATE / 2.0, len(amplitudes)))


@cache
def _internal_amplitudes() -> Tensor:
    """Compute the factors that turn white noise of RMS 1 into the internal noise in pascals.

    Returns: Factors at the frequencies of a triplet's real Fourier transform (``torch.fft.rfft``),
        (TRIPLET_SAMPLES / 2 + 1,).
    """
    root_density = 10.0 ** ((np.array(INTERNAL_NOISE_DB) - PASCAL_SPL) / 20.0)
    return _interpolate(
        root_density * np.sqrt(NEURO_RATE / 2.0), np.array(INTERNAL_NOISE_HZ, float)
    )


def _interpolate(amplitudes: NDArray[Any], hertz: NDArray[np.float64]) -> Tensor:
    """Interpolate amplitudes at ``hertz`` to the frequencies of a triplet's Fourier transform.

    Beyond the first and the last frequency, they are constant.

    Shape: (n,), (n,) -> (TRIPLET_SAMPLES / 2 + 1,).
    """
    grid = np.fft.rfftfreq(TRIPLET_SAMPLES, 1.0 / NEURO_RATE)
    return torch.from_numpy(np.interp(grid, hertz, amplitudes).astype(np.float32))
