"""The interaural criterion: how much an aid changes the differences between two ears."""

import torch
from torch import Tensor

from hlsim.dsp.fft import power
from hlsim.metrics.interaural import spectra_of_ears

HALF_WEIGHT_RATIO = 1e-4
"""Power of an octave relative to the loudest octave at which the octave has half its weight."""

_POWER_FLOOR = 1e-12
"""Power in Pa^2, -26 dB SPL, that is added to powers, so that the gradient of silence is finite."""


def interaural_loss(output: Tensor, clean: Tensor, sample_rate: int) -> Tensor:
    """Compute how much an aid changes the differences between the ears, as a loss for training.

    Gains and delays that are equal in both ears are ignored. The loss of an octave is the error of
    the level difference in bels (10 dB), plus 1 minus the cosine of the error of the phase
    difference. The result is a mean over five octaves around 250 Hz to 4 kHz, in which octaves
    where clean speech is soft have less weight. Differences are those of mean spectra over the
    whole signal, so that changes over time may cancel.

    Args:
        output: Output of an aid for the left and the right ear in Pa. Shape: (..., 2, time).
        clean: Clean speech at the left and the right ear in Pa. Shape: (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Returns:
        One loss per pair of ears, about 0 for equal differences. Shape: (...).

    Raises:
        ValueError: The rate is out of range.

    >>> noise = torch.randn(2, 16000)
    >>> bool(interaural_loss(2.0 * noise, noise, 16000) < 1e-3)
    True
    """
    left, right, cross, octaves = spectra_of_ears(output, sample_rate)
    clean_left, clean_right, clean_cross, _ = spectra_of_ears(clean, sample_rate)
    left_level, right_level, clean_left_level, clean_right_level = (
        torch.log10(ear @ octaves + _POWER_FLOOR) for ear in (left, right, clean_left, clean_right)
    )
    level_error = (left_level - right_level - clean_left_level + clean_right_level).abs()
    # The added power is proportional to those of the ears. With a constant instead, the phase of an
    # ear that is nearly silent would have a gradient of a million.
    cross_floor = _POWER_FLOOR * (left + right + _POWER_FLOOR)
    phase = cross / (power(cross) + cross_floor).sqrt()
    magnitude = (power(clean_cross) + _POWER_FLOOR**2).sqrt() @ octaves
    cosine = (phase * clean_cross.conj()).real @ octaves / magnitude
    clean_power = (clean_left + clean_right).detach() @ octaves
    power_of_half_weight = HALF_WEIGHT_RATIO * clean_power.amax(-1, keepdim=True)
    weights = clean_power / (clean_power + power_of_half_weight + _POWER_FLOOR)
    error = level_error + 1.0 - cosine
    return (weights * error).sum(-1) / (weights.sum(-1) + _POWER_FLOOR)
