"""Signals and comparisons that the tests of losses share."""

import torch
from torch import Tensor

from hlsim.calibration import set_level

RATE = 16000


def excerpt(speech: list[tuple[Tensor, int]], start: int, stop: int) -> Tensor:
    """Cut samples from two voices, at 65 dB SPL. Shape: (2, stop - start)."""
    return set_level(torch.cat([waveform[:, start:stop] for waveform, _ in speech[:2]]), 65.0)


def add_noise(clean: Tensor, snr: float) -> Tensor:
    """Add white noise at an SNR in dB to each item."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(clean.shape, dtype=clean.dtype, generator=generator)
    power_ratio = clean.square().sum(-1, keepdim=True) / noise.square().sum(-1, keepdim=True)
    return clean + noise * power_ratio.sqrt() * 10.0 ** (-snr / 20.0)


def filter_by_gain(waveform: Tensor, gain_db: Tensor) -> Tensor:
    """Multiply a spectrum by gains in dB, one per frequency."""
    spectrum = torch.fft.rfft(waveform) * 10.0 ** (gain_db / 20.0)
    return torch.fft.irfft(spectrum, waveform.shape[-1])


def frequencies(waveform: Tensor) -> Tensor:
    """Frequencies of the spectrum in Hz."""
    return torch.fft.rfftfreq(waveform.shape[-1], 1.0 / RATE)


def gain_slope(loss: torch.nn.Module, clean: Tensor, ear: object) -> float:
    """Norm of the gradient with respect to the gains of eight bands, at 0 dB."""
    edges = torch.tensor([354.0, 707.0, 1414.0, 2449.0, 3464.0, 4899.0, 6928.0])
    bands = torch.bucketize(frequencies(clean), edges)
    gains = torch.zeros(8, requires_grad=True)
    value = loss(filter_by_gain(clean, gains[bands]), clean, ear)
    return float(torch.autograd.grad(value, gains)[0].norm())
