"""How far a simulator's waveform is from the truth, in dB."""

import torch
from torch import Tensor

from hlsim.dsp.fft import power
from hlsim.losses.paper import PAPER_STFT

_TINY = 1e-12
_SILENT = 1e-20


def noise_to_signal_db(estimate: Tensor, truth: Tensor) -> Tensor:
    """Power of the error over that of the truth in dB: the negative SNR. Shape: (items, time) twice -> (items,).

    It falls no further than -60 dB, so that the silent and the perfect do not outweigh the rest.
    """
    signal = truth.square().mean(-1)
    error = (estimate - truth).square().mean(-1)
    return 10.0 * torch.log10((error + 1e-6 * signal + _SILENT) / (signal + _SILENT))


def log_spectral_distance_db(estimate: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute difference of log magnitudes in dB, from 60 dB under each item's loudest bin up.

    Shape: (items, time) twice -> (items,).
    """
    powers = [power(spectrum) for spectrum in map(PAPER_STFT.analyse, (estimate, truth))]
    floor = powers[1].amax((-2, -1), keepdim=True) * 1e-6 + _TINY
    first, second = (10.0 * torch.log10(own + floor) for own in powers)
    return (first - second).abs().mean((-2, -1))
