"""The criteria against numpy in float64, written anew from the paper's equations, and their gradients."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.signal import get_window
from torch import Tensor

from hlsim.dsp.resample import resample
from hlsim.losses.criteria import weighted_sum
from hlsim.losses.paper import (
    DEFAULT_WEIGHTS,
    PAPER_STFT,
    anti_wrap,
    complex_loss,
    magnitude_loss,
    paper_parts,
    paper_stft,
    phase_loss,
    time_loss,
)
from hlsim.losses.waveform import log_spectral_distance_db, noise_to_signal_db

Criterion = Callable[[Tensor, Tensor], Tensor]


@pytest.fixture
def pair(speech: list[tuple[Tensor, int]]) -> tuple[Tensor, Tensor]:
    """Half a second of two voices and a faulty copy, float64. Shape: (2, time)."""
    truth = torch.cat([waveform[:, 8000:16000] for waveform, _ in speech[:2]]).double()
    return 0.7 * truth.roll(3, -1) + 0.01 * torch.randn(truth.shape, dtype=torch.float64), truth


def spectrum(waveform: Tensor) -> NDArray[np.complex128]:
    """The paper's transform, frame by frame: 25 ms Hann windows every 6.25 ms. (time,) -> (frames, 201)."""
    padded = np.pad(waveform.numpy(), 200)
    frames = np.stack([padded[start : start + 400] for start in range(0, len(waveform) + 1, 100)])
    return np.fft.rfft(frames * get_window("hann", 400))


def wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """The principal value by way of the unit circle."""
    return np.abs(np.angle(np.exp(1j * angle)))


def test_each_equation_against_numpy(pair: tuple[Tensor, Tensor]) -> None:
    parts = paper_parts(*pair)
    assert parts.keys() == DEFAULT_WEIGHTS.keys()
    for item, (estimate, truth) in enumerate(zip(*pair, strict=True)):
        first, second = spectrum(estimate), spectrum(truth)
        error = np.angle(first) - np.angle(second)
        expected = {
            "magnitude": np.mean((np.abs(first) - np.abs(second)) ** 2),
            "phase": wrapped(error).mean()
            + wrapped(np.diff(error, axis=1)).mean()
            + wrapped(np.diff(error, axis=0)).mean(),
            # 2 x the mean over real and imaginary parts alike
            "complex": 2.0 * np.mean([(first - second).real ** 2, (first - second).imag ** 2]),
            "time": np.mean(np.abs((estimate - truth).numpy())),
        }
        for name, value in expected.items():
            assert float(parts[name][item]) == pytest.approx(value, rel=1e-6), name


def test_total_is_the_weighted_sum_of_the_parts(pair: tuple[Tensor, Tensor]) -> None:
    parts = paper_parts(*pair)
    total = weighted_sum(parts, {"magnitude": 2.0, "phase": 0.0, "time": 0.5})
    torch.testing.assert_close(total, 2.0 * parts["magnitude"] + 0.5 * parts["time"])


def test_equal_signals_cost_nothing(pair: tuple[Tensor, Tensor]) -> None:
    for name, part in paper_parts(pair[1], pair[1]).items():
        assert part.tolist() == [0.0, 0.0], name


def test_anti_wrap_is_the_distance_to_the_nearest_turn() -> None:
    angle = torch.linspace(-3.0, 3.0, 61, dtype=torch.float64)
    torch.testing.assert_close(anti_wrap(angle), angle.abs())
    for turns in (-3, 1, 40):
        torch.testing.assert_close(anti_wrap(angle + 2.0 * math.pi * turns), angle.abs())
    many = 100.0 * torch.randn(1000, dtype=torch.float64)
    torch.testing.assert_close(anti_wrap(-many), anti_wrap(many))
    torch.testing.assert_close(anti_wrap(many).numpy(), wrapped(many.numpy()))
    assert float(anti_wrap(many).max()) <= math.pi


def test_phase_does_not_see_a_gain_and_sees_a_turn() -> None:
    truth = torch.randn(3, 9, 17, dtype=torch.complex128) * 100.0
    torch.testing.assert_close(phase_loss(5.0 * truth, truth), torch.zeros(3, dtype=torch.float64))
    # a constant turn is an instantaneous phase error, and none of the other two
    turned = phase_loss(truth * np.exp(0.4j), truth)
    torch.testing.assert_close(turned, torch.full((3,), 0.4, dtype=torch.float64))


@pytest.mark.parametrize("criterion", [magnitude_loss, phase_loss, complex_loss])
def test_gradcheck_of_spectral_criteria(criterion: Criterion) -> None:
    # loud enough that nothing of the phase's gradient is faded out
    truth = 1e4 * torch.randn(2, 3, 4, dtype=torch.complex128)
    estimate = (1e4 * torch.randn(2, 3, 4, 2, dtype=torch.float64)).requires_grad_()

    def loss(parts: Tensor) -> Tensor:
        return criterion(torch.view_as_complex(parts), truth)

    # the values reach 1e8, so that a step of 1e-6 would drown in rounding
    assert torch.autograd.gradcheck(loss, (estimate,), eps=1e-2, atol=1e-7, rtol=1e-5)


