"""Envelopes equal pyclarity's up to the last sample of a signal that ends abruptly."""

import numpy as np
import pytest
import torch

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP, envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, FilterBank
from hlsim.msbg.filtfilt_end import LOOK_BACK, end_correction
from hlsim.msbg.recruitment import AHEAD

cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")


def tones(bank: FilterBank, length: int, points: int) -> np.ndarray:
    """One tone per channel that begins softly and ends abruptly at ``length``."""
    time = np.arange(points)
    hz = np.array(bank.centre_frequencies)[:, None]
    channels = np.sin(2 * np.pi * hz * time / MSBG_RATE + 0.3) * np.minimum(1.0, time / 3000.0) ** 2
    channels[:, length:] = 0.0
    return channels


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("length", [8000, 8001, 8011, 8015])
def test_envelopes_of_an_abrupt_end_equal_pyclaritys(name: str, length: int) -> None:
    bank = BANKS[name]
    tone = tones(bank, length, 2 * STEP * 342)
    bandwidths = erb(np.array(bank.centre_frequencies))
    expected = cochlea.compute_envelope(tone[:, :length], bandwidths, MSBG_RATE)[:, ::STEP]
    channels = torch.from_numpy(tone)
    before_silence = envelope(channels, torch.from_numpy(envelope_lowpass(bank, tone.shape[-1])))
    ours = before_silence + end_correction(channels, bank, length)
    steps = expected.shape[-1]
    error = np.abs(ours.numpy()[:, :steps] - expected)[:, 50:]
    # The envelope is 0.64. The error is aliasing of the decimation, mostly at the abrupt end.
    assert error.max() < 2e-3
    error_without_correction = np.abs(before_silence.numpy()[:, :steps] - expected)
    assert error_without_correction.max() > 0.2


@pytest.mark.parametrize("length", [1, 5, STEP, STEP + 1, 100, LOOK_BACK - 1, LOOK_BACK + 1])
def test_correction_has_the_shape_of_the_envelopes_and_stops_behind_the_end(length: int) -> None:
    bank = BANKS["severe"]
    points = 2 * STEP * (length // 32 + 100)
    channels = torch.from_numpy(tones(bank, length, points)).expand(2, 3, -1, -1)
    corrections = end_correction(channels, bank, length)
    assert corrections.shape == (2, 3, bank.channels, points // STEP)
    assert bool(torch.isfinite(corrections).all())
    last_step = (length - 1) // STEP
    assert not bool(corrections[..., last_step + AHEAD + 1 :].any())


def test_silence_adds_nothing() -> None:
    assert not bool(end_correction(torch.zeros(19, 320), BANKS["severe"], 100).any())
