"""HAAQI in torch against pyclarity, its batches and its gradient."""

import numpy as np
import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor

import hlsim
from hlsim import NALR, Audiogram, Listener
from hlsim.metrics import HaaqiReference, haaqi
from hlsim.metrics.ear.model import Extent
from hlsim.metrics.haaqi_score import modulation_correlation
from tests import pyclarity as reference
from tests.pyclarity import PyclarityOutputs

N2, N4 = Audiogram.standard("N2"), Audiogram.standard("N4")
SECONDS = 1.2


def example_music(rate: int) -> Tensor:
    """Return four chords of decaying harmonic tones with random pitches, 70 dB SPL, float64."""
    random = np.random.RandomState(0)
    time = np.arange(round(SECONDS * rate)) / rate
    music = np.zeros_like(time)
    for onset in (0.0, 0.3, 0.6, 0.9):
        since_onset = time - onset
        envelope = np.where(since_onset >= 0.0, np.exp(-6.0 * np.maximum(since_onset, 0.0)), 0.0)
        for semitone in (0, 4, 7):
            pitch = 220.0 * 2.0 ** ((semitone + random.randint(12)) / 12)
            for harmonic in range(1, 9):
                phase = 2.0 * np.pi * random.uniform()
                tone = np.sin(2.0 * np.pi * harmonic * pitch * since_onset + phase)
                music += envelope * tone / harmonic
    return torch.from_numpy(music * 10.0 ** ((70.0 - 94.0) / 20.0) / np.sqrt(np.mean(music**2)))


