"""Training losses of simulators: differences in dB between an estimate and its target.

The estimate is the output of a network, the target that of the simulator from which it learns.
"""

import torch
from torch import Tensor

from hlsim.calibration import NEURO_RATE
from hlsim.dsp.fft import power
from hlsim.losses.paper import PAPER_STFT
from hlsim.metrics.band_levels import audibility_threshold, audibility_weights, band_levels

POWER_FLOOR = 1e-20
"""Power in Pa^2, -106 dB SPL, that is added to the powers of the error and of the target."""

RELATIVE_FLOOR = 1e-6
"""Power that is added to others, relative to the power of the target: -60 dB."""

SPECTRAL_FLOOR = 1e-12
"""Squared magnitude that is added to those of spectra, so that all levels are finite."""


def noise_to_signal_db(estimate: Tensor, target: Tensor) -> Tensor:
    """Compute the power of the error over that of the target in dB, the negative SNR.

    A perfect estimate has the lowest value, -60 dB, or more for targets below about -30 dB SPL. If
    the target is silent, the value is 0 dB for
    a silent estimate, and otherwise the level of the estimate in dB SPL plus 106 dB.

    Shape: (items, time) twice, in pascals -> (items,).

    >>> speech = torch.ones(1, 100)
    >>> noise_to_signal_db(1.1 * speech, speech).round(decimals=2)
    tensor([-20.])
    """
    signal = target.square().mean(-1)
    error = (estimate - target).square().mean(-1)
    ratio = (error + RELATIVE_FLOOR * signal + POWER_FLOOR) / (signal + POWER_FLOOR)
    return 10.0 * torch.log10(ratio)


def log_spectral_distance_db(estimate: Tensor, target: Tensor) -> Tensor:
    """Compute the mean absolute difference between the levels of two spectrograms, in dB.

    The spectrograms are those of the Neuro-MSBG paper: 201 frequencies every 6.25 ms at 16 kHz. A
    millionth of the strongest power in the item's target is added to all powers, so that
    differences more than 60 dB below it hardly count.

    Shape: (items, time) twice, in pascals -> (items,).

    >>> speech = torch.randn(1, 16000)
    >>> log_spectral_distance_db(2.0 * speech, speech).round(decimals=1)
    tensor([6.])
    """
    estimate_power = power(PAPER_STFT.analyse(estimate))
    target_power = power(PAPER_STFT.analyse(target))
    strongest = target_power.amax((-2, -1), keepdim=True)
    floor = strongest * RELATIVE_FLOOR + SPECTRAL_FLOOR
    estimate_db = 10.0 * torch.log10(estimate_power + floor)
    target_db = 10.0 * torch.log10(target_power + floor)
    return (estimate_db - target_db).abs().mean((-2, -1))


def band_level_distance_db(estimate: Tensor, target: Tensor, signal: Tensor) -> Tensor:
    """Compute the mean absolute difference of band levels in dB, where the input is audible.

    The weight of a band in a frame is the audibility of the input for a normal ear: 0 up to the
    threshold of audibility, and 1 from 20 dB above it. How softly the ear perceives the band does
    not change its weight.

    Shape: (items, time) three times, in pascals at 16 kHz -> (items,).

    Args:
        estimate: Output of the network.
        target: Output of the simulator from which the network learns.
        signal: Input of both.

    >>> speech = torch.randn(1, 16000)
    >>> band_level_distance_db(2.0 * speech, speech, speech).round(decimals=1)
    tensor([6.])
    """
    levels = band_levels(signal, NEURO_RATE)
    weights = audibility_weights(levels, audibility_threshold(levels))
    errors = (band_levels(estimate, NEURO_RATE) - band_levels(target, NEURO_RATE)).abs()
    return (weights * errors).sum((-2, -1)) / weights.sum((-2, -1)).clamp_min(1.0)
