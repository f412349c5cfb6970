"""Detection obeys its formula, and envelopes equal pyclarity's up to the last sample."""

import math

import numpy as np
import pytest
import torch

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP, detect, envelope, envelope_lowpass
from hlsim.msbg.filter_bank import BANKS, gammatone_response
from hlsim.msbg.filtfilt_end import end_correction

TIME = 2 * STEP * 342


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
    assert torch.autograd.gradcheck(lambda z: detect(z, harmonics), signals)
    assert torch.autograd.gradgradcheck(lambda z: detect(z, harmonics), signals)


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
def test_envelopes_equal_pyclaritys(name: str) -> None:
    cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")
    bank = BANKS[name]
    bandwidths = erb(np.array(bank.centre_frequencies))
    lowpass = torch.from_numpy(envelope_lowpass(bank, TIME))
    noise = np.random.default_rng(1).standard_normal(TIME)
    channels = np.fft.irfft(np.fft.rfft(noise) * gammatone_response(bank, TIME))
    theirs = cochlea.compute_envelope(channels, bandwidths, MSBG_RATE)[:, ::STEP]
    error = envelope(torch.from_numpy(channels), lowpass).numpy() - theirs
    inner = slice(125, -125)  # The ends depend on the padding of filtfilt.
    relative = np.sqrt((error[:, inner] ** 2).mean(-1) / (theirs[:, inner] ** 2).mean(-1))
    # The error is aliasing of the decimation: 2.2e-4 in wide bands, whose rectified carrier is
    # noise, and 1.1e-5 in the narrowest one.
    assert relative.max() < 3e-4 and relative[0] < 1.2e-5

    for length in (8000, 8001, 8011, 8015):
        # One tone per channel begins softly and ends abruptly.
        time = np.arange(TIME)
        hz = np.array(bank.centre_frequencies)[:, None]
        tones = np.sin(2 * np.pi * hz * time / MSBG_RATE + 0.3) * np.minimum(1.0, time / 3000) ** 2
        tones[:, length:] = 0.0
        theirs = cochlea.compute_envelope(tones[:, :length], bandwidths, MSBG_RATE)[:, ::STEP]
        channels = torch.from_numpy(tones)
        ours = envelope(channels, lowpass) + end_correction(channels, bank, length)
        error = ours.numpy()[:, : theirs.shape[-1]] - theirs
        # The envelope is 0.64, and without the correction it would be off by more than 0.2.
        assert np.abs(error[:, 50:]).max() < 2e-3
