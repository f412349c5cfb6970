"""Fidelity measures equal those of pystoi, pesq and scipy, and the size of known errors."""

import math
import sys

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from hlsim import extras
from hlsim.dsp.resample import resample
from hlsim.metrics.fidelity import (
    Score,
    linear_correlation,
    mean_squared_error,
    pesq_wb,
    rank_correlation,
    raw_mse,
    snr_db,
    stoi,
    third_octave_error_db,
)


@pytest.fixture
def pair(speech: list[tuple[Tensor, int]]) -> tuple[Tensor, Tensor]:
    """Two seconds of speech at 16 kHz, and the same speech with noise at an SNR of 10 dB."""
    clean = speech[0][0][0, 8000:40000]
    noise = torch.randn(clean.shape)
    return clean, clean + noise * clean.square().mean().sqrt() * 10**-0.5


def test_snr_and_raw_mse_equal_those_of_a_known_error(pair: tuple[Tensor, Tensor]) -> None:
    clean = pair[0].double()
    for db in (-10.0, 0.0, 24.0):
        error = torch.randn(clean.shape, dtype=torch.float64)
        error *= (clean.square().sum() / error.square().sum()).sqrt() * 10 ** (-db / 20)
        assert snr_db(clean, clean + error) == pytest.approx(db, abs=1e-9)
        mse = raw_mse(clean.numpy(), (clean + error).numpy())
        assert mse == pytest.approx(10 ** (-db / 10), rel=1e-9)
    assert snr_db(clean, clean) == 200.0
    assert raw_mse(clean, clean) == 0.0
    assert raw_mse(clean, clean * 0) == pytest.approx(1.0)


def test_errors_do_not_depend_on_the_level(pair: tuple[Tensor, Tensor]) -> None:
    clean, noisy = (x.double() for x in pair)
    for measure in (snr_db, raw_mse, lambda a, b: third_octave_error_db(a, b, 16000)):
        assert measure(clean * 100, noisy * 100) == pytest.approx(measure(clean, noisy), rel=1e-9)


def test_third_octave_error_of_a_gain_equals_the_gain(pair: tuple[Tensor, Tensor]) -> None:
    clean = pair[0]
    assert third_octave_error_db(clean, clean, 16000) == 0.0
    for gain in (2.0, -0.25):
        error = third_octave_error_db(clean, clean * gain, 16000)
        assert error == pytest.approx(abs(20 * math.log10(abs(gain))), abs=1e-5)
    assert third_octave_error_db(clean, clean * 0, 16000) > 70.0


@pytest.mark.parametrize("rate", [16000, 44100])
def test_third_octave_error_is_the_median_over_bands_near_the_loudest(rate: int) -> None:
    """The signals have one tone per band, whose gains are 0, 1, ... 17 dB."""
    time = torch.arange(rate, dtype=torch.float64) / rate
    centres = 1000.0 * 2.0 ** (torch.arange(-9, 9) / 3.0)
    tones = torch.sin(2 * math.pi * centres.double().round().unsqueeze(1) * time)
    reference = tones.sum(0)
    gains = 10 ** (torch.linspace(0.0, 17.0, 18, dtype=torch.float64) / 20).unsqueeze(1)
    estimate = (tones * gains).sum(0)
    assert third_octave_error_db(reference, estimate, rate) == pytest.approx(8.5, abs=1e-6)
    # Tones outside 125 Hz to 7 kHz have no effect.
    outside = 30 * torch.sin(2 * math.pi * 100 * time) + 30 * torch.sin(2 * math.pi * 7300 * time)
    error = third_octave_error_db(reference + outside, estimate, rate)
    assert error == pytest.approx(8.5, abs=1e-6)
    # With the upper nine bands 60 dB softer, only the lower nine count, with gains of 0 to 8 dB.
    soft_upper_tones = tones * torch.where(torch.arange(18) < 9, 1.0, 1e-3).unsqueeze(1)
    reference = soft_upper_tones.sum(0)
    estimate = (soft_upper_tones * gains).sum(0)
    assert third_octave_error_db(reference, estimate, rate) == pytest.approx(4.0, abs=1e-6)


