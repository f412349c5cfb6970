"""The real transform and the power have the values and gradients of torch's functions."""

import pytest
import torch
from torch import Tensor

from hlsim.dsp.fft import power, rfft


def gradient(output: Tensor, source: Tensor, weights: Tensor) -> Tensor:
    return torch.autograd.grad(output, source, weights)[0]


@pytest.mark.parametrize("points", [1, 2, 4096, 4097, 12346])
@pytest.mark.parametrize("excess", [0, -100, 100])
def test_rfft_and_its_gradient_equal_those_of_torch(points: int, excess: int) -> None:
    wave = torch.randn(3, max(1, points + excess), dtype=torch.float64, requires_grad=True)
    ours, theirs = rfft(wave, points), torch.fft.rfft(wave, points)
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(theirs)
    torch.testing.assert_close(gradient(ours, wave, weights), gradient(theirs, wave, weights))


def test_power_and_its_gradient_equal_the_squared_modulus() -> None:
    spectrum = torch.randn(3, 20, dtype=torch.complex128, requires_grad=True)
    ours, theirs = power(spectrum), spectrum.abs().square()
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(theirs)
    slopes = [gradient(output, spectrum, weights) for output in (ours, theirs)]
    torch.testing.assert_close(*slopes)


@pytest.mark.parametrize("function", [rfft, power])
def test_second_derivatives(function: torch.autograd.Function) -> None:
    source = torch.randn(2, 9, dtype=torch.float64, requires_grad=True)

    def energy(signal: Tensor) -> Tensor:
        spectrum = rfft(signal) if function is rfft else torch.fft.rfft(signal)
        return power(spectrum) if function is power else spectrum

    assert torch.autograd.gradgradcheck(energy, source)


def test_the_gradient_of_the_power_of_silence_is_zero() -> None:
    silence = torch.zeros(3, 5, dtype=torch.complex128, requires_grad=True)
    weights = torch.ones(3, 5, dtype=torch.float64)
    assert not bool(gradient(power(silence), silence, weights).any())