def test_gradcheck_of_time_criteria(pair: tuple[Tensor, Tensor]) -> None:
    truth, estimate = (10.0 * waveform[:, 2000:2040] for waveform in pair)
    for criterion in (time_loss, noise_to_signal_db):
        assert torch.autograd.gradcheck(
            lambda x, c=criterion: c(x, truth), (estimate.requires_grad_(),)
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_silence_are_finite(pair: tuple[Tensor, Tensor], dtype: torch.dtype) -> None:
    clean, silence = pair[1].to(dtype), torch.zeros(2, 8000, dtype=dtype)
    for estimate, truth in ((silence, clean), (silence, silence), (clean, silence)):
        for name in (*DEFAULT_WEIGHTS, "noise_to_signal", "log_spectral_distance"):
            given = estimate.clone().requires_grad_()
            match name:
                case "noise_to_signal":
                    value = noise_to_signal_db(given, truth)
                case "log_spectral_distance":
                    value = log_spectral_distance_db(given, truth)
                case _:
                    value = paper_parts(given, truth)[name]
            (gradient,) = torch.autograd.grad(value.sum(), given)
            assert bool(value.isfinite().all()) and bool(gradient.isfinite().all()), name


@pytest.mark.parametrize("pause_spl", [-20.0, 0.0, 20.0])
def test_phase_gradient_comes_from_what_is_heard(
    pair: tuple[Tensor, Tensor], pause_spl: float
) -> None:
    """Untamed it is 1 / magnitude, and that of the pause was more than that of the speech before it."""
    noise = 10.0 ** ((pause_spl - 94.0) / 20.0) * torch.randn(2, 16000)
    clean = torch.cat((pair[1].float(), torch.zeros(2, 8000)), -1) + noise
    estimate = (clean + 1e-3 * clean.roll(5, -1)).requires_grad_()
    (gradient,) = torch.autograd.grad(paper_parts(estimate, clean)["phase"].sum(), estimate)
    assert float(gradient[:, 8500:].norm()) < 0.05 * float(gradient[:, :8000].norm())


def test_noise_to_signal_is_the_negative_snr(pair: tuple[Tensor, Tensor]) -> None:
    truth = pair[1]
    for db in (-20.0, 0.0, 30.0):
        error = torch.randn(truth.shape, dtype=torch.float64)
        error = (
            error
            * (truth.square().sum(-1, keepdim=True) / error.square().sum(-1, keepdim=True)).sqrt()
        )
        value = noise_to_signal_db(truth + error * 10.0 ** (-db / 20.0), truth)
        torch.testing.assert_close(value, torch.full_like(value, -db), atol=0.01, rtol=0.0)
    assert float(noise_to_signal_db(truth, truth).max()) == pytest.approx(-60.0, abs=0.01)


def test_log_spectral_distance_of_a_gain_is_the_gain(pair: tuple[Tensor, Tensor]) -> None:
    loud = 10.0 * torch.randn(2, 8000, dtype=torch.float64)
    torch.testing.assert_close(
        log_spectral_distance_db(loud * 10.0**0.3, loud),
        torch.full((2,), 6.0, dtype=torch.float64),
        atol=0.02,
        rtol=0.0,
    )
    # far under the loudest, nothing counts
    assert float(log_spectral_distance_db(loud + 1e-6 * loud.roll(1, -1), loud).max()) < 0.01


@pytest.mark.parametrize("rate", [16000, 22050, 32000, 44100, 48000])
def test_transform_keeps_its_duration_at_every_rate(rate: int) -> None:
    stft = paper_stft(rate)
    assert stft.window == stft.fft == 4 * stft.hop
    assert stft.window / rate == pytest.approx(0.025, rel=0.003)
    assert (stft == PAPER_STFT) == (rate == 16000)


def test_parts_mean_the_same_at_another_rate(pair: tuple[Tensor, Tensor]) -> None:
    estimate, truth = (resample(waveform, 16000, 15000) for waveform in pair)  # nothing near 8 kHz
    low = paper_parts(
        *(resample(waveform, 15000, 16000) for waveform in (estimate, truth)), PAPER_STFT, 181
    )
    high = paper_parts(
        *(resample(waveform, 15000, 48000) for waveform in (estimate, truth)),
        paper_stft(48000),
        181,
    )
    for name in DEFAULT_WEIGHTS:
        torch.testing.assert_close(high[name], low[name], rtol=0.01, atol=0.0)
