"""The end of the envelopes against pyclarity's, to the last sample."""

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.envelope import STEP, envelope, envelope_lowpass
from hlsim.msbg.filterbank import BANKS, FilterBank
from hlsim.msbg.filtfilt_end import LOOK_BACK, ending, ending_response, ending_weights

cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")


def added(channels: Tensor, bank: FilterBank, length: int) -> Tensor:
    weights = torch.from_numpy(ending_weights(bank)).to(channels)
    response = torch.from_numpy(ending_response(bank, length)).to(channels)
    return ending(channels, weights, response, length)


def tones(bank: FilterBank, length: int, points: int) -> np.ndarray:
    """A tone a channel that begins softly and ends abruptly at ``length``."""
    time = np.arange(points)
    hz = np.array(bank.centre_frequencies)[:, None]
    channels = np.sin(2 * np.pi * hz * time / MSBG_RATE + 0.3) * np.minimum(1.0, time / 3000.0) ** 2
    channels[:, length:] = 0.0
    return channels


@pytest.mark.parametrize("name", ["mild", "moderate", "severe"])
@pytest.mark.parametrize("length", [8000, 8001, 8011, 8015])
def test_envelopes_of_what_ends_abruptly(name: str, length: int) -> None:
    bank = BANKS[name]
    channels = tones(bank, length, 2 * STEP * 342)
    theirs = cochlea.compute_envelope(
        channels[:, :length], erb(np.array(bank.centre_frequencies)), MSBG_RATE
    )
    ours = torch.from_numpy(channels)
    silent = envelope(ours, torch.from_numpy(envelope_lowpass(bank, channels.shape[-1])))
    held = (silent + added(ours, bank, length)).numpy()[:, : -(-length // STEP)]
    error = np.abs(held - theirs[:, ::STEP])[:, 50:]
    assert error.max() < 2e-3  # of 0.64; folding at the decimation, most at the abrupt end itself
    without = np.abs(silent.numpy()[:, : -(-length // STEP)] - theirs[:, ::STEP])
    assert without.max() > 0.2


def test_single_precision_is_enough() -> None:
    bank = BANKS["mild"]
    channels = torch.from_numpy(tones(bank, 8000, 2 * STEP * 342))
    wide = added(channels, bank, 8000)
    assert float((added(channels.float(), bank, 8000) - wide).abs().max()) < 1e-5


@pytest.mark.parametrize("length", [1, 5, STEP, STEP + 1, 100, LOOK_BACK - 1, LOOK_BACK + 1])
def test_short_signals_and_leading_dimensions(length: int) -> None:
    bank = BANKS["severe"]
    points = 2 * STEP * (length // 32 + 100)
    channels = torch.from_numpy(tones(bank, length, points)).expand(2, 3, -1, -1)
    extra = added(channels, bank, length)
    assert extra.shape == (2, 3, bank.channels, points // STEP)
    assert bool(torch.isfinite(extra).all())
    # nothing beyond what the interpolation needs
    assert not bool(extra[..., (length - 1) // STEP + 4 :].any())


def test_silence_adds_nothing_and_gradients_are_exact() -> None:
    bank = BANKS["severe"]
    assert not bool(added(torch.zeros(bank.channels, 320), bank, 100).any())
    channels = torch.randn(bank.channels, 320, dtype=torch.float64)
    channels[:, 100:] = 0.0
    channels.requires_grad_()
    assert torch.autograd.gradcheck(lambda c: added(c, bank, 100), channels, fast_mode=True)
