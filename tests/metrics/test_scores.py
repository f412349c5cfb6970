"""HASPI, HASQI and HAAQI against pyclarity, their batches, noise, gradients and errors."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor
from torch.nn import functional

import hlsim
from hlsim import NALR, WDRC, Audiogram
from hlsim.audio import read_audio
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.calibration import set_level
from hlsim.data import bundled
from hlsim.dsp.fir import filters_with_gains
from hlsim.metrics import HaaqiReference, HaspiReference, HasqiReference, haaqi, haspi, hasqi
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.haaqi_score import _split_by_rate
from hlsim.metrics.quality_reference import _scale_motion_to_level
from tests import pyclarity as reference
from tests.helpers import mostly_slow
from tests.pyclarity import PyclarityOutputs

SPEECH = bundled.SPEECH / "valid"
NH, N1, N2, N3, N4, N5, N6, S2 = (
    Audiogram.standard(name) for name in ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "S2")
)
SCORES: dict[str, Callable[..., Tensor]] = {"haspi": haspi, "hasqi": hasqi, "haaqi": haaqi}


@cache
def pair(first: int = 1, noise_gain: float = 0.5) -> tuple[Tensor, Tensor]:
    """Return two clips of 0.8 s at 16 kHz, 68 dB SPL, clean and noisy. Shape: (2, time) each."""
    paths = [SPEECH / f"flite-rms-0{number}.flac" for number in (first, first + 1)]
    clean = torch.stack([read_audio(path)[0][0, 8000:20800] for path in paths])
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    return clean, clean + noise_gain * noise * clean.square().mean(-1, keepdim=True).sqrt()


def at_rate(signal: Tensor, rate: int) -> Tensor:
    """Return the first item at another rate. Shape: (items, time) -> (time,), float64."""
    return torch.from_numpy(resample_poly(signal[0].double().numpy(), rate // 100, 160))


@cache
def example_music(rate: int) -> Tensor:
    """Return 1.2 s of four chords of decaying harmonic tones, 70 dB SPL, float64."""
    random = np.random.RandomState(0)
    time = np.arange(round(1.2 * rate)) / rate
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


def degrade(clean: Tensor) -> Tensor:
    """Return the signal with noise and clipped peaks."""
    noise = np.random.RandomState(1).standard_normal(clean.shape)
    rms = float(clean.square().mean().sqrt())
    return (2.0 * clean + 0.2 * rms * torch.from_numpy(noise)).clamp(-5.0 * rms, 5.0 * rms)


def prepare(name: str, clean: Tensor, ears: Any = N3, **settings: Any) -> Callable[..., Tensor]:
    """Return a function from outputs to their scores."""
    if name == "haspi":
        return partial(HaspiReference(clean, **settings).score, audiogram=ears)
    kind = HasqiReference if name == "hasqi" else HaaqiReference
    return partial(kind(clean, ears, **settings).score)


# -- pyclarity -------------------------------------------------------------------------------------

PARITY: dict[str, tuple[Audiogram, int, Callable[[Tensor], Tensor]]] = {
    "haspi, noisy": (N2, 16000, lambda noisy: noisy),
    "haspi, amplified, 48 kHz": (N3, 48000, lambda noisy: 10.0 * noisy),
    "haspi, clipped, 44.1 kHz": (S2, 44100, lambda noisy: noisy.clamp(-0.02, 0.02)),
    "haspi, nearly inaudible": (N5, 24000, lambda noisy: 0.3 * noisy),
    "hasqi, 16000 Hz": (N1, 16000, lambda noisy: noisy),
    "hasqi, 44100 Hz": (N3, 44100, lambda noisy: 0.5 * noisy),
    "haaqi, speech, 44100 Hz": (N4, 44100, degrade),
}
for rate in (16000, 24000, 32000):
    PARITY[f"haaqi, music, {rate} Hz"] = (N4, rate, degrade)

SLOW = {"haaqi, music, 24000 Hz", "hasqi, 16000 Hz"}
"""Cases whose rate is that of another score in the other tests, too."""

IN_DOUBLE = {f"haaqi, music, {rate} Hz" for rate in (16000, 32000)}
IN_DOUBLE |= {"haaqi, speech, 44100 Hz", "haspi, clipped, 44.1 kHz", "hasqi, 44100 Hz"}
"""Cases that are computed in double precision alone; others are in single, too."""


def signals_of(key: str) -> tuple[Tensor, Tensor]:
    """Return the clean signal and the output of a case of ``PARITY``."""
    _, rate, change = PARITY[key]
    if "music" in key:
        clean = noisy = example_music(rate)[: round(0.8 * rate)]
    elif "speech" in key:
        clean = noisy = at_rate(hlsim.example_speech()[None, 8000:20800], rate)
    else:
        clips = pair(3, 0.3) if "hasqi" in key else pair()
        clean, noisy = (at_rate(signal, rate) for signal in clips)
    return clean, change(noisy)


@pytest.mark.parametrize(
    "key", [pytest.param(key, marks=[pytest.mark.slow] * (key in SLOW)) for key in PARITY]
)
def test_equals_pyclarity_under_its_seed(pyclarity: PyclarityOutputs, key: str) -> None:
    name = key.partition(",")[0]
    ear, rate, _ = PARITY[key]
    clean, output = signals_of(key)
    arguments = clean.numpy(), output.numpy(), ear, rate, 7
    expected = np.atleast_1d(pyclarity(key, getattr(reference, name), *arguments)).tolist()
    if pyclarity.computed:
        return  # pyclarity's scores are the stored ones, which the other test compares with
    errors = {torch.float64: 1e-6 if name == "haaqi" else 1e-7, torch.float32: 1e-4}
    if key in IN_DOUBLE:
        del errors[torch.float32]
    for dtype, error in errors.items():
        x, y = clean.to(dtype), output.to(dtype)
        score = prepare(name, x, ear, sample_rate=rate, whole_khz=True)
        if name == "haspi":
            values = [float(score(y, noise="seeded", seed=7))]
        else:
            parts = score.func.__self__.parts
            values = [float(value) for value in parts(y, noise="seeded", seed=7)]
        assert values == pytest.approx(expected, abs=error)
    if key in IN_DOUBLE:
        return
    without_seed = float(score(y))
    assert without_seed == pytest.approx(expected[0], abs=7e-3 if name == "haspi" else 2e-3)


@pytest.mark.parametrize(
    "key", mostly_slow(["haaqi, NAL-R", "haaqi, compressed", "hasqi, NAL-R"], ["hasqi, NAL-R"])
)
def test_reference_that_is_amplified_already(pyclarity: PyclarityOutputs, key: str) -> None:
    """Cadenza's later challenges score so, with NAL-R of 221 taps or with a compressor."""
    name, rate = key.partition(",")[0], 44100
    ear = N3 if name == "hasqi" else N4
    clean = example_music(rate)[: round(0.8 * rate)]
    aid = {"NAL-R": NALR(sample_rate=rate), "compressed": WDRC(sample_rate=rate)}
    amplified = {kind: module(clean, ear) for kind, module in aid.items()}[key.partition(", ")[2]]
    output = degrade(amplified)
    arguments = amplified.numpy(), output.numpy(), ear, rate, 7, 2
    expected = pyclarity(f"{key}, equalisation 2", getattr(reference, name), *arguments)
    if pyclarity.computed:
        return  # as above
    settings = {"sample_rate": rate, "noise": "seeded", "seed": 7, "whole_khz": True}
    score = float(SCORES[name](output, amplified, ear, equalisation=2, **settings))
    assert score == pytest.approx(expected[0], abs=1e-6)


