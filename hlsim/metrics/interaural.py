"""Differences of level and time between two ears, by which listeners localise sounds.

The differences are computed in five octaves around 250 Hz to 4 kHz. The training loss in
``hlsim.losses.interaural`` compares the differences of two signals.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram.thresholds import check_two_channels
from hlsim.checks import check_rate, check_waveform
from hlsim.dsp.fft import power
from hlsim.metrics.band_levels import band_analysis
from hlsim.torchtools import Samples, as_samples, constant

OCTAVES = (250.0, 500.0, 1000.0, 2000.0, 4000.0)
"""Centre frequencies of the octaves in Hz."""

MAX_DELAY_MICROSECONDS = 1000
"""Largest delay between the ears that is considered. A head causes about 700 microseconds."""


class Interaural(NamedTuple):
    """Differences between the ears in each of five octaves, NaN where an ear is silent.

    The octaves are those of ``OCTAVES``. Shape of each attribute: (..., 5).

    Attributes:
        level: Level of the left ear minus that of the right ear in dB.
        time: Time in microseconds by which the left ear receives the sound earlier, from -1000 to
            1000.
        coherence: Correlation of both ears' signals after a shift by this time, 1 at most. It is
            negative if no such shift brings the signals into phase. The time difference is
            meaningful where the coherence is close to 1.

    >>> Interaural(torch.zeros(5), torch.zeros(5), torch.ones(5)).coherence
    tensor([1., 1., 1., 1., 1.])
    """

    level: Tensor
    time: Tensor
    coherence: Tensor


def interaural(waveform: Samples, *, sample_rate: int = 16000) -> Interaural:
    """Compute the differences of level and time between two ears over a whole signal, per octave.

    The time difference is the delay with the largest cross-correlation of the waveforms in the
    octave. Above 1.5 kHz, listeners perceive delays of the envelope instead. The results are
    float64 and have no gradient.

    Args:
        waveform: Waveforms of the left and the right ear. Shape: (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Returns:
        Level difference in dB, time difference in microseconds, and coherence, see ``Interaural``.
        Shape of each: (..., 5).

    Raises:
        ValueError: The waveform is not a floating-point signal of two channels, has a sample above
            1e9, or the rate is out of range.

    >>> noise = torch.randn(16000)
    >>> interaural(torch.stack((10.0 * noise, noise))).level.round()
    tensor([20., 20., 20., 20., 20.], dtype=torch.float64)
    """
    waveform = check_waveform(as_samples(waveform))
    check_two_channels(waveform)
    left, right, cross, octaves = spectra_of_ears(waveform.detach().double(), sample_rate)
    delays = torch.arange(
        -MAX_DELAY_MICROSECONDS, MAX_DELAY_MICROSECONDS + 1, device=waveform.device
    )
    hz = torch.linspace(0.0, sample_rate / 2.0, len(octaves), dtype=left.dtype, device=left.device)
    phase = 2e-6 * math.pi * hz.unsqueeze(-1) * delays
    cross_of_octaves = octaves.mT * cross.unsqueeze(-2)
    correlations = cross_of_octaves.real @ phase.cos() + cross_of_octaves.imag @ phase.sin()
    correlation, index = correlations.max(-1)
    left_power = left @ octaves
    right_power = right @ octaves
    coherence = correlation / (left_power * right_power).sqrt()
    level = 10.0 * torch.log10(left_power / right_power)
    differences = torch.stack((level, delays[index].to(left), coherence))
    return Interaural(*torch.where(coherence.isfinite(), differences, torch.nan))


def interaural_change(before: Samples, after: Samples, *, sample_rate: int = 16000) -> Interaural:
    """Compute how an aid changes the differences of level and time between two ears.

    Args:
        before: Input of the aid for the left and the right ear. Shape: (..., 2, time).
        after: Output of the aid, of the same shape.
        sample_rate: Sample rate in Hz.

    Returns:
        Level and time differences of the output minus those of the input, in dB and microseconds,
        and the coherence of the output. Shape of each: (..., 5).

    Raises:
        ValueError: The signals are not floating-point samples of at most 1e9, the shapes differ or
            are not (..., 2, time), or the rate is out of range.

    >>> noise = torch.randn(2, 16000)
    >>> interaural_change(noise, noise).level
    tensor([0., 0., 0., 0., 0.], dtype=torch.float64)
    """
    before, after = as_samples(before), as_samples(after)
    if before.shape != after.shape:
        raise ValueError(
            "expected input and output of the same shape, got "
            f"{tuple(before.shape)} and {tuple(after.shape)}; align and cut them"
        )
    of_input = interaural(before, sample_rate=sample_rate)
    of_output = interaural(after, sample_rate=sample_rate)
    return Interaural(
        of_output.level - of_input.level, of_output.time - of_input.time, of_output.coherence
    )


def spectra_of_ears(waveform: Tensor, sample_rate: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute the mean power spectra and the mean cross spectrum of two ears.

    Args:
        waveform: Waveforms of the left and the right ear in Pa. Shape: (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Returns:
        Power spectra of the left and of the right ear in Pa^2, (..., frequencies) each; the complex
        cross spectrum, left times conjugate of right, (..., frequencies); and a matrix with 1 where
        a frequency lies in an octave and 0 elsewhere, (frequencies, 5).

    Raises:
        ValueError: The rate is out of range.

    >>> spectra_of_ears(torch.randn(2, 16000), 16000)[0].shape
    torch.Size([257])
    """
    check_rate(sample_rate)
    stft, _, scale = band_analysis(waveform, sample_rate)
    spectra = stft.analyse(waveform.reshape(-1, waveform.shape[-1])) * scale**0.5
    left, right = spectra.reshape(*waveform.shape[:-1], *spectra.shape[-2:]).unbind(-3)
    left_power = power(left).mean(-2)
    right_power = power(right).mean(-2)
    cross = (left * right.conj()).mean(-2)
    return left_power, right_power, cross, _octaves(stft.fft, sample_rate, like=cross)


@constant
def _octaves(points: int, sample_rate: int) -> NDArray[np.float64]:
    """Assign the frequencies of a Fourier transform to octaves.

    Args:
        points: Length of the transform.
        sample_rate: Sample rate in Hz.

    Returns:
        1 where a frequency lies in an octave, otherwise 0. Shape: (points // 2 + 1, 5).
    """
    hz = np.arange(points // 2 + 1) * sample_rate / points
    octaves_from_centre = np.log2(np.maximum(hz, 1.0)[:, None] / np.array(OCTAVES))
    is_inside = (octaves_from_centre >= -0.5) & (octaves_from_centre < 0.5)
    return is_inside.astype(np.float64)
