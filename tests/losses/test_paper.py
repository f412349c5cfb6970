"""The criteria equal the paper's equations in numpy, and their gradients are exact and finite."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.signal import get_window
from torch import Tensor

from hlsim.losses.criteria import weighted_sum
from hlsim.losses.paper import (
    DEFAULT_WEIGHTS,
    paper_parts,
    phase_loss,
)
from hlsim.losses.teacher_distance import log_spectral_distance_db, noise_to_signal_db
from tests.losses.signals import add_noise

Criterion = Callable[[Tensor, Tensor], Tensor]


@pytest.fixture
def pair(speech: list[tuple[Tensor, int]]) -> tuple[Tensor, Tensor]:
    """A distorted copy of half a second of two voices, and the voices. Shape: (2, 8000) twice."""
    target = torch.cat([waveform[:, 8000:16000] for waveform, _ in speech[:2]]).double()
    return 0.7 * target.roll(3, -1) + 0.01 * torch.randn_like(target), target


def spectrum(waveform: Tensor) -> NDArray[np.complex128]:
    """Windows of 25 ms every 6.25 ms. Shape: (time,) -> (frames, 201)."""
    padded = np.pad(waveform.numpy(), 200)
    frames = np.stack([padded[start : start + 400] for start in range(0, len(waveform) + 1, 100)])
    return np.fft.rfft(frames * get_window("hann", 400))


def wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Magnitude of the principal value."""
    return np.abs(np.angle(np.exp(1j * angle)))


def test_parts_equal_the_equations_in_numpy(pair: tuple[Tensor, Tensor]) -> None:
    parts = paper_parts(*pair)
    assert parts.keys() == DEFAULT_WEIGHTS.keys()
    for item, (estimate, target) in enumerate(zip(*pair, strict=True)):
        first, second = spectrum(estimate), spectrum(target)
        error = np.angle(first) - np.angle(second)
        expected = {
            "magnitude": np.mean((np.abs(first) - np.abs(second)) ** 2),
            "phase": wrapped(error).mean()
            + wrapped(np.diff(error, axis=1)).mean()
            + wrapped(np.diff(error, axis=0)).mean(),
            "complex": 2.0 * np.mean([(first - second).real ** 2, (first - second).imag ** 2]),
            "time": np.mean(np.abs((estimate - target).numpy())),
        }
        for name, value in expected.items():
            assert float(parts[name][item]) == pytest.approx(value, rel=1e-6), name
    total = weighted_sum(parts, {"magnitude": 2.0, "phase": 0.0, "time": 0.5})
    torch.testing.assert_close(total, 2.0 * parts["magnitude"] + 0.5 * parts["time"])


def test_phase_loss_ignores_a_gain_and_counts_a_constant_turn_once() -> None:
    target = torch.randn(3, 9, 17, dtype=torch.complex128) * 100.0
    amplified = phase_loss(5.0 * target, target)
    torch.testing.assert_close(amplified, torch.zeros(3, dtype=torch.float64))
    turned = phase_loss(target * np.exp(0.4j), target)
    torch.testing.assert_close(turned, torch.full((3,), 0.4, dtype=torch.float64))


def test_gradient_of_the_phase_is_exact() -> None:
    # The spectra are so loud that the gradient of the phase is not faded out.
    target = 1e4 * torch.randn(2, 3, 4, dtype=torch.complex128)
    estimate = (1e4 * torch.randn(2, 3, 4, 2, dtype=torch.float64)).requires_grad_()

    def loss(parts: Tensor) -> Tensor:
        return phase_loss(torch.view_as_complex(parts), target)

    assert torch.autograd.gradcheck(loss, (estimate,), eps=1e-2, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("criterion", [noise_to_signal_db, log_spectral_distance_db])
def test_gradients_of_silence_are_finite(pair: tuple[Tensor, Tensor], criterion: Criterion) -> None:
    clean, silence = pair[1], torch.zeros_like(pair[1])
    for estimate, target in ((silence, clean), (silence, silence), (clean, silence)):
        leaf = estimate.float().requires_grad_()
        value = criterion(leaf, target.float())
        (gradient,) = torch.autograd.grad(value.sum(), leaf)
        assert bool(value.isfinite().all()) and bool(gradient.isfinite().all())


def test_distances_are_the_negative_snr_and_that_of_loud_bins(
    pair: tuple[Tensor, Tensor],
) -> None:
    target = pair[1]
    for snr in (-20.0, 0.0, 30.0):
        value = noise_to_signal_db(add_noise(target, snr), target)
        torch.testing.assert_close(value, torch.full_like(value, -snr), atol=0.01, rtol=0.0)
    assert float(noise_to_signal_db(target, target).max()) == pytest.approx(-60.0, abs=0.01)
    # Bins more than 60 dB below the strongest one do not count.
    loud = 10.0 * torch.randn(2, 8000, dtype=torch.float64)
    assert float(log_spectral_distance_db(loud + 1e-6 * loud.roll(1, -1), loud).max()) < 0.01
