"""Band levels against numpy and known signals, and the laws of the loss that compares them."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.signal import get_window
from torch import Tensor

from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import (
    BANDS,
    DEPTH,
    audibility,
    band_edges,
    band_level_loss,
    band_levels,
    least_audible,
    threshold_in_quiet,
)

RATE = 16000


@pytest.fixture
def voice(speech: list[tuple[Tensor, int]]) -> Tensor:
    """A second of two voices at 65 dB SPL, float64. Shape: (2, time)."""
    return set_level(
        torch.cat([waveform[:, 8000:24000] for waveform, _ in speech[:2]]).double(), 65.0
    )


def loss(heard: Tensor, normal: Tensor) -> list[float]:
    return [float(value) for value in band_level_loss(heard, normal, RATE)]


def tone(frequency: float, spl: float, rate: int = RATE) -> Tensor:
    time = torch.arange(rate, dtype=torch.float64) / rate
    return set_level(torch.sin(2.0 * math.pi * frequency * time), spl)


def test_bands_are_equally_wide_on_the_erb_number_scale() -> None:
    edges = band_edges()
    assert (
        edges[0] == pytest.approx(80.0)
        and edges[-1] == pytest.approx(7500.0)
        and len(edges) == BANDS + 1
    )
    # an ERB of 24.7 (4.37 f / kHz + 1) Hz, integrated over each band
    for low, high in pairwise(edges):
        hz = np.linspace(low, high, 2001)
        assert np.trapezoid(1.0 / (24.7 * (4.37e-3 * hz + 1.0)), hz) == pytest.approx(
            1.24, rel=0.01
        )


def test_levels_against_numpy(voice: Tensor) -> None:
    padded = np.pad(voice[0].numpy(), 256)
    frames = np.stack([padded[start : start + 512] for start in range(0, voice.shape[-1] + 1, 256)])
    window = get_window("hann", 512)
    power = 2.0 * np.abs(np.fft.rfft(frames * window)) ** 2 / (512.0 * np.sum(window**2))
    # spread each bin evenly over its 31.25 Hz and sum what falls into each band
    centres, fine = np.arange(257) * 31.25, 1000
    hz = centres[:, None] + 31.25 * ((np.arange(fine) + 0.5) / fine - 0.5)
    edges = band_edges()
    shares = np.stack([((hz >= a) & (hz < b)).mean(1) for a, b in pairwise(edges)], 1)
    expected = 10.0 * np.log10(power @ shares + 1e-18) + 94.0
    np.testing.assert_allclose(band_levels(voice, RATE)[0].numpy(), expected, atol=0.05)


@pytest.mark.parametrize("rate", [16000, 44100])
def test_a_tone_has_its_level(rate: int) -> None:
    for frequency in (250.0, 1000.0, 6000.0):
        levels = band_levels(tone(frequency, 65.0, rate), rate)[3:-3]
        power = 10.0 ** (levels / 10.0)
        torch.testing.assert_close(
            10.0 * power.sum(-1).log10(), torch.full_like(power[:, 0], 65.0), atol=0.05, rtol=0.0
        )
        loudest = int(levels.mean(0).argmax())
        assert band_edges()[loudest] <= frequency <= band_edges()[loudest + 1]


def test_levels_do_not_depend_on_the_rate(voice: Tensor) -> None:
    # the cut ends ring, and the resampling filter's slope lies beside the highest band
    low = band_levels(voice, RATE)[:, 2:-2, :-1]
    high = band_levels(resample(voice, RATE, 48000), 48000)[:, 2:-2, :-1]
    heard = low > 20.0
    torch.testing.assert_close(high[heard], low[heard], atol=0.1, rtol=0.0)


def test_leading_dimensions_and_silence() -> None:
    levels = band_levels(torch.zeros(2, 3, 1600), RATE)
    assert levels.shape == (2, 3, 7, BANDS)
    torch.testing.assert_close(levels, torch.full_like(levels, -86.0))
    assert band_level_loss(torch.randn(2, 3, 1600), torch.randn(2, 3, 1600), RATE).shape == (2, 3)
    assert band_levels(torch.randn(1600), RATE).shape == (7, BANDS)


def test_thresholds_in_quiet_are_like_iso_389_7() -> None:
    # free field, in dB SPL
    standard = {
        125: 22.1,
        250: 11.4,
        500: 4.4,
        1000: 2.4,
        2000: -1.3,
        3000: -5.8,
        4000: -5.4,
        6000: 4.3,
    }
    edges = band_edges()
    own = np.interp(list(standard), np.sqrt(edges[1:] * edges[:-1]), threshold_in_quiet())
    np.testing.assert_allclose(own, list(standard.values()), atol=6.0)


def test_audibility_rises_from_the_threshold_or_the_depth_under_the_loudest() -> None:
    levels = torch.full((2, 5, BANDS), -20.0)
    levels[0, 2, 10], levels[0, 3, 10], levels[0, 4, 10] = 60.0, 30.0, 19.0
    levels[1, 2, 10] = 15.0
    least = least_audible(levels)
    # the threshold in the lowest band is above that
    assert least[0, 0, 1:].tolist() == [60.0 - DEPTH] * (BANDS - 1)
    np.testing.assert_allclose(least[1, 0].numpy(), threshold_in_quiet(), rtol=1e-6)
    weights = audibility(levels, least)
    assert (
        weights[0, 2, 10] == 1.0
        and weights[0, 3, 10] == pytest.approx(0.5)
        and weights[0, 4, 10] == 0.0
    )
    assert 0.0 < weights[1, 2, 10] < 1.0
    assert weights[1].count_nonzero() == 1


def test_equal_signals_cost_nothing(voice: Tensor) -> None:
    assert loss(voice, voice) == [0.0, 0.0]
    assert loss(torch.zeros(1, 3200), torch.zeros(1, 3200)) == [0.0]


@pytest.mark.parametrize("gain", [-60.0, -20.0, -3.0, 0.5, 12.0, 30.0])
def test_a_gain_costs_its_decibels(voice: Tensor, gain: float) -> None:
    assert loss(voice * 10.0 ** (gain / 20.0), voice) == pytest.approx([abs(gain)] * 2, rel=1e-4)


def test_more_missing_gain_costs_more(voice: Tensor) -> None:
    """Where half of the spectrum is missing, at every depth."""
    spectrum = torch.fft.rfft(voice)
    upper = torch.arange(spectrum.shape[-1]) > spectrum.shape[-1] // 4
    costs = []
    for missing in (0.0, 10.0, 20.0, 40.0, 60.0, 80.0):
        gain = torch.where(upper, 10.0 ** (-missing / 20.0), 1.0)
        costs.append(loss(torch.fft.irfft(spectrum * gain, voice.shape[-1]), voice))
    for less, more in pairwise(costs):
        assert less[0] < more[0] and less[1] < more[1]


@pytest.mark.parametrize("attenuation", [20.0, 40.0, 60.0])
def test_an_inaudible_band_keeps_its_gradient(voice: Tensor, attenuation: float) -> None:
    """A gain of the band's in dB has a gradient of 1 times its share, though it is heard at -16 dB SPL and less."""
    normal = voice.float()
    spectrum = torch.fft.rfft(normal)
    hz = torch.fft.rfftfreq(normal.shape[-1], 1.0 / RATE)
    band = (hz > 2000.0) & (hz < 4000.0)
    gain = torch.tensor(-attenuation, requires_grad=True)
    heard = torch.fft.irfft(
        spectrum * torch.where(band, 10.0 ** (gain / 20.0), 1.0), normal.shape[-1]
    )
    (gradient,) = torch.autograd.grad(band_level_loss(heard, normal, RATE).mean(), gain)
    truth = band_levels(normal, RATE)
    weights = audibility(truth, least_audible(truth))
    inside = torch.from_numpy((band_edges()[:-1] > 2000.0) & (band_edges()[1:] < 4000.0))
    share = (weights * inside).sum((-2, -1)) / weights.sum((-2, -1))
    assert float(gradient) < -0.8 * float(share.mean())