@pytest.mark.parametrize("name", mostly_slow(["hasqi", "haaqi"], ["hasqi"]))
def test_amplifying_the_reference_twice_changes_the_score(name: str) -> None:
    ear = N3 if name == "hasqi" else N4
    amplified = NALR()(example_music(16000)[:12000], ear)
    output = degrade(amplified)
    score = SCORES[name](output, amplified, ear, equalisation=2)
    assert float(SCORES[name](output, amplified, ear)) < float(score) - 0.01
    assert torch.equal(prepare(name, amplified, ear, equalisation=2)(output), score)
    with pytest.raises(ValueError, match="expected equalisation"):
        SCORES[name](output, amplified, ear, equalisation=0)


@pytest.mark.parametrize(
    ("name", "unaided", "amplified"),
    [
        pytest.param("NH", 0.91, 0.91, marks=pytest.mark.slow),
        pytest.param("N2", 0.73, 0.90, marks=pytest.mark.slow),
        ("N4", 0.28, 0.94),
    ],
)
def test_identical_music_has_pyclaritys_score_below_1(
    pyclarity: PyclarityOutputs, name: str, unaided: float, amplified: float
) -> None:
    """The module's docstring and the guide for Cadenza state these scores.

    Pyclarity reproduces the stored score of one output for each ear.
    """
    clean, ear = example_music(24000), Audiogram.standard(name)
    taps = nalr_taps(ear)
    by_nalr = functional.conv1d(clean[None], taps[None, None], padding="same")[0]
    cases = {"clean": (clean, unaided), "NAL-R": (by_nalr, amplified)}
    if pyclarity.computed and pyclarity.new_outputs is None:
        del cases["NAL-R" if name == "N2" else "clean"]
    for kind, (output, score) in cases.items():
        arguments = clean.numpy(), output.numpy(), ear, 24000, 7
        expected = float(pyclarity(f"haaqi, {kind}, {name}", reference.haaqi, *arguments)[0])
        if pyclarity.computed:
            continue  # as above
        prepared = HaaqiReference(clean, ear, sample_rate=24000)
        result = prepared.score(output, noise="seeded", seed=7)
        assert float(result) == pytest.approx(expected, abs=1e-6)
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
    result = fine_structure.envelope_correlation(*levels, Extent((segments,)), _split_by_rate)
    assert float(result) == pytest.approx(expected, abs=1e-12)


