"""HASPI against pyclarity called directly, its seeds, its refusals."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim import extras
from hlsim.audio import read_audio
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.metrics.pyclarity import pyclarity_score

clarity_haspi = pytest.importorskip("clarity.evaluator.haspi")
clarity_audiogram = pytest.importorskip("clarity.utils.audiogram")

N3 = Audiogram.standard("N3")
haspi = partial(pyclarity_score, "haspi")


@pytest.fixture(scope="module")
def clips(speech_dir: Path) -> list[tuple[Tensor, int]]:
    """1 s of two voices at 16 and 22.05 kHz, (time,), and the rate."""
    out = []
    for name in ("train/flite-slt-01", "valid/espeak-us-annie-01"):
        waveform, rate = read_audio(speech_dir / f"{name}.flac")
        out.append((waveform[0, rate // 2 : rate // 2 + rate], rate))
    return out


def noisy(clean: Tensor, snr_db: float = 5.0) -> Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    return clean + noise * clean.square().mean().sqrt() * 10 ** (-snr_db / 20)


def by_pyclarity(
    clean: Tensor, heard: Tensor, levels: tuple[float, ...], rate: int, level1: float, seed: int
) -> float:
    np.random.seed(seed)
    ear = clarity_audiogram.Audiogram(levels=np.array(levels), frequencies=np.array(FREQUENCIES))
    x, y = clean.double().numpy(), heard.double().numpy()
    return float(clarity_haspi.haspi_v2(x, rate, y, rate, ear, level1=level1)[0])


@pytest.mark.parametrize(
    ("clip", "name", "full_scale_spl", "seed"),
    [(0, "N3", 94.0, 0), (1, "S2", 94.0, 7), (0, "NH", 110.0, 2**32 - 1)],
)
def test_equals_pyclarity(
    clips: list[tuple[Tensor, int]], clip: int, name: str, full_scale_spl: float, seed: int
) -> None:
    clean, rate = clips[clip]
    ear = Audiogram.standard(name)
    ours = haspi(clean, noisy(clean), ear, rate, full_scale_spl=full_scale_spl, seed=seed)
    assert ours == pytest.approx(
        by_pyclarity(clean, noisy(clean), ear.levels, rate, full_scale_spl, seed), abs=1e-12
    )


def test_other_grids_are_the_ear_that_pyclarity_takes_them_for(
    clips: list[tuple[Tensor, int]],
) -> None:
    clean, rate = clips[0]
    ear = Audiogram((20.0, 50.0, 70.0), (500.0, 1500.0, 6000.0))
    np.random.seed(0)
    x = clean.double().numpy()
    direct = float(clarity_haspi.haspi_v2(x, rate, x, rate, ear.to_clarity(), level1=94.0)[0])
    assert haspi(clean, clean, ear, rate) == pytest.approx(direct, abs=1e-12)


def test_takes_numpy_float32_and_gradients(clips: list[tuple[Tensor, int]]) -> None:
    clean, rate = clips[0]
    score = haspi(clean, clean.clone().requires_grad_(), N3, rate)
    assert score == haspi(clean.numpy(), clean.double().numpy(), N3, rate)
    assert 0.0 < score < 1.0


def test_seed_decides_and_the_global_state_comes_back(clips: list[tuple[Tensor, int]]) -> None:
    clean, rate = clips[0]
    np.random.seed(123)
    expected = np.random.standard_normal(4)
    np.random.seed(123)
    first = haspi(clean, clean, N3, rate, seed=1)
    with pytest.raises(ValueError, match="silent"):
        haspi(clean, clean * 0, N3, rate)
    assert np.array_equal(np.random.standard_normal(4), expected)
    assert haspi(clean, clean, N3, rate, seed=1) == first
    assert haspi(clean, clean, N3, rate, seed=2) != first


def test_full_scale_is_a_level(clips: list[tuple[Tensor, int]]) -> None:
    """Ten times the samples at 20 dB less full scale are the same sound."""
    clean, rate = clips[0]
    louder = haspi(clean * 10, noisy(clean) * 10, N3, rate, full_scale_spl=74.0)
    assert louder == pytest.approx(haspi(clean, noisy(clean), N3, rate), abs=1e-6)


def test_gain_alone_raises_the_score(clips: list[tuple[Tensor, int]]) -> None:
    """Why a report gives the level: nothing but gain, for a severe loss."""
    clean, rate = clips[0]
    ear = Audiogram.standard("N4")
    assert haspi(clean, clean, ear, rate) + 0.3 < haspi(clean, clean * 10, ear, rate)


def test_noise_lowers_the_score(speech: list[tuple[Tensor, int]]) -> None:
    waveform, rate = speech[0]
    clean = waveform[
        0, rate // 2 : rate // 2 + 2 * rate
    ]  # 1 s would not do: there even -15 dB of SNR scores 0.4
    ear = Audiogram.standard("NH")
    scores = [haspi(clean, noisy(clean, snr), ear, rate) for snr in (30.0, 0.0, -15.0)]
    assert scores == sorted(scores, reverse=True) and scores[0] > 0.95 and scores[2] < 0.1


SPEECH = torch.sin(torch.arange(16000) * 0.2) * 0.05


@pytest.mark.parametrize(
    ("reference", "processed", "options", "message"),
    [
        (SPEECH * 0, SPEECH, {}, "^reference is silent"),
        (SPEECH, SPEECH * 0, {}, "^processed is silent"),
        (
            SPEECH,
            SPEECH.clone().index_fill(0, torch.tensor([5]), float("nan")),
            {},
            "^processed holds samples that are NaN",
        ),
        (SPEECH / 0, SPEECH, {}, "^reference holds samples that are NaN or infinite"),
        (SPEECH, SPEECH[:-1], {}, "reference has 16000 samples and processed 15999"),
        (SPEECH.expand(2, -1), SPEECH.expand(2, -1), {}, r"reference has shape \(2, 16000\)"),
        (SPEECH[:0], SPEECH[:0], {}, r"reference has shape \(0,\)"),
        ((SPEECH * 100).long(), SPEECH, {}, "int64"),
        (SPEECH[:11000], SPEECH[:11000], {}, "lasts 0.69 s; a score needs 0.7 s"),
        (SPEECH * 1e-3, SPEECH, {}, "reference is at 5.0 dB SPL with full_scale_spl 94"),
        (SPEECH * 1e-3 + 0.1, SPEECH, {}, "reference is at 5.0 dB SPL"),
        (SPEECH, SPEECH, {"sample_rate": 8000}, "8000 Hz; allowed: 16000 to 48000"),
        (SPEECH, SPEECH, {"full_scale_spl": float("nan")}, "full_scale_spl is nan"),
        (SPEECH, SPEECH, {"seed": -1}, "seed is -1"),
        (SPEECH, SPEECH, {"audiogram": (0,) * 8}, "audiogram is tuple"),
    ],
)
def test_bad_input(
    reference: Tensor, processed: Tensor, options: dict[str, object], message: str
) -> None:
    arguments: dict[str, object] = {"audiogram": N3, "sample_rate": 16000, **options}
    with pytest.raises(ValueError, match=message) as error:
        haspi(reference, processed, **arguments)
    assert "\n" not in str(error.value)


def test_missing_extra_names_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "clarity.evaluator.haspi", None)
    with pytest.raises(extras.MissingExtraError, match=r"pip install 'hlsim\[pyclarity\]'"):
        haspi(SPEECH, SPEECH, N3, 16000)
