"""Smoothed smearing is near MSBG's, and its derivatives are exact where MSBG's have no bound."""

import pytest
import torch

import hlsim
from hlsim.neuro.smearing import power, smear_and_amplify


def draw(*shape: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def test_smoothed_smearing_equals_that_of_msbg_within_its_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The frames make several blocks, of which the last one is shorter.
    monkeypatch.setattr("hlsim.neuro.smearing.BLOCK_POINTS", 130 * 200)
    frames = 2 * 400 + 5
    spectrum = draw(2, frames, 65, seed=0), draw(2, frames, 65, seed=1)
    smeared_power = power(*spectrum) @ draw(2, 65, 65, seed=2) / 8.0
    gains = draw(2, frames // 2 + 2, 3, seed=3)
    matrices = draw(2, 3, 65, seed=4), draw(2, 3, 65, seed=5)
    output = torch.complex(*smear_and_amplify(spectrum, smeared_power, gains, matrices, step=2))
    ratio = smeared_power / power(*spectrum)
    middles = (gains[:, :-1] + gains[:, 1:]) / 2.0
    rows = torch.stack((gains[:, :-1], middles), 2).flatten(1, 2)[:, :frames]
    factors = torch.complex(rows @ matrices[0], rows @ matrices[1])
    # The square root of a negative ratio is imaginary.
    expected = torch.complex(*spectrum) * ratio.to(output.dtype).sqrt() * factors
    is_within = (ratio.abs() > 0.1) & (ratio.abs() < 30.0)
    for sign in (-1.0, 1.0):
        assert float((is_within & (sign * ratio > 0.0)).double().mean()) > 0.3
    torch.testing.assert_close(output[is_within], expected[is_within], rtol=6e-3, atol=0.0)


def test_smearing_has_exact_derivatives_where_powers_change_sign() -> None:
    # The smeared powers of the first item are near 0, and the second has an empty frequency.
    real = torch.tensor([[[1.0, 2.0]], [[1.0, 1e-3]]]).double()
    imaginary = torch.tensor([[[1.0, -1.0]], [[0.5, 0.0]]]).double()
    smearing = torch.tensor([[[1.0, -0.4], [2.5, -1.0]], [[1.0, 0.2], [0.5, 1.0]]]).double()
    gains = torch.tensor([[[0.5], [0.5]], [[2.0], [1.0]]]).double()
    matrices = draw(2, 1, 2, seed=0), draw(2, 1, 2, seed=1)
    inputs = (real, imaginary, smearing + 1e-4, gains, *matrices)

    def smear(
        real: torch.Tensor,
        imaginary: torch.Tensor,
        smearing: torch.Tensor,
        gains: torch.Tensor,
        *matrices: torch.Tensor,
    ) -> torch.Tensor:
        smeared_power = power(real, imaginary) @ smearing.mT
        spectrum = real, imaginary
        output = smear_and_amplify(spectrum, smeared_power, gains, (matrices[0], matrices[1]), 2)
        return torch.stack(output)

    inputs = tuple(values.requires_grad_() for values in inputs)
    assert torch.autograd.gradcheck(smear, inputs, eps=1e-8, atol=1e-4, rtol=1e-4)
    assert torch.autograd.gradgradcheck(smear, inputs, eps=1e-8, atol=1e-3, rtol=1e-3)


def test_second_derivatives_are_finite_where_a_signal_is_silent() -> None:
    simulator = hlsim.load_pretrained("neuro-msbg")
    signal = hlsim.example_speech()[8000:12000].clone()
    signal[1000:3000] = 0.0
    signal.requires_grad_()
    value = simulator(signal, "N2").square().sum()
    (slope,) = torch.autograd.grad(value, signal, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.square().sum(), signal)
    assert curvature.isfinite().all() and curvature.any()
