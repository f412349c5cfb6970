"""HASPI in torch against pyclarity, its batches, its noise, its gradient and its refusals."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor
from torch.nn import functional

from hlsim.audio import read_audio
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.metrics.ear import clean_speech
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.haspi_score import HaspiReference, haspi, legacy_rng_after_normals
from hlsim.metrics.hasqi_score import HasqiReference, hasqi
from tests import pyclarity as reference
from tests.pyclarity import PyclarityOutputs

N2, N3, N6 = (Audiogram.standard(name) for name in ("N2", "N3", "N6"))


@pytest.fixture(scope="module")
def clean(speech_dir: Path) -> Tensor:
    """Two clips of 0.8 s at 16 kHz, 68 dB SPL, (2, time)."""
    clips = [
        read_audio(speech_dir / "valid" / f"flite-rms-0{i}.flac")[0][0, 8000:20800] for i in (1, 2)
    ]
    return torch.stack(clips)


@pytest.fixture(scope="module")
def noisy(clean: Tensor) -> Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    return clean + 0.5 * noise * clean.square().mean(-1, keepdim=True).sqrt()


def amplified(signal: Tensor, gains_db: Tensor) -> Tensor:
    """With a gain at each audiometric frequency, straight between them."""
    spectrum = torch.fft.rfft(signal)
    hz = torch.linspace(0.0, 8000.0, spectrum.shape[-1])
    points = torch.tensor(FREQUENCIES)
    hats = torch.from_numpy(np.stack([np.interp(hz, points, row) for row in np.eye(8)])).to(signal)
    return torch.fft.irfft(spectrum * 10.0 ** (gains_db.to(signal) @ hats / 20.0), signal.shape[-1])


CASES: dict[str, tuple[Audiogram, int, Callable[[Tensor], Tensor]]] = {
    "noisy": (N2, 16000, lambda signal: signal),
    "amplified, 48 kHz": (N3, 48000, lambda signal: 10.0 * signal),
    "clipped, 44.1 kHz": (
        Audiogram.standard("S2"),
        44100,
        lambda signal: signal.clamp(-0.02, 0.02),
    ),
    "nearly inaudible": (Audiogram.standard("N5"), 24000, lambda signal: 0.3 * signal),
}


def at_rate(signal: Tensor, rate: int) -> Tensor:
    """The first item at another rate. Shape: (items, time) -> (time,), float64."""
    return torch.from_numpy(resample_poly(signal[0].double().numpy(), rate // 100, 160))


@pytest.mark.parametrize("case", CASES)
def test_equals_pyclarity_under_its_seed(
    clean: Tensor, noisy: Tensor, pyclarity: PyclarityOutputs, case: str
) -> None:
    ear, rate, change = CASES[case]
    x, y = at_rate(clean, rate), change(at_rate(noisy, rate))
    key = f"haspi, {case}"
    expected = float(pyclarity(key, reference.haspi, x.numpy(), y.numpy(), ear, rate, 7))
    settings = {"sample_rate": rate, "noise": "seeded", "seed": 7, "whole_khz": True}
    assert float(haspi(y, x, ear, **settings)) == pytest.approx(expected, abs=1e-7)
    single = haspi(y.float(), x.float(), ear, **settings)
    assert float(single) == pytest.approx(expected, abs=1e-4)


def test_full_scale_is_pyclaritys_level1(clean: Tensor, noisy: Tensor) -> None:
    gain = 10.0 ** (20.0 / 20.0)
    soft, loud = (
        haspi(noisy[0].double() * g, clean[0].double() * g, N3, full_scale_spl=spl)
        for g, spl in ((1.0, 94.0), (gain, 74.0))
    )
    assert float(soft) == pytest.approx(float(loud), abs=1e-10)


def test_odd_rates_are_taken_as_they_are_unless_asked(clean: Tensor, noisy: Tensor) -> None:
    x, y = at_rate(clean, 44100), at_rate(noisy, 44100)
    exact, rounded = (
        float(haspi(y, x, N2, sample_rate=44100, whole_khz=whole)) for whole in (False, True)
    )
    low = float(haspi(noisy[0].double(), clean[0].double(), N2))
    assert abs(exact - low) < abs(rounded - low)


def test_a_batch_is_its_items(clean: Tensor, noisy: Tensor) -> None:
    short = [12800, 11345]
    x, y = clean.double(), noisy.double()
    alone = [
        haspi(y[i, :n], x[i, :n], ear)
        for i, (n, ear) in enumerate(zip(short, (N2, N3), strict=True))
    ]
    padded = torch.where(torch.arange(12800) < torch.tensor(short)[:, None], y, 0.7)
    ears = torch.tensor([N2.levels, N3.levels], dtype=torch.float64)
    for given in ([N2, N3], ears):
        together = haspi(padded, x, given, lengths=short)
        torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-13)
    shaped = haspi(padded[:, None], x[:, None], N2, lengths=[[12800], [11345]])
    assert shaped.shape == (2, 1)
    assert float(shaped[0, 0]) == float(alone[0])


@pytest.mark.parametrize("gather", [False, True])
def test_a_gpus_way_through_a_batch_is_a_cpus(
    clean: Tensor, noisy: Tensor, monkeypatch: pytest.MonkeyPatch, gather: bool
) -> None:
    given = noisy.double().requires_grad_()
    settings = {"lengths": [12800, 11345], "noise": "seeded", "seed": [3, 4]}
    one_by_one = haspi(given, clean.double(), [N2, N3], **settings)
    gradient = torch.autograd.grad(one_by_one.sum(), given)[0]
    monkeypatch.setattr(clean_speech.CleanSpeech, "_batch_slices", lambda self, n: [slice(0, n)])
    if gather:
        monkeypatch.setattr(ear_model, "_shift_rows", ear_model._gather_rows)
    together = haspi(given, clean.double(), [N2, N3], **settings)
    torch.testing.assert_close(together, one_by_one, rtol=0, atol=1e-13)
    torch.testing.assert_close(torch.autograd.grad(together.sum(), given)[0], gradient)


def test_a_prepared_reference_is_the_same(clean: Tensor, noisy: Tensor) -> None:
    prepared = HaspiReference(clean, lengths=[12800, 11500])
    for noise in ("expected", "seeded", "none"):
        direct = haspi(noisy, clean, N3, lengths=[12800, 11500], noise=noise, seed=5)
        assert torch.equal(prepared.score(noisy, N3, noise=noise, seed=5), direct)


def test_prepared_references_cut_to_the_common_length(clean: Tensor, noisy: Tensor) -> None:
    quality = HasqiReference(clean, N3, lengths=[12800, 11500])
    intelligibility = HaspiReference(clean, lengths=[12800, 11500])
    longer = functional.pad(noisy, (0, 500))
    for processed, lengths in ((longer, [12800, 11500]), (noisy[:, :12100], [12100, 11500])):
        time = min(processed.shape[-1], clean.shape[-1])
        pair = processed[:, :time], clean[:, :time]
        with pytest.warns(UserWarning, match="cut to the shorter"):
            scores = intelligibility.score(processed, N3), quality.score(processed)
        assert torch.equal(scores[0], haspi(*pair, N3, lengths=lengths))
        assert torch.equal(scores[1], hasqi(*pair, N3, lengths=lengths))
    with pytest.raises(ValueError, match=r"0\.1 s"):
        intelligibility.score(noisy[:, :11000], N3)
    with pytest.raises(ValueError, match=r"0\.1 s"):
        quality.score(noisy[:, :11000])


def test_what_inference_mode_keeps_serves_training(clean: Tensor, noisy: Tensor) -> None:
    with torch.inference_mode():
        haspi(noisy[0], clean[0], N3)
        prepared = HaspiReference(clean[0]).score, HasqiReference(clean[0], N3).score
    given = noisy[0].clone().requires_grad_()
    for value in (haspi(given, clean[0], N3), prepared[0](given, N3), prepared[1](given)):
        (slope,) = torch.autograd.grad(value, given)
        assert bool(slope.any())


def test_autocast_changes_nothing(clean: Tensor, noisy: Tensor) -> None:
    plain = haspi(noisy[0], clean[0], N3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(haspi(noisy[0], clean[0], N3), plain)


# -- noise -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 2, 64, 2 * 10**6])
def test_the_generator_skips_what_is_not_needed(count: int) -> None:
    random = np.random.RandomState(11)
    random.standard_normal(count)
    np.testing.assert_array_equal(
        legacy_rng_after_normals(11, count).standard_normal(5), random.standard_normal(5)
    )


@pytest.mark.parametrize(("ear", "gain"), [(N2, 1.0), (N3, 3.0)])
def test_expected_noise_is_the_mean_over_seeds(
    clean: Tensor, noisy: Tensor, ear: Audiogram, gain: float
) -> None:
    prepared = HaspiReference(clean[0].double())
    given = gain * noisy[0].double()
    scores = [float(prepared.score(given, ear, noise="seeded", seed=seed)) for seed in range(12)]
    error = 3.0 * np.std(scores) / 12**0.5
    assert float(prepared.score(given, ear)) == pytest.approx(np.mean(scores), abs=max(error, 2e-4))
    assert len(set(scores)) == 12


# -- gradient ----------------------------------------------------------------------------------------------------------


def test_gradient_is_that_of_finite_differences(clean: Tensor, noisy: Tensor) -> None:
    prepared = HaspiReference(clean[0].double())
    given = noisy[0].double()
    gains = torch.full((8,), 10.0, dtype=torch.float64, requires_grad=True)
    prepared.score(amplified(given, gains), N3).backward()
    assert gains.grad is not None
    step = 1e-3
    for place in (1, 3, 5):
        with torch.no_grad():
            ends = []
            for sign in (1.0, -1.0):
                moved = gains.detach().clone()
                moved[place] += sign * step
                ends.append(float(prepared.score(amplified(given, moved), N3)))
        assert float(gains.grad[place]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.01)


@pytest.mark.parametrize("noise", ["expected", "none"])
@pytest.mark.parametrize("given", ["silence", "equal", "inaudible", "denormal", "loud", "click"])
def test_gradient_is_finite(clean: Tensor, given: str, noise: str) -> None:
    x = clean[0, :12000]
    click = torch.zeros_like(x)
    click[6000] = 1.0
    signals = {
        "silence": 0.0 * x,
        "equal": x,
        "inaudible": 1e-4 * x,
        "denormal": 1e-37 * x,
        "loud": 1e3 * x,
        "click": click,
    }
    y = signals[given].clone().requires_grad_()
    score = haspi(y, x, N6, noise=noise)
    score.backward()
    assert 0.0 <= float(score.detach()) <= 1.0
    assert y.grad is not None and bool(y.grad.isfinite().all())


def test_ascent_on_gains_raises_the_score(clean: Tensor, noisy: Tensor) -> None:
    prepared = HaspiReference(clean[0])
    gains = torch.zeros(8, requires_grad=True)
    climb = torch.optim.Adam([gains], lr=4.0)
    for _ in range(5):
        climb.zero_grad()
        (-prepared.score(amplified(noisy[0], gains), N3)).backward()
        climb.step()
    after = amplified(noisy[0], gains.detach())
    scores = [float(prepared.score(signal, N3, noise="seeded")) for signal in (noisy[0], after)]
    assert scores[1] > scores[0] + 0.05


# -- properties and refusals -------------------------------------------------------------------------------------------


def test_less_noise_is_better(clean: Tensor) -> None:
    noise = (
        torch.randn(clean.shape[-1], generator=torch.Generator().manual_seed(2)) * clean[0].std()
    )
    scores = [float(haspi(clean[0] + gain * noise, clean[0], N2)) for gain in (3.0, 1.0, 0.3, 0.0)]
    assert scores == sorted(scores)


def test_a_delay_does_not_count(clean: Tensor, noisy: Tensor) -> None:
    x, y = (functional.pad(signal[0].double(), (0, 2000)) for signal in (clean, noisy))
    scores = [float(haspi(y.roll(delay), x, N2)) for delay in (0, 100, 800)]
    assert scores[1] == pytest.approx(scores[2], abs=1e-9)
    assert scores[0] == pytest.approx(
        scores[2], abs=1e-3
    )  # its first samples are not there any more


@pytest.mark.parametrize(
    "change",
    [
        {"clean": torch.ones(8000) * 0.01},  # too short
        {"clean": torch.zeros(16000)},
        {"clean": torch.full((16000,), torch.nan)},
        {"clean": 1e-5 * torch.randn(16000)},  # too soft
        {"processed": torch.full((12800,), torch.inf)},
        {"processed": torch.zeros(2, 12800)},
        {"processed": torch.zeros(12800, dtype=torch.int64)},
        {"audiogram": 3},
        {"audiogram": torch.full((8,), 130.0)},
        {"audiogram": [N3, N3]},
        {"sample_rate": 8000},
        {"full_scale_spl": -1.0},
        {"lengths": 17000},
        {"lengths": 9000},
        {"noise": "loud"},
        {"seed": [1, 2]},
        {"seed": None},
        {"seed": -1},
    ],
)
def test_bad_input_raises_value_error(clean: Tensor, change: dict[str, Any]) -> None:
    signals = {"clean": change.get("clean", clean[0])}
    settings = {"processed": signals["clean"], "audiogram": N3, **signals, **change}
    with pytest.raises(ValueError):
        haspi(**settings)
