"""The network on bands corrects MSBG's known gains, and equals the prior before training."""

import torch

from hlsim import Audiogram
from hlsim.audiogram import severity_index
from hlsim.dsp.fft import power
from hlsim.neuro import NeuroConfig, NeuroMSBG

EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N1", "N3", "N5")])
SIZES = {"fft": 128, "window": 96, "hop": 24, "channels": 8, "blocks": 1, "kernel": (3, 1)}


def light(step: int) -> NeuroMSBG:
    return NeuroMSBG(NeuroConfig.from_dict(SIZES | {"structure": "bands", "stride": (step, 1)}))


def test_before_training_the_network_equals_the_prior() -> None:
    model = light(1)
    waveform = 0.05 * torch.randn(4, 4000)
    prior = model.prior
    assert prior is not None
    severity = severity_index(EARS)
    spectrum = model.stft.analyse(prior.filter(waveform, severity))
    expected_spectrum = spectrum * prior(power(spectrum), EARS, severity)
    expected = model.stft.synthesise(expected_spectrum, 4000)
    torch.testing.assert_close(model(waveform, EARS), expected, atol=1e-5, rtol=1e-3)


def test_steps_of_two_frames_change_the_output_little() -> None:
    waveform = 0.05 * torch.randn(4, 4000)
    expected, output = (light(step)(waveform, EARS).detach() for step in (1, 2))
    assert float((output - expected).norm() / expected.norm()) < 0.05


def test_gradients_are_exact() -> None:
    model = light(2).double()
    for parameter in model.parameters():
        parameter.data.add_(0.01 * torch.randn_like(parameter))
    waveform = (0.05 * torch.randn(2, 200, dtype=torch.float64)).requires_grad_()

    def simulate(signals: torch.Tensor) -> torch.Tensor:
        return model(signals, EARS[1:3].double())

    assert torch.autograd.gradcheck(simulate, waveform, fast_mode=True, atol=1e-6)
    assert torch.autograd.gradgradcheck(simulate, waveform, fast_mode=True, atol=1e-6)
