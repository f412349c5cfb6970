"""The real transform and the power have the values and gradients of torch's functions."""

import numpy as np
import pytest
import torch
from scipy import signal
from torch import Tensor

from hlsim.dsp.fft import MAX_POWER_OF_TWO, correlate, fft_length, power, rfft


def assert_equal_gradients(ours: Tensor, theirs: Tensor, source: Tensor) -> None:
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn_like(theirs)
    gradients = [torch.autograd.grad(output, source, weights)[0] for output in (ours, theirs)]
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("points", [1, 2, 4096, 4097])
@pytest.mark.parametrize("excess", [0, -100, 100])
def test_rfft_and_its_gradient_equal_those_of_torch(points: int, excess: int) -> None:
    wave = torch.randn(3, max(1, points + excess), dtype=torch.float64, requires_grad=True)
    assert_equal_gradients(rfft(wave, points), torch.fft.rfft(wave, points), wave)


@pytest.mark.parametrize("multiple", [1, 6, 256])
def test_the_fast_length_is_the_smallest_of_all_from_a_minimum_on(multiple: int) -> None:
    odd = [3**a * 5**b * 7**c for a in range(9) for b in range(6) for c in range(2)]
    twos = [2**a for a in range(9) if a == 0 or (multiple & -multiple) * 2**a <= MAX_POWER_OF_TWO]
    lengths = np.unique(multiple * np.outer(odd, twos))
    for minimum in (1, multiple + 1, 1001, 3100 * multiple, 1_000_003):
        assert fft_length(minimum, multiple) == lengths[lengths >= minimum][0]


def test_power_and_its_gradient_equal_the_squared_modulus() -> None:
    spectrum = torch.randn(3, 20, dtype=torch.complex128, requires_grad=True)
    assert_equal_gradients(power(spectrum), spectrum.abs().square(), spectrum)
    silence = torch.zeros(3, dtype=torch.complex128, requires_grad=True)
    assert not bool(torch.autograd.grad(power(silence).sum(), silence)[0].any())


@pytest.mark.parametrize(("time", "other_time"), [(2, 2), (5, 3), (3, 5), (20, 20)])
def test_the_best_lag_and_its_correlation_are_those_of_scipy(time: int, other_time: int) -> None:
    for _ in range(20):
        output, reference = torch.randn(time).double(), torch.randn(other_time).double()
        centred = [(wave - wave.mean()).numpy() for wave in (output, reference)]
        wanted = np.abs(signal.correlate(*centred)) / np.prod([*map(np.linalg.norm, centred)])
        lag, coefficient = correlate(output, reference)
        assert coefficient == pytest.approx(wanted.max())
        assert wanted[lag + other_time - 1] == pytest.approx(coefficient)


def test_a_constant_correlates_with_nothing() -> None:
    assert correlate(torch.ones(8), torch.randn(8))[1] == 0.0


def test_second_derivatives() -> None:
    source = torch.randn(2, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda signal: power(rfft(signal)), source)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_rejected_with_a_fix(dtype: torch.dtype) -> None:
    with pytest.raises(ValueError, match=r"got torch\.\w*float16; convert the model with"):
        rfft(torch.zeros(8, dtype=dtype))
