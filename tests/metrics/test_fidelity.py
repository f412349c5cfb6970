"""Fidelity measures equal those of pystoi, pesq and scipy, and the size of known errors."""

import math
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from hlsim import extras
from hlsim.dsp.resample import resample
from hlsim.metrics.fidelity import (
    pesq_wb,
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
    halves = pair[0].bfloat16(), pair[1].bfloat16()
    assert snr_db(*halves) == snr_db(*(signal.float() for signal in halves))


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
    for gain in (1.0, -0.25):
        expected = abs(20 * math.log10(abs(gain)))
        assert third_octave_error_db(reference, gain * reference, rate) == pytest.approx(expected)
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
    assert stoi(noisy, clean, rate) == pytest.approx(expected, abs=1e-12)
    at_16_khz = [resample(signal, rate, 16000).numpy() for signal in (clean, noisy)]
    expected = pesq.pesq(16000, *at_16_khz, "wb")
    assert 1.0 < expected < 4.0
    assert pesq_wb(noisy, clean, rate) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("measure", "package", "extra"), [(stoi, "pystoi", "eval"), (pesq_wb, "pesq", "pesq")]
)
def test_scores_that_are_not_defined_raise_value_error(
    pair: tuple[Tensor, Tensor],
    measure: Callable[..., float],
    package: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip(package)
    clean, noisy = pair
    short = noisy[:2000], clean[:2000]
    click = torch.where(torch.arange(len(noisy)) < 320, noisy, 0.0)  # without any utterance
    for signals in ((noisy * 0, clean), (noisy, clean * 0), (noisy / 0, clean), short):
        with pytest.raises(ValueError, match=r"silent|finite|is not defined"):
            measure(*signals, 16000)
    if measure is pesq_wb:
        with pytest.raises(ValueError, match="PESQ is not defined: No utterances detected"):
            measure(noisy, click, 16000)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(extras.MissingExtraError, match=rf"pip install 'hlsim\[{extra}\]'"):
        measure(noisy, clean, 16000)


@pytest.mark.parametrize(
    ("reference", "estimate"),
    [
        (torch.zeros(9), torch.ones(9)),
        (torch.ones(9), torch.ones(8)),
        (torch.ones(2, 9), torch.ones(2, 9)),
        (torch.ones(0), torch.ones(0)),
        (torch.ones(9), torch.full((9,), float("nan"))),
        (torch.ones(16000), torch.ones(16000)),  # without power in the bands
    ],
)
def test_bad_waveforms_raise_value_error(reference: Tensor, estimate: Tensor) -> None:
    measures = (snr_db, raw_mse, lambda a, b: third_octave_error_db(a, b, 16000))
    for measure in measures[2 if len(reference) > 9 else 0 :]:
        with pytest.raises(ValueError):
            measure(reference, estimate)
    with pytest.raises(ValueError, match="16000 Hz or more"):
        third_octave_error_db(torch.randn(9), torch.randn(9), 8000)
