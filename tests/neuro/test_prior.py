"""The prior of the networks agrees with MSBG."""

import numpy as np
import torch

from hlsim import MSBG, Audiogram
from hlsim.audiogram import SEVERITIES
from hlsim.dsp.fft import power
from hlsim.msbg.filterbank import BANKS
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.prior import RESPONSE_HALF_LENGTH, Prior, _smearing_factor


def test_fixed_response_equals_msbg_without_a_loss() -> None:
    prior = Prior(NeuroConfig().stft)
    impulse = torch.zeros(1, 8000)
    impulse[0, 4000] = 1.0
    filtered = prior.filter(impulse, torch.tensor([0]))
    # The exact model removes 8 kHz from signals at 16 kHz, so this signal does not contain it.
    smooth = torch.zeros(1, 8000)
    smooth[0, 3999:4002] = torch.tensor([0.25, 0.5, 0.25])
    expected = MSBG(Audiogram.standard("NH"), sample_rate=16000)(smooth)
    output = prior.filter(smooth, torch.tensor([0]))
    assert float((output - expected).norm() / expected.norm()) < 2e-3
    kernel = prior.response[0].numpy()
    np.testing.assert_allclose(
        filtered[0, 4000 - RESPONSE_HALF_LENGTH : 4000 + RESPONSE_HALF_LENGTH], kernel, atol=1e-6
    )


def test_without_a_loss_the_factor_is_one() -> None:
    stft = NeuroConfig().stft
    prior = Prior(stft)
    spectrum = torch.randn(2, 50, stft.frequencies, dtype=torch.complex64)
    factor = prior(power(spectrum), torch.zeros(2, 8), torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(factor, torch.ones_like(factor), atol=1e-4, rtol=0.0)


def test_channels_that_a_bank_lacks_are_zero() -> None:
    prior = Prior(NeuroConfig().stft)
    for number, severity in enumerate(SEVERITIES):
        channels = BANKS[severity].channels
        assert not bool(prior.excitation_known[number, channels:].any())
        assert not bool(prior.relative_known[:, number, channels:].any())
        np.testing.assert_allclose(prior.relative_known[0, number].sum(0), 1.0, atol=1e-4)


def test_smearing_factor_is_the_complex_root_of_the_ratio() -> None:
    smeared = torch.randn(3, 40, dtype=torch.float64).requires_grad_()
    powers = (torch.rand(3, 40, dtype=torch.float64) + 0.1).requires_grad_()
    expected = torch.complex(smeared / powers, torch.zeros_like(powers)).sqrt()
    torch.testing.assert_close(_smearing_factor(smeared, powers), expected, atol=1e-9, rtol=1e-12)
    assert torch.autograd.gradcheck(_smearing_factor, (smeared, powers))
    assert torch.autograd.gradgradcheck(_smearing_factor, (smeared, powers))


def test_smearing_factor_of_silence_is_finite() -> None:
    smeared = torch.zeros(5, requires_grad=True)
    powers = torch.zeros(5, requires_grad=True)
    factor = _smearing_factor(smeared, powers)
    torch.testing.assert_close(factor, torch.ones(5, dtype=torch.complex64))
    factor.abs().sum().backward()
    assert smeared.grad is not None and smeared.grad.isfinite().all()
