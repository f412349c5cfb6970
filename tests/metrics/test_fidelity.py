"""Fidelity measures against pystoi, pesq and scipy called directly, and against what is known of made-up errors."""

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
    """Two seconds of speech at 16 kHz and the same with noise at 10 dB SNR. Shape: (time,)."""
    clean = speech[0][0][0, 8000:40000]
    noise = torch.randn(clean.shape)
    return clean, clean + noise * clean.square().mean().sqrt() * 10**-0.5


def test_snr_and_raw_mse_of_a_known_error(pair: tuple[Tensor, Tensor]) -> None:
    clean = pair[0].double()
    for db in (-10.0, 0.0, 24.0):
        error = torch.randn(clean.shape, dtype=torch.float64)
        error *= (clean.square().sum() / error.square().sum()).sqrt() * 10 ** (-db / 20)
        assert snr_db(clean, clean + error) == pytest.approx(db, abs=1e-9)
        assert raw_mse(clean.numpy(), (clean + error).numpy()) == pytest.approx(
            10 ** (-db / 10), rel=1e-9
        )
    assert snr_db(clean, clean) == 200.0
    assert raw_mse(clean, clean) == 0.0
    assert raw_mse(clean, clean * 0) == pytest.approx(1.0)


def test_errors_do_not_depend_on_the_level(pair: tuple[Tensor, Tensor]) -> None:
    clean, noisy = (x.double() for x in pair)
    for measure in (snr_db, raw_mse, lambda a, b: third_octave_error_db(a, b, 16000)):
        assert measure(clean * 100, noisy * 100) == pytest.approx(measure(clean, noisy), rel=1e-9)


def test_third_octave_error_of_a_gain_is_the_gain(pair: tuple[Tensor, Tensor]) -> None:
    clean = pair[0]
    assert third_octave_error_db(clean, clean, 16000) == 0.0
    assert third_octave_error_db(clean, clean * 2.0, 16000) == pytest.approx(
        20 * math.log10(2), abs=1e-5
    )
    assert third_octave_error_db(clean, clean * -0.25, 16000) == pytest.approx(
        20 * math.log10(4), abs=1e-5
    )
    assert third_octave_error_db(clean, clean * 0, 16000) > 70.0


@pytest.mark.parametrize("rate", [16000, 44100])
def test_third_octave_bands_are_where_they_should_be(rate: int) -> None:
    """A tone in the middle of each band: all but one right leave the median at 0; bands far below do not count."""
    time = torch.arange(rate, dtype=torch.float64) / rate
    centres = 1000.0 * 2.0 ** (torch.arange(-9, 9) / 3.0)
    tones = torch.sin(2 * math.pi * centres.double().round().unsqueeze(1) * time)
    truth = tones.sum(0)
    gains = torch.linspace(0.0, 17.0, 18, dtype=torch.float64)
    estimate = (tones * 10 ** (gains / 20).unsqueeze(1)).sum(0)
    assert third_octave_error_db(truth, estimate, rate) == pytest.approx(8.5, abs=1e-6)
    # tones outside 125 Hz to 7 kHz change nothing
    outside = 30 * torch.sin(2 * math.pi * 100 * time) + 30 * torch.sin(2 * math.pi * 7300 * time)
    assert third_octave_error_db(truth + outside, estimate, rate) == pytest.approx(8.5, abs=1e-6)
    # the upper half 60 dB down: only the lower nine count, with gains 0 to 8 dB
    drop = torch.where(torch.arange(18) < 9, 1.0, 1e-3).unsqueeze(1)
    assert third_octave_error_db(
        (tones * drop).sum(0), (tones * drop * 10 ** (gains / 20).unsqueeze(1)).sum(0), rate
    ) == pytest.approx(4.0, abs=1e-6)


def test_stoi_equals_pystoi(pair: tuple[Tensor, Tensor], speech: list[tuple[Tensor, int]]) -> None:
    pystoi = pytest.importorskip("pystoi")
    clean, noisy = pair
    direct = pystoi.stoi(clean.double().numpy(), noisy.double().numpy(), 16000)
    score = stoi(clean, noisy, 16000)
    assert score.value == pytest.approx(direct, abs=1e-12) and score.reason is None
    assert 0.3 < direct < 0.99
    other, rate = speech[3]
    x, y = (
        other[0].double().numpy(),
        (other[0] + 0.02 * torch.randn(other.shape[1])).double().numpy(),
    )
    assert stoi(x, y, rate).value == pytest.approx(pystoi.stoi(x, y, rate), abs=1e-12)


