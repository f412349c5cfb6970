"""The prior of the networks agrees with MSBG."""

import numpy as np
import torch

from hlsim import MSBG, Audiogram
from hlsim.dsp.fft import power
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.prior import RESPONSE_HALF_LENGTH, Prior


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
