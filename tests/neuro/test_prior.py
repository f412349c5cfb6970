"""The prior agrees with MSBG, and the network on bands corrects it."""

import torch

from hlsim import MSBG, Audiogram
from hlsim.audiogram import severity_index
from hlsim.dsp.fft import power
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.neuro.prior import Prior

EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N1", "N3", "N5")])


def test_fixed_response_equals_msbg_without_a_loss() -> None:
    # The exact model removes 8 kHz from signals at 16 kHz, so this signal does not contain it.
    signal = torch.zeros(1, 8000)
    signal[0, 3999:4002] = torch.tensor([0.25, 0.5, 0.25])
    expected = MSBG("NH", sample_rate=16000)(signal)
    output = Prior(NeuroConfig().stft).filter(signal, torch.tensor([0]))
    assert float((output - expected).norm() / expected.norm()) < 2e-3


def test_without_a_loss_the_factor_is_one() -> None:
    stft = NeuroConfig().stft
    spectrum = torch.randn(2, 50, stft.frequencies, dtype=torch.complex64)
    factor = Prior(stft)(power(spectrum), torch.zeros(2, 8), torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(factor, torch.ones_like(factor), atol=1e-4, rtol=0.0)


def network_on_bands(step: int) -> NeuroMSBG:
    sizes = {"fft": 128, "window": 96, "hop": 24, "channels": 8, "blocks": 1, "kernel": (3, 1)}
    return NeuroMSBG(NeuroConfig.from_dict(sizes | {"structure": "bands", "stride": (step, 1)}))


def test_before_training_the_network_on_bands_equals_the_prior() -> None:
    model = network_on_bands(step=1)
    waveform = 0.05 * torch.randn(4, 4000)
    prior = model.prior
    assert prior is not None
    severity = severity_index(EARS)
    spectrum = model.stft.analyse(prior.filter(waveform, severity))
    expected_spectrum = spectrum * prior(power(spectrum), EARS, severity)
    expected = model.stft.synthesise(expected_spectrum, 4000)
    # The network smooths the smearing.
    for step, limit in ((1, 0.005), (2, 0.05)):
        error = network_on_bands(step)(waveform, EARS).detach() - expected.detach()
        assert float(error.norm() / expected.detach().norm()) < limit


def test_gradients_through_bands_are_exact() -> None:
    model = network_on_bands(step=2).double()
    for parameter in model.parameters():
        parameter.data.add_(0.01 * torch.randn_like(parameter))
    waveform = (0.05 * torch.randn(2, 200, dtype=torch.float64)).requires_grad_()

    def simulate(signals: torch.Tensor) -> torch.Tensor:
        return model(signals, EARS[1:3].double())

    assert torch.autograd.gradcheck(simulate, waveform, fast_mode=True, atol=1e-6)
    assert torch.autograd.gradgradcheck(simulate, waveform, fast_mode=True, atol=1e-6)