def test_pesq_equals_pesq(pair: tuple[Tensor, Tensor], speech: list[tuple[Tensor, int]]) -> None:
    pesq = pytest.importorskip("pesq")
    clean, noisy = pair
    direct = pesq.pesq(16000, clean.double().numpy(), noisy.double().numpy(), "wb")
    assert pesq_wb(clean, noisy, 16000) == Score(pytest.approx(direct, abs=1e-12), None)
    assert 1.0 < direct < 4.0
    other, rate = speech[3]
    heard = other[0] + 0.02 * torch.randn(other.shape[1])
    pair_16k = [resample(x.double(), rate, 16000).numpy() for x in (other[0], heard)]
    assert pesq_wb(other[0], heard, rate).value == pytest.approx(
        pesq.pesq(16000, *pair_16k, "wb"), abs=1e-12
    )


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
    assert measure(clean, noisy * 0, 16000) == Score(None, "heard is silent")
    assert measure(clean * 0, noisy, 16000) == Score(None, "clean is silent")
    assert measure(clean, noisy / 0, 16000) == Score(
        None, "heard holds samples that are NaN or infinite"
    )
    short = measure(clean[:2000], noisy[:2000], 16000)
    assert short.value is None and short.reason
    with pytest.raises(ValueError):
        measure(clean, noisy[1:], 16000)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(extras.MissingExtraError, match=rf"pip install 'hlsim\[{extra}\]'"):
        measure(clean, noisy, 16000)


def test_no_utterance_is_a_reason() -> None:
    """A hiss of 20 ms and silence is no speech to pesq, which raises; its own words are the reason."""
    pytest.importorskip("pesq")
    heard = torch.randn(16000)
    clean = torch.where(torch.arange(16000) < 320, heard, 0.0)
    assert pesq_wb(clean, heard, 16000) == Score(None, "No utterances detected")


@pytest.mark.parametrize(
    ("truth", "estimate"),
    [
        (torch.zeros(9), torch.ones(9)),
        (torch.ones(9), torch.ones(8)),
        (torch.ones(2, 9), torch.ones(2, 9)),
        (torch.ones(0), torch.ones(0)),
        (torch.ones(9), torch.full((9,), float("nan"))),
    ],
)
def test_bad_waveforms_raise_value_error(truth: Tensor, estimate: Tensor) -> None:
    for measure in (snr_db, raw_mse, lambda a, b: third_octave_error_db(a, b, 16000)):
        with pytest.raises(ValueError):
            measure(truth, estimate)


def test_a_rate_below_the_bands_raises_value_error() -> None:
    with pytest.raises(ValueError):
        third_octave_error_db(torch.ones(9), torch.ones(9), 8000)


def test_correlations_equal_scipy() -> None:
    rng = np.random.default_rng(0)
    true = rng.uniform(size=40).round(1)  # ties
    simulated = true**3 + rng.normal(0, 0.05, 40)
    assert linear_correlation(true, simulated) == pytest.approx(
        stats.pearsonr(true, simulated)[0], abs=1e-14
    )
    assert rank_correlation(true, simulated) == pytest.approx(
        stats.spearmanr(true, simulated)[0], abs=1e-14
    )
    assert mean_squared_error(true, simulated) == pytest.approx(
        np.mean((true - simulated) ** 2), abs=1e-15
    )
    assert rank_correlation(true, np.exp(true)) == pytest.approx(1.0)


def test_correlations_that_are_undefined() -> None:
    for measure in (linear_correlation, rank_correlation):
        assert measure([0.5], [0.5]) is None
        assert measure([0.5, 0.5, 0.5], [0.1, 0.2, 0.3]) is None
    assert mean_squared_error([], []) is None
    assert mean_squared_error([0.5], [0.75]) == 0.0625
    for measure in (linear_correlation, rank_correlation, mean_squared_error):
        with pytest.raises(ValueError):
            measure([0.1, 0.2], [0.1])
        with pytest.raises(ValueError):
            measure([0.1, math.nan], [0.1, 0.2])