@pytest.mark.parametrize("voice", [0, 3])
def test_scores_equal_those_of_their_packages(speech: list[tuple[Tensor, int]], voice: int) -> None:
    """The second voice is at 22.05 kHz."""
    pystoi, pesq = pytest.importorskip("pystoi"), pytest.importorskip("pesq")
    waveform, rate = speech[voice]
    clean = waveform[0].double()
    noisy = clean + 0.02 * torch.randn(clean.shape)
    expected = pystoi.stoi(clean.numpy(), noisy.numpy(), rate)
    assert 0.3 < expected < 0.99
    assert stoi(clean, noisy, rate) == Score(pytest.approx(expected, abs=1e-12), None)
    at_16_khz = [resample(signal, rate, 16000).numpy() for signal in (clean, noisy)]
    expected = pesq.pesq(16000, *at_16_khz, "wb")
    assert 1.0 < expected < 4.0
    assert pesq_wb(clean, noisy, rate) == Score(pytest.approx(expected, abs=1e-12), None)


@pytest.mark.parametrize(
    ("measure", "package", "extra"), [(stoi, "pystoi", "eval"), (pesq_wb, "pesq", "pesq")]
)
def test_an_item_without_a_score_has_a_reason(
    pair: tuple[Tensor, Tensor],
    measure: type[Score],
    package: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip(package)
    clean, noisy = pair
    assert measure(clean, noisy * 0, 16000) == Score(None, "output is silent")
    assert measure(clean * 0, noisy, 16000) == Score(None, "clean is silent")
    reason = "output has samples that are NaN or infinite"
    assert measure(clean, noisy / 0, 16000) == Score(None, reason)
    short = measure(clean[:2000], noisy[:2000], 16000)
    assert short.value is None and short.reason
    with pytest.raises(ValueError):
        measure(clean, noisy[1:], 16000)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(extras.MissingExtraError, match=rf"pip install 'hlsim\[{extra}\]'"):
        measure(clean, noisy, 16000)


def test_the_message_of_an_error_of_pesq_is_the_reason() -> None:
    """pesq finds no speech in 20 ms of noise."""
    pytest.importorskip("pesq")
    output = torch.randn(16000)
    clean = torch.where(torch.arange(16000) < 320, output, 0.0)
    assert pesq_wb(clean, output, 16000) == Score(None, "No utterances detected")


@pytest.mark.parametrize(
    ("reference", "estimate"),
    [
        (torch.zeros(9), torch.ones(9)),
        (torch.ones(9), torch.ones(8)),
        (torch.ones(2, 9), torch.ones(2, 9)),
        (torch.ones(0), torch.ones(0)),
        (torch.ones(9), torch.full((9,), float("nan"))),
    ],
)
def test_bad_waveforms_raise_value_error(reference: Tensor, estimate: Tensor) -> None:
    for measure in (snr_db, raw_mse, lambda a, b: third_octave_error_db(a, b, 16000)):
        with pytest.raises(ValueError):
            measure(reference, estimate)


@pytest.mark.parametrize(("frequency", "rate"), [(2500.0, 8000), (0.0, 16000)])
def test_signals_without_power_in_the_bands_raise_value_error(frequency: float, rate: int) -> None:
    tone = torch.cos(2.0 * math.pi * frequency / rate * torch.arange(rate, dtype=torch.float64))
    with pytest.raises(ValueError):
        third_octave_error_db(tone, tone, rate)


def test_correlations_equal_scipy() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(size=40).round(1)  # some values are equal
    y = x**3 + rng.normal(0, 0.05, 40)
    assert linear_correlation(x, y) == pytest.approx(stats.pearsonr(x, y)[0], abs=1e-14)
    assert rank_correlation(x, y) == pytest.approx(stats.spearmanr(x, y)[0], abs=1e-14)
    assert mean_squared_error(x, y) == pytest.approx(np.mean((x - y) ** 2), abs=1e-15)
    assert rank_correlation(x, np.exp(x)) == pytest.approx(1.0)


def test_undefined_correlations_are_none_and_bad_scores_raise_value_error() -> None:
    for measure in (linear_correlation, rank_correlation):
        assert measure([0.5], [0.5]) is None
        assert measure([0.5, 0.5, 0.5], [0.1, 0.2, 0.3]) is None
    assert mean_squared_error([], []) is None
    for measure in (linear_correlation, rank_correlation, mean_squared_error):
        for scores in ([0.1, 0.2, 0.3], [0.1, math.nan]):
            with pytest.raises(ValueError):
                measure(scores, [0.1, 0.2])
