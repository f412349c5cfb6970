"""Detection obeys its formula, and envelopes equal pyclarity's."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP, detect, envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, FilterBank

TIME = 2 * STEP * 342
EDGE = 3000
"""Samples at each end that depend on the padding of ``filtfilt``."""

BANK_NAMES = ["mild", "moderate", "severe"]


def lowpass(bank: FilterBank, time: int = TIME) -> Tensor:
    return torch.from_numpy(envelope_lowpass(bank, time))


def test_detection_gives_the_low_harmonics_of_a_rectified_cosine() -> None:
    phase = torch.arange(2400, dtype=torch.float64) * (2.0 * math.pi / 2400.0)
    signal = 0.3 * torch.polar(torch.ones_like(phase), phase)
    torch.testing.assert_close(detect(signal, harmonics=False), signal.abs())
    rectified = detect(signal, harmonics=True) * (2.0 / math.pi)
    expected = torch.fft.rfft(signal.real.abs())[:5]
    torch.testing.assert_close(torch.fft.rfft(rectified)[:5], expected, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("harmonics", [False, True])
def test_gradients_of_detection_are_exact(harmonics: bool) -> None:
    signals = torch.randn(2, 5, dtype=torch.complex128, requires_grad=True)
    assert torch.equal(detect(signals, harmonics), detect(signals.detach(), harmonics))
    assert torch.autograd.gradcheck(lambda z: detect(z, harmonics), signals)
    assert torch.autograd.gradgradcheck(lambda z: detect(z, harmonics), signals)


@pytest.mark.parametrize("name", BANK_NAMES)
def test_envelopes_equal_pyclaritys(
    name: str, band_noise: Callable[[FilterBank, int], np.ndarray]
) -> None:
    cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")
    bank = BANKS[name]
    channels = band_noise(bank, TIME)
    theirs = cochlea.compute_envelope(channels, erb(np.array(bank.centre_frequencies)), MSBG_RATE)
    ours = envelope(torch.from_numpy(channels), lowpass(bank)).numpy()
    assert ours.shape == (bank.channels, TIME // STEP)
    inner = slice(EDGE // STEP, -(EDGE // STEP))
    expected = theirs[:, ::STEP][:, inner]
    error = ours[:, inner] - expected
    relative = np.sqrt((error**2).mean(-1) / (expected**2).mean(-1))
    # The error is aliasing of the decimation: 2.2e-4 in wide bands, whose rectified carrier is
    # noise, and 1.1e-5 in the narrowest one.
    assert relative.max() < 3e-4 and relative[0] < 1.2e-5