def example_speech(rate: int) -> Tensor:
    speech = hlsim.example_speech()[8000 : 8000 + round(SECONDS * 16000)].double().numpy()
    return torch.from_numpy(resample_poly(speech, rate // 100, 160))


def degraded(clean: Tensor) -> Tensor:
    """Return the signal with noise and clipped peaks."""
    noise = np.random.RandomState(1).standard_normal(clean.shape)
    rms = float(clean.square().mean().sqrt())
    return (2.0 * clean + 0.2 * rms * torch.from_numpy(noise)).clamp(-5.0 * rms, 5.0 * rms)


@pytest.mark.parametrize("rate", [16000, 24000, 32000, 44100])
@pytest.mark.parametrize("kind", ["music", "speech"])
def test_equals_pyclarity_under_its_seed(pyclarity: PyclarityOutputs, kind: str, rate: int) -> None:
    clean = example_music(rate) if kind == "music" else example_speech(rate)
    processed = degraded(clean)
    key = f"haaqi, {kind}, {rate} Hz"
    arguments = clean.numpy(), processed.numpy(), N4, rate, 7
    expected = pyclarity(key, reference.haaqi, *arguments).tolist()
    for dtype, error in ((torch.float64, 1e-6), (torch.float32, 1e-4)):
        prepared = HaaqiReference(clean.to(dtype), N4, sample_rate=rate, whole_khz=True)
        parts = prepared.parts(processed.to(dtype), noise="seeded", seed=7)
        assert [float(part) for part in parts] == pytest.approx(expected, abs=error)
    score = float(haaqi(processed, clean, N4, sample_rate=rate, whole_khz=True))
    assert score == pytest.approx(expected[0], abs=2e-3)


@pytest.mark.parametrize(
    ("name", "unaided", "amplified"), [("NH", 0.91, 0.91), ("N2", 0.73, 0.90), ("N4", 0.28, 0.94)]
)
def test_identical_music_has_pyclaritys_score_below_1(
    pyclarity: PyclarityOutputs, name: str, unaided: float, amplified: float
) -> None:
    """The module's docstring and the guide for Cadenza state these scores."""
    clean, ear = example_music(24000), Audiogram.standard(name)
    by_nalr = NALR(ear, sample_rate=24000, order=140)(clean)
    for kind, processed, score in (("clean", clean, unaided), ("NAL-R", by_nalr, amplified)):
        arguments = clean.numpy(), processed.numpy(), ear, 24000, 7
        expected = float(pyclarity(f"haaqi, {kind}, {name}", reference.haaqi, *arguments)[0])
        prepared = HaaqiReference(clean, ear, sample_rate=24000)
        assert float(prepared.score(processed, noise="seeded", seed=7)) == pytest.approx(
            expected, abs=1e-6
        )
        assert expected == pytest.approx(score, abs=0.005)


@pytest.mark.parametrize("segments", [7, 300])
def test_modulation_correlation_equals_pyclaritys(segments: int) -> None:
    eb = pytest.importorskip("clarity.evaluator.haspi.eb")
    random = np.random.RandomState(0)
    x = 20.0 * np.abs(random.standard_normal((32, segments)))
    y = x + 5.0 * random.standard_normal((32, segments))
    x[:, 2] = 0.0  # a silent segment
    expected = eb.melcor9(x.copy(), y.copy(), 2.5, 0.0, 8)[2]
    levels = (torch.from_numpy(signal)[None] for signal in (x, y))
    result = modulation_correlation(*levels, Extent((segments,)))
    assert float(result) == pytest.approx(expected, abs=1e-12)


def test_a_batch_is_its_items() -> None:
    clean = torch.stack([example_music(16000), example_speech(16000)])
    processed = degraded(clean)
    ends, ears = [19200, 15300], [N2, N4]
    alone = [
        haaqi(processed[i, :end], clean[i, :end], ears[i], noise="none")
        for i, end in enumerate(ends)
    ]
    together = haaqi(processed, clean, ears, lengths=ends, noise="none")
    torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-13)


def test_stereo_music_has_a_score_for_each_ear() -> None:
    clean = torch.stack([example_music(16000), 0.5 * example_music(16000)])
    processed = degraded(clean)
    listener = Listener(N2, N4)
    scores = haaqi(processed, clean, listener)
    expected = [haaqi(processed[side], clean[side], ear) for side, ear in enumerate((N2, N4))]
    torch.testing.assert_close(scores, torch.stack(expected), rtol=0, atol=1e-12)


def test_clean_music_has_the_best_score_and_noise_lowers_it() -> None:
    clean, ear = example_music(16000), "NH"
    noise = torch.randn(clean.shape, dtype=torch.float64) * clean.std()
    scores = [float(haaqi(clean + gain * noise, clean, ear)) for gain in (0.0, 0.01, 0.1, 1.0)]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] > 0.9


def test_gradient_is_that_of_finite_differences() -> None:
    clean = example_music(16000)
    prepared = HaaqiReference(clean, N2)
    processed = degraded(clean).requires_grad_()
    (gradient,) = torch.autograd.grad(prepared.score(processed), processed)
    direction = example_speech(16000)
    step = 1e-4
    with torch.no_grad():
        ends = [float(prepared.score(processed + sign * step * direction)) for sign in (1, -1)]
    slope = float((gradient * direction).sum())
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.01)


@pytest.mark.parametrize("gain", [0.0, 1e-4, 1.0, 1e3])
def test_gradient_is_finite(gain: float) -> None:
    clean = example_music(16000).float()
    processed = (gain * clean).requires_grad_()
    score = haaqi(processed, clean, N4)
    score.backward()
    assert 0.0 <= float(score.detach()) <= 1.0
    assert processed.grad is not None and bool(processed.grad.isfinite().all())


@pytest.mark.parametrize(
    "change",
    [{"clean": torch.ones(8000)}, {"audiogram": [N2, N2]}, {"noise": "pink"}, {"seed": -1}],
    ids=str,
)
def test_bad_input_raises_value_error(change: dict[str, object]) -> None:
    clean = change.get("clean", example_music(16000))
    settings = {"processed": clean, "clean": clean, "audiogram": N2, **change}
    with pytest.raises(ValueError):
        haaqi(**settings)
