"""Band levels equal those of numpy and of known signals, and their loss obeys laws."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.signal import get_window
from torch import Tensor

from hlsim.calibration import set_level
from hlsim.metrics.band_levels import (
    BANDS,
    audibility_threshold,
    audibility_weights,
    band_edges,
    band_level_loss,
    band_levels,
    threshold_in_quiet,
)
from tests.losses.signals import RATE, excerpt, filter_by_gain, frequencies


@pytest.fixture
def voice(speech: list[tuple[Tensor, int]]) -> Tensor:
    """A second of two voices at 65 dB SPL, float64. Shape: (2, 16000)."""
    return excerpt(speech, 8000, 24000).double()


def test_bands_are_equally_wide_on_the_erb_number_scale() -> None:
    edges = band_edges()
    assert edges[[0, -1]].tolist() == pytest.approx([80.0, 7500.0]) and len(edges) == BANDS + 1
    # an ERB of 24.7 (4.37 f / kHz + 1) Hz, integrated over each band
    for low, high in pairwise(edges):
        hz = np.linspace(low, high, 2001)
        width = np.trapezoid(1.0 / (24.7 * (4.37e-3 * hz + 1.0)), hz)
        assert width == pytest.approx(1.24, rel=0.01)


def test_levels_equal_those_of_numpy(voice: Tensor) -> None:
    padded = np.pad(voice[0].numpy(), 256)
    frames = np.stack([padded[start : start + 512] for start in range(0, voice.shape[-1] + 1, 256)])
    window = get_window("hann", 512)
    power = 2.0 * np.abs(np.fft.rfft(frames * window)) ** 2 / (512.0 * np.sum(window**2))
    # Spread each bin evenly over its 31.25 Hz, and add up the parts in each band.
    centres, fine = np.arange(257) * 31.25, 1000
    hz = centres[:, None] + 31.25 * ((np.arange(fine) + 0.5) / fine - 0.5)
    shares = [((hz >= low) & (hz < high)).mean(1) for low, high in pairwise(band_edges())]
    expected = 10.0 * np.log10(power @ np.stack(shares, 1) + 1e-18) + 94.0
    np.testing.assert_allclose(band_levels(voice, RATE)[0].numpy(), expected, atol=0.05)


@pytest.mark.parametrize("rate", [16000, 44100])
def test_tone_has_its_level(rate: int) -> None:
    time = torch.arange(rate, dtype=torch.float64) / rate
    for frequency in (250.0, 1000.0, 6000.0):
        tone = set_level(torch.sin(2.0 * math.pi * frequency * time), 65.0)
        levels = band_levels(tone, rate)[3:-3]
        total = 10.0 * (10.0 ** (levels / 10.0)).sum(-1).log10()
        torch.testing.assert_close(total, torch.full_like(total, 65.0), atol=0.05, rtol=0.0)
        loudest = int(levels.mean(0).argmax())
        assert band_edges()[loudest] <= frequency <= band_edges()[loudest + 1]


def test_thresholds_in_quiet_are_close_to_iso_389_7() -> None:
    hz = [125, 250, 500, 1000, 2000, 3000, 4000, 6000]
    free_field = [22.1, 11.4, 4.4, 2.4, -1.3, -5.8, -5.4, 4.3]  # dB SPL
    edges = band_edges()
    thresholds = np.interp(hz, np.sqrt(edges[1:] * edges[:-1]), threshold_in_quiet())
    np.testing.assert_allclose(thresholds, free_field, atol=6.0)


@pytest.mark.parametrize("gain", [-60.0, -20.0, -3.0, 0.0, 0.5, 12.0, 30.0])
def test_gain_costs_its_decibels(voice: Tensor, gain: float) -> None:
    costs = band_level_loss(voice * 10.0 ** (gain / 20.0), voice, RATE)
    assert costs.tolist() == pytest.approx([abs(gain)] * 2, rel=1e-4)


@pytest.mark.parametrize("attenuation", [20.0, 40.0, 60.0])
def test_inaudible_band_keeps_its_gradient(voice: Tensor, attenuation: float) -> None:
    """The gradient of the gain of a band in dB is the share of the band, even at -16 dB SPL."""
    normal = voice.float()
    hz = frequencies(normal)
    gain = torch.tensor(-attenuation, requires_grad=True)
    perceived = filter_by_gain(normal, gain * ((hz > 2000.0) & (hz < 4000.0)))
    (gradient,) = torch.autograd.grad(band_level_loss(perceived, normal, RATE).mean(), gain)
    levels = band_levels(normal, RATE)
    weights = audibility_weights(levels, audibility_threshold(levels))
    inside = torch.from_numpy((band_edges()[:-1] > 2000.0) & (band_edges()[1:] < 4000.0))
    share = (weights * inside).sum((-2, -1)) / weights.sum((-2, -1))
    assert float(gradient) < -0.8 * float(share.mean())


def test_noise_in_a_pause_costs(voice: Tensor) -> None:
    """A normal ear perceives nothing there."""
    clean = torch.cat((voice, torch.zeros_like(voice)), -1)
    noise = torch.zeros_like(clean)
    noise[:, 18000:] = set_level(torch.randn(2, 14000, dtype=torch.float64), 55.0)
    costs = [band_level_loss(clean + gain * noise, clean, RATE) for gain in (1e-3, 0.9, 1.0)]
    assert float(costs[0].max()) < 0.1 < 3.0 < float(costs[2].min())
    assert bool((costs[1] < costs[2]).all())