def nalr_taps(ear: Audiogram) -> Tensor:
    """Return NAL-R's filter at 24 kHz. Shape: (141,), float64."""
    gains = nalr_gains_db(torch.tensor(ear.thresholds, dtype=torch.float64))
    return filters_with_gains(gains, FREQUENCIES, 24000, 140)


@pytest.mark.parametrize("ear", [NH, N3, N6])
def test_nalr_equals_pyclaritys(ear: Audiogram) -> None:
    clarity = pytest.importorskip("clarity.enhancer.nalr")
    expected, _ = clarity.NALR(140, 24000).build(ear.to_clarity())
    taps = nalr_taps(ear)
    np.testing.assert_allclose(taps, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("time", [9000, 9100, 9216])
def test_features_of_segments_equal_pyclaritys(time: int) -> None:
    eb = pytest.importorskip("clarity.evaluator.haspi.eb")
    random = np.random.RandomState(0)
    x, y = (20.0 * np.abs(random.standard_normal((32, time))) for _ in range(2))
    y[:, :3000] = x[:, 5:3005]
    y[3] = 0.0
    waves, extent = [torch.from_numpy(signal)[None] for signal in (x, y)], Extent((time,))
    counts = fine_structure.segments_of(extent)
    means = fine_structure.smooth_levels(waves[0], extent)[0]
    np.testing.assert_allclose(means.numpy(), eb.env_smooth(x, 16, 24000.0), rtol=1e-12)
    covariance, energy = eb.bm_covary(x, y, 16, 24000.0)[:2]
    spectra = [fine_structure.segment_spectra(wave, extent) for wave in waves]
    coherence = fine_structure.coherence(*spectra, counts)
    np.testing.assert_allclose(coherence[0].numpy(), covariance, rtol=0, atol=1e-12)
    np.testing.assert_allclose(spectra[0][1][0].numpy(), energy, rtol=1e-10)
    synchrony = float(fine_structure.synchrony(coherence, spectra[0][1], counts))
    assert synchrony == pytest.approx(eb.ave_covary2(covariance, energy, 2.5)[1][4], abs=1e-12)
    smooth = [eb.env_smooth(signal, 16, 24000.0) for signal in (x, y)]
    expected, _ = eb.mel_cepstrum_correlation(*smooth, 2.5, 0.0)
    levels = (torch.from_numpy(signal)[None] for signal in smooth)
    correlation = float(fine_structure.envelope_correlation(*levels, counts))
    assert correlation == pytest.approx(expected, abs=1e-12)


def test_motion_keeps_its_unit_where_the_shifted_envelope_is_zero() -> None:
    motion, power = torch.full((3,), 4.0), torch.tensor([0.0, 0.5, 100.0])
    scaled = _scale_motion_to_level(motion, power, torch.tensor([0.0, 0.0, 20.0]), 0.25)
    assert scaled.tolist() == [1.0, 0.0, 8.0]


# -- levels, rates and batches ---------------------------------------------------------------------


def test_full_scale_is_pyclaritys_level1_and_rates_are_exact_by_default() -> None:
    clean, noisy = (signal[0].double() for signal in pair())
    expected = haspi(noisy, clean, N2)
    loud = haspi(10.0 * noisy, 10.0 * clean, N2, full_scale_spl=74.0)
    torch.testing.assert_close(loud, expected, rtol=0, atol=1e-10)
    x, y = (at_rate(signal, 44100) for signal in pair())
    exact, rounded = (
        haspi(y, x, N2, sample_rate=44100, whole_khz=whole) for whole in (False, True)
    )
    assert abs(exact - expected) < abs(rounded - expected)


@pytest.mark.parametrize(  # HASQI and HAAQI add the same noise, and share the steps of a batch
    ("name", "noise"),
    [
        ("haspi", "expected"),
        pytest.param("haspi", "seeded", marks=pytest.mark.slow),
        pytest.param("hasqi", "expected", marks=pytest.mark.slow),
        pytest.param("hasqi", "none", marks=pytest.mark.slow),
        pytest.param("haaqi", "seeded", marks=pytest.mark.slow),
    ],
)
def test_a_batch_equals_its_items(name: str, noise: str) -> None:
    clean, noisy = (signal[:, :11700].double() for signal in pair())
    score, ends, ears = SCORES[name], [11700, 11205], [N2, N3]
    items = [
        score(noisy[i, :end], clean[i, :end], ears[i], noise=noise, seed=1)
        for i, end in enumerate(ends)
    ]
    padded = torch.where(torch.arange(11700) < torch.tensor(ends)[:, None], noisy, 0.7)
    padded.requires_grad_()
    prepared = prepare(name, clean, lengths=ends, ears=ears)
    batch = prepared(padded, noise=noise, seed=1)
    torch.testing.assert_close(batch, torch.stack(items), rtol=0, atol=1e-13)
    (gradient,) = torch.autograd.grad(batch.sum(), padded)
    prepared = prepare(name, clean, lengths=ends, ears=ears, keep=False)
    prepared.func.__self__._groups = [slice(0, 2)]  # as on a GPU, where all items are one batch
    as_on_gpu = prepared(padded, noise=noise, seed=1)
    torch.testing.assert_close(as_on_gpu, batch, rtol=0, atol=1e-13)
    torch.testing.assert_close(torch.autograd.grad(as_on_gpu.sum(), padded)[0], gradient)


@pytest.mark.parametrize("name", mostly_slow(SCORES, ["haspi"]))
def test_references_of_inference_mode_serve_training_and_autocast_has_no_effect(name: str) -> None:
    clean, noisy = (signal[0] for signal in pair())
    with torch.inference_mode():
        prepared = prepare(name, clean)
    output = noisy.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(prepared(output), output)
    assert bool(gradient.any())
    expected = SCORES[name](noisy, clean, N3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(SCORES[name](noisy, clean, N3), expected)


# -- noise -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("ear", "gain"), [(N2, 1.0), (N3, 3.0)])
def test_expected_noise_is_the_mean_over_seeds(ear: Audiogram, gain: float) -> None:
    clean, noisy = (signal[0] for signal in pair())
    prepared, output = HaspiReference(clean), gain * noisy
    scores = [float(prepared.score(output, ear, noise="seeded", seed=s)) for s in range(12)]
    error = max(3.0 * np.std(scores) / 12**0.5, 2e-4)
    assert float(prepared.score(output, ear)) == pytest.approx(np.mean(scores), abs=error)
    assert len(set(scores)) == 12


# -- gradient --------------------------------------------------------------------------------------


def amplify(signal: Tensor, gains_db: Tensor) -> Tensor:
    """Apply a gain at each audiometric frequency, interpolated linearly."""
    spectrum = torch.fft.rfft(signal)
    hz = torch.linspace(0.0, 8000.0, spectrum.shape[-1])
    weights = np.stack([np.interp(hz, hlsim.audiogram.FREQUENCIES, row) for row in np.eye(8)])
    gains = gains_db.to(signal) @ torch.from_numpy(weights).to(signal)
    return torch.fft.irfft(spectrum * 10.0 ** (gains / 20.0), signal.shape[-1])


@pytest.mark.parametrize("name", mostly_slow(SCORES, ["haspi"]))
def test_gradient_equals_finite_differences(name: str) -> None:
    step = 1e-3
    clean, noisy = (signal[0, :11200].double() for signal in pair())
    prepared = prepare(name, clean)
    gains = torch.full((8,), 10.0, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(prepared(amplify(noisy, gains)), gains)
    for band in (1, 5):
        change = step * torch.eye(8, dtype=torch.float64)[band]
        with torch.no_grad():
            ends = [float(prepared(amplify(noisy, gains + sign * change))) for sign in (1, -1)]
        assert float(gradient[band]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.01)


@pytest.mark.parametrize(  # HASQI and HAAQI share the steps that could divide by zero
    ("name", "ear", "noise"),
    [
        ("haspi", N6, "none"),
        pytest.param("hasqi", NH, "none", marks=pytest.mark.slow),  # see test_score_loss.py
        pytest.param("haspi", N6, "expected", marks=pytest.mark.slow),
        pytest.param("hasqi", N6, "expected", marks=pytest.mark.slow),
        pytest.param("haaqi", NH, "expected", marks=pytest.mark.slow),
        pytest.param("haaqi", N6, "none", marks=pytest.mark.slow),
    ],
)
def test_gradient_is_finite(name: str, ear: Audiogram, noise: str) -> None:
    clean = pair()[0][0, :11200]
    gains = {"silence": 0.0, "equal": 1.0, "inaudible": 1e-4, "denormal": 1e-37, "loud": 1e3}
    outputs = {signal: gain * clean for signal, gain in gains.items()}
    outputs["click"] = functional.pad(torch.ones(1), (6000, 5199))
    prepared = prepare(name, clean, ear)
    for signal, output in outputs.items():
        output.requires_grad_()
        score = prepared(output, noise=noise)
        (gradient,) = torch.autograd.grad(score, output)
        assert 0.0 <= float(score.detach()) <= 1.0, signal
        assert bool(gradient.isfinite().all()), signal


# -- properties and errors -------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCORES)
def test_less_noise_is_better(name: str) -> None:
    clean = example_music(16000).float() if name == "haaqi" else pair()[0][0]
    noise = torch.randn(clean.shape) * clean.std()
    prepared = prepare(name, clean, NH)
    scores = [float(prepared(clean + gain * noise)) for gain in (1.0, 0.3, 0.1, 0.0)]
    assert scores == sorted(scores) and scores[-1] > 0.9


def test_a_delay_does_not_count() -> None:
    clean, noisy = (functional.pad(signal[0].double(), (0, 2000)) for signal in pair())
    scores = [float(haspi(noisy.roll(delay), clean, N2)) for delay in (0, 100, 800)]
    assert scores[1] == pytest.approx(scores[2], abs=1e-9)
    assert scores[0] == pytest.approx(scores[2], abs=1e-3)  # the first samples are missing


BAD_ARGUMENTS: list[dict[str, Any]] = [
    {"clean": torch.ones(8000) * 0.01},  # too short
    {"clean": torch.full((16000,), torch.nan)},
    {"clean": 1e-5 * torch.randn(16000)},  # too soft
    {"clean": functional.pad(torch.ones(100), (8000, 8000))},  # a click
    {"output": torch.full((12800,), torch.inf)},
    {"output": torch.zeros(2, 12800)},
    {"output": torch.zeros(12800, device="meta")},
    {"audiogram": torch.full((8,), 130.0)},
    {"audiogram": [N3, N3]},
    {"audiogram": None},
    {"sample_rate": 8000},
    {"full_scale_spl": -1.0},
    {"lengths": 9000},
    {"noise": "loud"},
    {"seed": -1},
]


@pytest.mark.parametrize("name", SCORES)
def test_bad_arguments_raise_value_error(name: str) -> None:
    for change in BAD_ARGUMENTS:
        clean = change.get("clean", pair()[0][0])
        with pytest.raises(ValueError):
            SCORES[name](**{"output": clean, "clean": clean, "audiogram": N3, **change})


def test_speech_at_the_lowest_level_is_not_too_soft() -> None:
    """Rounding may put speech of 20 dB SPL a little below the limit."""
    clean = set_level(pair()[0][0], 20.0 - 1e-4)
    assert 0.0 <= float(haspi(clean, clean, NH)) <= 1.0
    with pytest.raises(ValueError, match=r"19\.9 dB SPL .*; expected 20 dB SPL or more"):
        haspi(0.99 * clean, clean * 0.99, NH)


def test_scores_of_an_item_draw_the_noise_of_the_ear_and_count_it_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seeds = []
    generator = np.random.RandomState

    def count(seed: int | None = None) -> np.random.RandomState:
        seeds.append(seed)
        return generator(seed)

    monkeypatch.setattr(np.random, "RandomState", count)
    clean, output = (signals[0] for signals in pair())
    for score, ear in ((haspi, N3), (hasqi, N3), (hasqi, N4)):
        score(output, clean, ear, noise="seeded", seed=4711)
    assert seeds.count(4711) == 2  # HASPI counts the noise, and both HASQI have the same one.
