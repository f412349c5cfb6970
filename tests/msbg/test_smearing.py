"""Spectral smearing equals pyclarity's sample by sample."""

import numpy as np
import pytest
import torch

from hlsim.dsp.fft import rfft
from hlsim.msbg import smearing
from hlsim.msbg.smearing import BROADENING, HOP, smear, smearing_matrix

clarity = pytest.importorskip("clarity.evaluator.msbg.smearing")
cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")

LENGTHS = [1, 63, 64, 65, 192, 255, 256, 257, 300, 320, 384, 1000, 3008, 3009, 3071]


def test_broadening_equals_pyclaritys() -> None:
    theirs = {name.lower(): value["smear_params"] for name, value in cochlea.HL_PARAMS.items()}
    assert theirs.pop("nothing") == (1.0, 1.0)
    assert theirs == BROADENING


@pytest.mark.parametrize("severity", BROADENING)
def test_matrix_equals_pyclaritys(severity: str) -> None:
    theirs = clarity.make_smear_mat3(*BROADENING[severity], 44100.0)
    np.testing.assert_allclose(smearing_matrix(severity), theirs, atol=1e-9)


@pytest.mark.parametrize("severity", BROADENING)
@pytest.mark.parametrize("length", LENGTHS)
def test_smearing_equals_pyclaritys_sample_by_sample(severity: str, length: int) -> None:
    noise = np.random.default_rng(length).standard_normal(length)
    matrix = smearing_matrix(severity)
    # pyclarity needs at least one frame.
    theirs = clarity.smear3(matrix, np.pad(noise, (0, max(0, 256 - length))))
    ours = smear(torch.from_numpy(noise), torch.from_numpy(matrix)).numpy()
    assert len(ours) == HOP * (-(-length // HOP) + 3)
    if length >= 256:
        assert len(theirs) == len(ours)
        np.testing.assert_allclose(ours, theirs, atol=1e-10)
    else:
        # pyclarity continues with the zeros of the padding, so that only the first hops are equal.
        stop = HOP * -(-length // HOP)
        np.testing.assert_allclose(ours[:stop], theirs[:stop], atol=1e-10)


@pytest.mark.parametrize("severity", BROADENING)
@pytest.mark.parametrize("hz", [700.0, 1300.0])
def test_a_steady_tone_stays_as_narrow_as_it_is(severity: str, hz: float) -> None:
    time = torch.arange(44100, dtype=torch.float64) / 44100.0
    smeared = smear(torch.sin(2.0 * np.pi * hz * time), torch.from_numpy(smearing_matrix(severity)))
    window = torch.hann_window(32768, dtype=torch.float64)
    power = torch.fft.rfft(smeared[2000:][:32768] * window).abs().square().numpy()
    distance = np.abs(np.fft.rfftfreq(32768, 1.0 / 44100.0) - hz)
    # The frames keep the phase of the tone, so that they add up to it again.
    assert power[distance > 10.0].sum() < 1e-4 * power.sum()
    assert power[(distance > 10.0) & (distance < 600.0)].sum() < 1e-6 * power.sum()


@pytest.mark.parametrize("severity", BROADENING)
def test_gradients_are_exact(severity: str) -> None:
    wave = torch.randn(1, 320, dtype=torch.float64, requires_grad=True)
    matrix = torch.from_numpy(smearing_matrix(severity))
    assert torch.autograd.gradcheck(lambda w: smear(w, matrix), wave, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda w: smear(w, matrix), wave, fast_mode=True)


def test_second_derivatives_in_single_precision_are_finite_beside_silence() -> None:
    generator = torch.Generator().manual_seed(0)
    sound, *directions = 0.01 * torch.randn(3, 1280, generator=generator).double()
    sound[640:] = 0.0

    def compute_second_derivative(dtype: torch.dtype) -> torch.Tensor:
        matrix = torch.from_numpy(smearing_matrix("moderate")).to(dtype)
        wave = sound.to(dtype).requires_grad_()
        value = smear(wave, matrix)[: len(wave)].square() @ directions[0].to(dtype)
        (gradient,) = torch.autograd.grad(value, wave, create_graph=True)
        return torch.autograd.grad(gradient @ directions[1].to(dtype), wave)[0].double()

    expected = compute_second_derivative(torch.float64)
    error = compute_second_derivative(torch.float32) - expected
    assert error.norm() < 0.01 * expected.norm()


def test_a_frequency_that_is_rounded_to_zero_does_not_decide_the_gradient(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    generator = torch.Generator().manual_seed(0)
    wave, direction = torch.randn(2, 2048, generator=generator)
    matrix = torch.from_numpy(smearing_matrix("severe")).float()

    def compute_gradient() -> torch.Tensor:
        variable = wave.clone().requires_grad_()
        smeared = smear(variable, matrix)[: len(wave)]
        return torch.autograd.grad(smeared @ direction, variable)[0]

    def rfft_with_rounding(frames: torch.Tensor) -> torch.Tensor:
        spectrum = rfft(frames)
        rounded = spectrum.detach().index_fill(-1, torch.tensor([40]), 0.0)
        return spectrum + (rounded - spectrum).detach()

    expected = compute_gradient()
    monkeypatch.setattr(smearing, "rfft", rfft_with_rounding)
    assert float((compute_gradient() - expected).norm()) < 0.5 * float(expected.norm())
