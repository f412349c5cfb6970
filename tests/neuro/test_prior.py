"""What the network starts from is MSBG's."""

import numpy as np
import torch

from hlsim import MSBG, Audiogram
from hlsim.audiogram import SEVERITIES
from hlsim.dsp.fft import power
from hlsim.msbg.filterbank import BANKS
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.prior import RESPONSE_HALF_LENGTH, Prior, _widening


def test_fixed_response_is_msbg_without_a_loss() -> None:
    prior = Prior(NeuroConfig().stft)
    impulse = torch.zeros(1, 8000)
    impulse[0, 4000] = 1.0
    filtered = prior.filter(impulse, torch.tensor([0]))
    # nothing at 8 kHz, which the exact model drops at 16 kHz
    smooth = torch.zeros(1, 8000)
    smooth[0, 3999:4002] = torch.tensor([0.25, 0.5, 0.25])
    exact = MSBG(Audiogram.standard("NH"), sample_rate=16000)(smooth)
    assert float((prior.filter(smooth, torch.tensor([0])) - exact).norm() / exact.norm()) < 2e-3
    kernel = prior.response[0].numpy()
    np.testing.assert_allclose(
        filtered[0, 4000 - RESPONSE_HALF_LENGTH : 4000 + RESPONSE_HALF_LENGTH], kernel, atol=1e-6
    )


def test_no_loss_means_no_gain_and_no_smearing() -> None:
    stft = NeuroConfig().stft
    prior = Prior(stft)
    spectrum = torch.randn(2, 50, stft.frequencies, dtype=torch.complex64)
    factor = prior(power(spectrum), torch.zeros(2, 8), torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(factor, torch.ones_like(factor), atol=1e-4, rtol=0.0)


def test_padding_of_the_smaller_banks_is_silent() -> None:
    prior = Prior(NeuroConfig().stft)
    for number, severity in enumerate(SEVERITIES):
        channels = BANKS[severity].channels
        assert not bool(prior.excitation_known[number, channels:].any())
        assert not bool(prior.relative_known[:, number, channels:].any())
        np.testing.assert_allclose(prior.relative_known[0, number].sum(0), 1.0, atol=1e-4)


def test_envelope_smoothing_keeps_the_mean() -> None:
    prior = Prior(NeuroConfig().stft)
    for number, severity in enumerate(SEVERITIES):
        rows = prior.smoothing_known[number, : BANKS[severity].channels]
        np.testing.assert_allclose(rows.sum(-1), 1.0, atol=1e-5)


def test_widening_is_the_complex_root_of_the_quotient_and_so_is_its_gradient() -> None:
    smeared = torch.randn(3, 40, dtype=torch.float64).requires_grad_()
    given = (torch.rand(3, 40, dtype=torch.float64) + 0.1).requires_grad_()
    expected = torch.complex(smeared / given, torch.zeros_like(given)).sqrt()
    torch.testing.assert_close(_widening(smeared, given), expected, atol=1e-9, rtol=1e-12)
    assert torch.autograd.gradcheck(_widening, (smeared, given))
    assert torch.autograd.gradgradcheck(_widening, (smeared, given))


def test_widening_of_silence_stays_finite() -> None:
    smeared, given = (torch.zeros(5, requires_grad=True) for _ in range(2))
    factor = _widening(smeared, given)
    torch.testing.assert_close(factor, torch.ones(5, dtype=torch.complex64))
    factor.abs().sum().backward()
    assert smeared.grad is not None and smeared.grad.isfinite().all()
