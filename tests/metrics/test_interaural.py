"""Interaural differences equal known delays and gains, and the loss depends on nothing else."""

from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim import Audiogram, HearingLossLoss, Listener
from hlsim.calibration import set_level
from hlsim.losses.interaural import interaural_loss
from hlsim.metrics.interaural import OCTAVES, interaural, interaural_change

EAR = Audiogram.standard("N3")


def delay(signal: Tensor, seconds: float, rate: int) -> Tensor:
    """Delay a periodic signal by any fraction of a sample."""
    hz = torch.fft.rfftfreq(signal.shape[-1], 1.0 / rate, dtype=torch.float64)
    phase = torch.exp(-2j * torch.pi * hz * seconds)
    return torch.fft.irfft(torch.fft.rfft(signal.double()) * phase, signal.shape[-1]).float()


@pytest.fixture
def scene(speech: list[tuple[Tensor, int]]) -> Tensor:
    """Speech 420 microseconds earlier and 8 dB louder in the left ear. Shape: (2, 16000)."""
    source = set_level(speech[0][0][0, 8000:24000], 65.0)
    return torch.stack((source, 10.0 ** (-8.0 / 20.0) * delay(source, 420e-6, 16000)))


@pytest.mark.parametrize("rate", [16000, 44100])
def test_differences_equal_a_known_delay_and_gain(rate: int) -> None:
    noise = 0.02 * torch.randn(3, rate)
    for microseconds, decibels in ((0.0, 0.0), (137.5, -6.0), (-690.0, 12.0)):
        right = 10.0 ** (-decibels / 20.0) * delay(noise, microseconds * 1e-6, rate)
        level, time, coherence = interaural(torch.stack((noise, right), -2), sample_rate=rate)
        assert level.shape == (3, len(OCTAVES))
        torch.testing.assert_close(level, torch.full_like(level, decibels), atol=0.2, rtol=0)
        torch.testing.assert_close(time, torch.full_like(time, microseconds), atol=8.0, rtol=0)
        assert bool((coherence > 0.97).all())


def test_change_swapped_ears_and_silence(scene: Tensor) -> None:
    assert bool((interaural(torch.randn(2, 16000)).coherence < 0.3).all())
    differences, swapped = interaural(scene), interaural(scene.flip(0))
    torch.testing.assert_close(swapped.level, -differences.level)
    torch.testing.assert_close(swapped.time, -differences.time)
    change = interaural_change(scene, scene * torch.tensor([[0.5], [2.0]]))
    expected = torch.full_like(change.level, -12.0412)
    torch.testing.assert_close(change.level, expected, atol=1e-3, rtol=0)
    assert not bool(change.time.any())
    one_silent_ear = torch.stack((scene[0], torch.zeros(16000)))
    assert bool(torch.stack(interaural(one_silent_ear)).isnan().all())
    assert torch.equal(interaural(scene.numpy()).level, differences.level)
    with pytest.raises(ValueError):
        interaural(scene[0])
    with pytest.raises(ValueError, match="input and output of the same shape"):
        interaural_change(scene, scene[:, :8000])
    with pytest.raises(ValueError, match="expected samples, got the path"):
        interaural_change("input.wav", scene)  # type: ignore[arg-type]


def test_the_loss_depends_only_on_differences_between_the_ears(scene: Tensor) -> None:
    for equal_change in (scene, 3.0 * scene, delay(scene, 0.003, 16000)):
        assert float(interaural_loss(equal_change, scene, 16000)) == pytest.approx(0.0, abs=0.02)
    softer = scene * torch.tensor([[1.0], [10.0 ** (-0.25)]])
    assert float(interaural_loss(softer, scene, 16000)) == pytest.approx(0.5, abs=1e-3)
    later = torch.stack((scene[0], delay(scene[1], 200e-6, 16000)))
    assert float(interaural_loss(later, scene, 16000)) > 0.2
    loss_of_silence = interaural_loss(scene, torch.zeros_like(scene), 16000)
    assert float(loss_of_silence) == pytest.approx(0.0, abs=1e-5)
    with pytest.raises(ValueError, match="sample_rate"):
        interaural_loss(scene, scene, 5000)


@pytest.mark.parametrize("left", [1.0, 0.0])
@pytest.mark.parametrize("right", [0.5, 1e-3, 1e-6, 0.0])
def test_a_nearly_silent_ear_has_a_small_gradient(scene: Tensor, left: float, right: float) -> None:
    output = (scene * torch.tensor([[left], [right]])).requires_grad_()
    value = interaural_loss(output, scene, 16000)
    (gradient,) = torch.autograd.grad(value, output)
    assert bool(value.isfinite()) and bool(gradient.isfinite().all())
    if left:  # with a constant floor of the cross power, the norm would be 7e6
        assert float(gradient[1].norm()) < 1e4


def test_as_a_part_of_the_training_loss_it_restores_the_differences(scene: Tensor) -> None:
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
    with pytest.raises(ValueError):
        loss(scene[0], scene[0], EAR)


@pytest.mark.parametrize("options", [{"criterion": "interaural"}, {"ears": "better"}])
def test_both_ears_of_an_item_have_one_length(scene: Tensor, options: dict[str, Any]) -> None:
    """Otherwise a part of one ear would be compared with silence in the other one."""
    loss = HearingLossLoss(EAR, simulator="msbg", reduction="none", **options)
    clean = torch.stack((scene, scene))[..., :12000]
    output = clean * torch.tensor([[2.0], [1.0]])
    values = loss(output, clean, lengths=[[12000, 12000], [9000, 9000]])
    alone = loss(output[1, :, :9000], clean[1, :, :9000])
    torch.testing.assert_close(values[1], alone, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="the same length for both ears of an item"):
        loss(output, clean, lengths=[[12000, 12000], [12000, 9000]])