def test_noise_in_a_pause_costs(voice: Tensor) -> None:
    """Though a normal ear hears nothing there."""
    clean = torch.cat((voice, torch.zeros_like(voice)), -1)
    noise = torch.zeros_like(clean)
    noise[:, 18000:] = set_level(torch.randn(2, 14000, dtype=torch.float64), 55.0)
    given = (clean + noise).requires_grad_()
    value = band_level_loss(given, clean, RATE)
    assert min(value.tolist()) > 3.0
    (gradient,) = torch.autograd.grad(value.sum(), given)
    # less noise is better
    assert float((gradient * noise).sum()) > 0.0
    faint = clean + noise * 1e-3
    assert max(loss(faint, clean)) < 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_of_silence_are_finite(voice: Tensor, dtype: torch.dtype) -> None:
    clean = voice.to(dtype)
    for heard, normal in (
        (torch.zeros_like(clean), clean),
        (clean, torch.zeros_like(clean)),
        (torch.zeros_like(clean), torch.zeros_like(clean)),
        (clean * 1e-12, clean),
        (clean[:, :10] * 0.0, clean[:, :10]),
    ):
        given = heard.clone().requires_grad_()
        value = band_level_loss(given, normal, RATE)
        (gradient,) = torch.autograd.grad(value.sum(), given)
        assert bool(value.isfinite().all()) and bool(gradient.isfinite().all())
