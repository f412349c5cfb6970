"""The network on bands corrects MSBG's known gains, and is those before it is trained."""

import pytest
import torch

from hlsim import Audiogram
from hlsim.audiogram import severity_index
from hlsim.dsp.fft import power
from hlsim.neuro import NeuroConfig, NeuroMSBG

EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N1", "N3", "N5")])


def light(step: int = 2, **settings: object) -> NeuroMSBG:
    sizes = {
        "fft": 128,
        "window": 96,
        "hop": 24,
        "channels": 8,
        "blocks": 1,
        "kernel": (3, 1),
        "stride": (step, 1),
    }
    torch.manual_seed(0)
    return NeuroMSBG(NeuroConfig.from_dict({"structure": "bands", **sizes, **settings}))


@pytest.mark.parametrize("phase", ["predicted", "input"])
def test_before_training_it_is_the_prior(phase: str) -> None:
    model, waveform = light(1, phase=phase), 0.05 * torch.randn(4, 4000)
    prior, severity = model.prior, severity_index(EARS)
    assert prior is not None
    spectrum = model.stft.analyse(prior.filter(waveform, severity))
    known = spectrum * prior(power(spectrum), EARS, severity)
    expected = model.stft.synthesise(known, 4000)
    torch.testing.assert_close(model(waveform, EARS), expected, atol=1e-5, rtol=1e-3)


def test_steps_of_frames_are_near_every_frame() -> None:
    waveform = 0.05 * torch.randn(4, 4000)
    every, second = light(1)(waveform, EARS), light(2)(waveform, EARS)
    assert float((every - second).detach().norm() / every.detach().norm()) < 0.05


@pytest.mark.parametrize("length", [1, 23, 24, 49, 1000])
def test_any_length(length: int) -> None:
    assert light()(0.05 * torch.randn(4, length), EARS).shape == (4, length)


def test_blocks_are_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    model, waveform = light(), 0.05 * torch.randn(1, 40000)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    whole = model._process(waveform, EARS[2:3])
    monkeypatch.setattr("hlsim.neuro.network._CPU_SAMPLES", (8000, 8000))
    torch.testing.assert_close(model(waveform, EARS[2]), whole, atol=1e-6, rtol=1e-4)


def test_everything_that_is_learned_has_a_gradient() -> None:
    model = light()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    model(0.05 * torch.randn(4, 2000), EARS).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None and bool(parameter.grad.any()), name


def test_gradient_is_that_of_differences() -> None:
    model = light().double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * torch.randn_like(parameter))
    waveform = (0.05 * torch.randn(2, 200, dtype=torch.float64)).requires_grad_()
    hear = lambda given: model(given, EARS[1:3].double())  # noqa: E731
    assert torch.autograd.gradcheck(hear, waveform, fast_mode=True, atol=1e-6)
    assert torch.autograd.gradgradcheck(hear, waveform, fast_mode=True, atol=1e-6)


@pytest.mark.parametrize("wrong", [{"prior": False}, {"level_aware": False}, {"block": "lstm"}])
def test_settings_that_bands_lack_raise_value_error(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        light(**wrong)
