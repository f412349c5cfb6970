"""Expansion, envelope and gain against pyclarity's functions."""

import numpy as np
import pytest
import scipy.signal
import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, draw_thresholds
from hlsim.calibration import gain_to_pascals
from hlsim.msbg.ear import RATE
from hlsim.msbg.filterbank import BANKS, FilterBank, erb
from hlsim.msbg.recruitment import CATCH_UP_SPL, STEP, envelope, envelope_lowpass, expand, expansion_ratios

cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")
clarity_audiogram = pytest.importorskip("clarity.utils.audiogram")

TIME = 2 * STEP * 342
EDGE = 3000  # samples from each end that filtfilt treats its own way

BANK_NAMES = ["mild", "moderate", "severe"]
TO_PASCALS = gain_to_pascals(120.0)


def band_noise(bank: FilterBank, time: int = TIME) -> np.ndarray:
    """Noise in each channel's band, fluctuating as speech does, 90 dB SPL where RMS 1.0 is 120."""
    rng = np.random.default_rng(1)
    slow = np.exp(np.cumsum(rng.standard_normal(time)) / 400)
    rows = []
    for hz, width in zip(bank.centre_frequencies, erb(np.array(bank.centre_frequencies)), strict=True):
        edges = [max(20.0, hz - width), min(22000.0, hz + width)]
        sos = scipy.signal.butter(2, edges, "bandpass", fs=RATE, output="sos")
        row = scipy.signal.sosfilt(sos, rng.standard_normal(time)) * slow
        rows.append(row / np.sqrt(np.mean(row**2)))
    return 10 ** (-30 / 20) * np.array(rows)


def lowpass(bank: FilterBank, time: int = TIME) -> Tensor:
    return torch.from_numpy(envelope_lowpass(bank, time))


@pytest.mark.parametrize("name", BANK_NAMES)
def test_expansion_ratios(name: str) -> None:
    bank = BANKS[name]
    ears = draw_thresholds(20, torch.Generator().manual_seed(0)).double()
    ours = expansion_ratios(ears.reshape(4, 5, 8), bank)
    assert ours.shape == (4, 5, bank.channels)
    for levels, ratios in zip(ears, ours.reshape(20, -1), strict=True):
        ear = clarity_audiogram.Audiogram(levels=levels.numpy(), frequencies=np.array(FREQUENCIES))
        theirs, catch_up = cochlea.compute_recruitment_parameters(
            np.array(bank.centre_frequencies), ear, 105.0
        )
        assert np.all(catch_up == CATCH_UP_SPL)
        np.testing.assert_allclose(ratios.numpy(), theirs, rtol=1e-12)


@pytest.mark.parametrize("name", BANK_NAMES)
def test_envelope(name: str) -> None:
    bank = BANKS[name]
    channels = band_noise(bank)
    theirs = cochlea.compute_envelope(channels, erb(np.array(bank.centre_frequencies)), RATE)
    ours = envelope(torch.from_numpy(channels), lowpass(bank)).numpy()
    assert ours.shape == (bank.channels, TIME // STEP)
    kept = slice(EDGE // STEP, -(EDGE // STEP))
    error = (ours - theirs[:, ::STEP])[:, kept]
    relative = np.sqrt((error**2).mean(-1) / (theirs[:, ::STEP][:, kept] ** 2).mean(-1))
    # folding at the decimation: 2.2e-4 in wide bands, whose rectified carrier is noise; 1.1e-5 in the narrowest
    assert relative.max() < 3e-4 and relative[0] < 1.2e-5


@pytest.mark.parametrize("name", BANK_NAMES)
def test_recruitment(name: str) -> None:
    """The gain of envelopes that pyclarity computed at the full rate, sampled a step apart."""
    bank = BANKS[name]
    channels = band_noise(bank)
    theirs = np.maximum(
        cochlea.compute_envelope(channels, erb(np.array(bank.centre_frequencies)), RATE), 1e-7
    )
    ratios = expansion_ratios(torch.linspace(20.0, 70.0, 8, dtype=torch.float64), bank)
    expected = cochlea.recruitment(
        channels.copy(), theirs.copy(), 120.0, ratios.numpy(), np.full(bank.channels, 105.0)
    ).sum(0)
    ours = expand(
        TO_PASCALS * torch.from_numpy(channels), TO_PASCALS * torch.from_numpy(theirs[:, ::STEP]), ratios
    )
    error = (ours.numpy() / TO_PASCALS - expected)[EDGE:-EDGE]
    assert np.sqrt((error**2).mean() / (expected[EDGE:-EDGE] ** 2).mean()) < 2e-4


@pytest.mark.parametrize("level", [1e-12, 1e-9, 1e-4, 10 ** (-15 / 20), 3.0])
def test_limits_of_the_envelope_are_the_references(level: float) -> None:
    """From its lowest, 1e-9 of its full scale, to the catch-up level, above which nothing is expanded."""
    channels = np.random.default_rng(2).standard_normal((2, 336))
    ratios = np.array([1.0, 1.6])
    theirs = cochlea.recruitment(
        channels.copy(), np.full((2, 336), level), 120.0, ratios, np.array([105.0, 105.0])
    ).sum(0)
    ours = expand(
        torch.from_numpy(channels),
        TO_PASCALS * torch.full((2, 336 // STEP), level, dtype=torch.float64),
        torch.from_numpy(ratios),
    )
    np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-9, atol=1e-12)


def test_one_db_in_is_the_ratio_of_db_out() -> None:
    tone = torch.cos(torch.arange(40 * STEP, dtype=torch.float64)).unsqueeze(0)
    ratio = torch.tensor([105.0 / (105.0 - 60.0)], dtype=torch.float64)
    heard = [
        expand(10 ** (db / 20) * tone, torch.full((1, 40), 10 ** (db / 20), dtype=torch.float64), ratio)
        for db in (-40.0, -39.0)
    ]
    gain_db = 20 * torch.log10(heard[1].norm() / heard[0].norm())
    assert float(gain_db) == pytest.approx(float(ratio), abs=1e-9)


@pytest.mark.parametrize("name", BANK_NAMES)
def test_envelope_of_a_constant_is_the_constant(name: str) -> None:
    # the elliptic low-pass of even order is 0.25 dB down at 0 Hz, and it is run twice
    bank = BANKS[name]
    channels = torch.full((bank.channels, 40 * STEP), -0.7, dtype=torch.float64)
    expected = torch.full((bank.channels, 40), 0.7 * 10 ** (-0.5 / 20), dtype=torch.float64)
    torch.testing.assert_close(envelope(channels, lowpass(bank, 40 * STEP)), expected)


def test_gradients() -> None:
    bank = BANKS["severe"]
    channels = torch.randn(bank.channels, 4 * STEP, dtype=torch.float64, requires_grad=True)
    response = lowpass(bank, 4 * STEP)
    ratios = torch.linspace(1.0, 4.0, bank.channels, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: envelope(c, response), channels, fast_mode=True)
    assert torch.autograd.gradcheck(
        lambda c, r: expand(c, envelope(c, response), r), (channels, ratios), fast_mode=True
    )
