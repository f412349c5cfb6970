"""How far a waveform, a simulator's or an enhancer's, is from the truth."""

import torch
from torch import Tensor

from hlsim.criteria.paper import PAPER_STFT
from hlsim.dsp.fft import power
from hlsim.dsp.stft import STFT

_TINY = 1e-12
_SILENT = 1e-20
_FAINT = 1e-3  # power of a bin, where white noise of RMS 1 has 150


def noise_to_signal_db(estimate: Tensor, truth: Tensor) -> Tensor:
    """Power of the error over that of the truth in dB: the negative SNR. Shape: (items, time) twice -> (items,).

    It falls no further than -60 dB, so that the silent and the perfect do not outweigh the rest.
    """
    signal = truth.square().mean(-1)
    error = (estimate - truth).square().mean(-1)
    return 10.0 * torch.log10((error + 1e-6 * signal + _SILENT) / (signal + _SILENT))


def log_spectral_distance_db(
    estimate: Tensor, truth: Tensor, stft: STFT = PAPER_STFT, depth: float = 60.0
) -> Tensor:
    """Mean absolute difference of log magnitudes in dB, from ``depth`` dB under each item's loudest bin up.

    Shape: (items, time) twice -> (items,).
    """
    powers = [power(spectrum) for spectrum in (stft.analyse(estimate), stft.analyse(truth))]
    floor = powers[1].amax((-2, -1), keepdim=True) * 10.0 ** (-depth / 10.0) + _TINY
    first, second = (10.0 * torch.log10(own + floor) for own in powers)
    return (first - second).abs().mean((-2, -1))


def compressed_spectrum_error(estimate: Tensor, truth: Tensor, stft: STFT = PAPER_STFT) -> Tensor:
    """Error of spectra whose magnitudes are raised to 0.3, relative to the truth's: 1 for silence, 0 for the truth.

    That of magnitudes counts 0.7, that of complex values 0.3 (Braun and Tashev 2021, SMC, Equation 4): the soft counts,
    too, and phase a little.

    Shape: (items, time) twice -> (items,).
    """
    scale = truth.square().mean(-1, keepdim=True).clamp_min(_SILENT).rsqrt()
    spectra = stft.analyse(torch.cat((estimate * scale, truth * scale)))
    squared = power(spectra) + _FAINT
    magnitudes, truths = (squared**0.15).chunk(2)
    angles, aims = (spectra * squared**-0.35).chunk(2)
    error = 0.7 * (magnitudes - truths).square() + 0.3 * power(angles - aims)
    return error.mean((-2, -1)) / truths.square().mean((-2, -1))
