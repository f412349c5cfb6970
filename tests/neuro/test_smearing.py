"""Smoothed smearing is near MSBG's, and its derivatives are exact where MSBG's have no bound."""

import torch

from hlsim.dsp.fft import power
from hlsim.neuro.smearing import SmoothSmearing


def test_smoothed_smearing_equals_that_of_msbg_within_its_limits() -> None:
    generator = torch.Generator().manual_seed(0)
    parts = torch.randn(2, 2, 8, 65, generator=generator, dtype=torch.float64)
    spectrum = torch.complex(*parts)
    matrix = torch.randn(2, 65, 65, generator=generator, dtype=torch.float64) / 8.0
    smeared, powers, *_ = SmoothSmearing.apply(spectrum, matrix)
    expected_powers = power(spectrum) @ matrix.mT
    torch.testing.assert_close(powers, expected_powers)
    ratio = expected_powers / power(spectrum)
    # The square root of a negative ratio is imaginary.
    expected = spectrum * ratio.to(spectrum.dtype).sqrt()
    is_within = (ratio.abs() > 0.1) & (ratio.abs() < 30.0)
    for sign in (-1.0, 1.0):
        assert float((is_within & (sign * ratio > 0.0)).double().mean()) > 0.3
    torch.testing.assert_close(smeared[is_within], expected[is_within], rtol=6e-3, atol=0.0)


def test_smearing_has_exact_derivatives_where_powers_change_sign() -> None:
    # The smeared powers of the first item are near 0, and the second has an empty frequency.
    spectrum = torch.tensor([[[1.0 + 1.0j, 2.0 - 1.0j]], [[1.0 + 0.5j, 1e-3j]]])
    spectrum = spectrum.to(torch.complex128).requires_grad_()
    matrix = torch.tensor([[[1.0, -0.4], [2.5, -1.0]], [[1.0, 0.2], [0.5, 1.0]]]).double()
    matrix = (matrix + 1e-4).requires_grad_()

    def smear(*inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(SmoothSmearing.apply(*inputs)[:2])

    inputs = (spectrum, matrix)
    assert torch.autograd.gradcheck(smear, inputs, eps=1e-8, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradgradcheck(smear, inputs, eps=1e-8, atol=1e-3, rtol=1e-3)
