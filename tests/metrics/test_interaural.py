"""Differences between the ears: of delays and gains that are known, and what a loss makes of them."""

import pytest
import torch
from torch import Tensor

from hlsim import Audiogram, HearingLossLoss, Listener
from hlsim.calibration import set_level
from hlsim.metrics.interaural import OCTAVES, interaural, interaural_change, interaural_loss

EAR = Audiogram.standard("N3")


def delayed(signal: Tensor, seconds: float, rate: int) -> Tensor:
    """By any part of a sample, in a circle."""
    hz = torch.fft.rfftfreq(signal.shape[-1], 1.0 / rate, dtype=torch.float64)
    turn = torch.exp(-2j * torch.pi * hz * seconds)
    return torch.fft.irfft(torch.fft.rfft(signal.double()) * turn, signal.shape[-1]).float()


@pytest.fixture
def scene(speech: list[tuple[Tensor, int]]) -> Tensor:
    """Speech from the left: 420 microseconds earlier and 8 dB louder there. Shape: (2, 16000)."""
    source = set_level(speech[0][0][0, 8000:24000], 65.0)
    return torch.stack((source, 10.0 ** (-8.0 / 20.0) * delayed(source, 420e-6, 16000)))


@pytest.mark.parametrize("rate", [16000, 44100])
def test_a_known_delay_and_level_is_found_in_each_octave(rate: int) -> None:
    noise = 0.02 * torch.randn(3, rate)
    for microseconds, decibels in ((0.0, 0.0), (137.5, -6.0), (-690.0, 12.0)):
        right = 10.0 ** (-decibels / 20.0) * delayed(noise, microseconds * 1e-6, rate)
        found = interaural(torch.stack((noise, right), -2), sample_rate=rate)
        assert found.level.shape == (3, len(OCTAVES))
        torch.testing.assert_close(
            found.level, torch.full_like(found.level, decibels), atol=0.2, rtol=0
        )
        torch.testing.assert_close(
            found.time, torch.full_like(found.time, microseconds), atol=8.0, rtol=0
        )
        assert bool((found.coherence > 0.97).all())
    alone = interaural(torch.stack((noise[0], torch.randn(rate))), sample_rate=rate)
    assert bool((alone.coherence < 0.3).all())


def test_swapped_ears_change_the_sign(scene: Tensor) -> None:
    found, swapped = interaural(scene), interaural(scene.flip(0))
    torch.testing.assert_close(swapped.level, -found.level)
    torch.testing.assert_close(swapped.time, -found.time)
    torch.testing.assert_close(swapped.coherence, found.coherence)


def test_what_an_aid_changes(scene: Tensor) -> None:
    change = interaural_change(scene, scene * torch.tensor([[0.5], [2.0]]))
    torch.testing.assert_close(
        change.level, torch.full_like(change.level, -12.0412), atol=1e-3, rtol=0
    )
    assert not bool(change.time.any())
    one = torch.stack((scene[0], torch.zeros(16000)))
    assert bool(torch.stack(interaural(one)).isnan().all())
    with pytest.raises(ValueError):
        interaural(scene[0])


def test_the_loss_is_of_what_differs_between_the_ears_alone(scene: Tensor) -> None:
    for same in (scene, 3.0 * scene, delayed(scene, 0.003, 16000)):
        assert float(interaural_loss(same, scene, 16000)) == pytest.approx(0.0, abs=0.02)
    softer = scene * torch.tensor([[1.0], [10.0 ** (-0.25)]])
    assert float(interaural_loss(softer, scene, 16000)) == pytest.approx(0.5, abs=1e-3)
    later = torch.stack((scene[0], delayed(scene[1], 200e-6, 16000)))
    assert float(interaural_loss(later, scene, 16000)) > 0.2
    for given in (softer, torch.zeros_like(scene)):
        given.requires_grad_()
        value = interaural_loss(given, scene, 16000)
        (gradient,) = torch.autograd.grad(value, given)
        assert bool(value.isfinite()) and bool(gradient.isfinite().all())
    assert float(interaural_loss(scene, torch.zeros_like(scene), 16000)) == pytest.approx(
        0.0, abs=1e-5
    )


def test_an_ear_that_is_mute_has_a_small_gradient(scene: Tensor) -> None:
    norms = []
    for gain in (1e-3, 1e-6, 0.0):
        given = (scene * torch.tensor([[1.0], [gain]])).requires_grad_()
        (gradient,) = torch.autograd.grad(interaural_loss(given, scene, 16000), given)
        norms.append(float(gradient[1].norm()))
    assert max(norms) < 1e4  # 7e6 where the floor is under both ears' product alone


def test_as_a_part_of_the_loss_it_brings_the_ears_back_together(scene: Tensor) -> None:
    loss = HearingLossLoss(
        Listener(EAR, EAR), criterion={"coherent-bands": 1.0, "interaural": 2.0}, reduction="none"
    )
    gains = torch.tensor([[4.0], [1.0]], requires_grad=True)
    parts = loss.parts(gains * scene, scene)
    expected = float(interaural_loss(gains.detach() * scene, scene, 16000))
    assert parts["interaural"].tolist() == pytest.approx([expected, expected], rel=1e-4)
    assert loss.weights["interaural"] == 2.0
    (slope,) = torch.autograd.grad(parts["interaural"].sum(), gains)
    assert float(slope[0]) > 0.0 > float(slope[1])
    alone = loss.parts(gains * scene, scene, Listener(None, EAR))
    assert float(alone["interaural"][1].detach()) == 0.0
    with pytest.raises(ValueError):
        loss(scene[0], scene[0], EAR)
