"""MBSTOI against pyclarity, its properties, batches, gradient and errors."""

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.dsp.resample import resample
from hlsim.metrics import mbstoi, mbstoi_score
from tests import pyclarity as reference
from tests.helpers import FIGURES
from tests.pyclarity import PyclarityOutputs

EXAMPLE = FIGURES / "mbstoi_parity.py"

# Directions of speech and noise in degrees, and the SNR in dB.
SCENES = ((0.0, 90.0, -8.0), (-40.0, 30.0, 0.0), (70.0, 160.0, 8.0))

RATES = (16000, 44100, 48000)


@pytest.fixture(scope="module")
def scenes(speech_dir: Path) -> tuple[Tensor, Tensor]:
    """Clean and noisy speech at two ears, 1.5 s at 16 kHz. The noise is a voice or white noise.

    Shape: (scenes, 2, time) twice.
    """
    mix_at_ears = runpy.run_path(str(EXAMPLE))["mix_at_ears"]
    voices = [
        read_audio(speech_dir / "valid" / f"flite-rms-0{i}.flac")[0][0, 8000:32000]
        for i in (1, 2, 3)
    ]
    other, rate = read_audio(speech_dir / "valid" / "espeak-us-annie-01.flac")
    # Single precision, and torch's normal numbers, would depend on the processor.
    white = torch.from_numpy(np.random.default_rng(0).standard_normal((2, 24000)))
    noises = [white[0], resample(other[0].double(), rate, 16000)[4000:28000], white[1]]
    mixed = [
        mix_at_ears(voice.double(), noise, (front, around), snr, 16000)
        for voice, noise, (front, around, snr) in zip(voices, noises, SCENES, strict=True)
    ]
    clean, noisy = torch.stack(mixed).unbind(1)
    return clean, noisy


@pytest.mark.parametrize("rate", RATES)
def test_equals_pyclarity(
    scenes: tuple[Tensor, Tensor], pyclarity: PyclarityOutputs, rate: int
) -> None:
    """Compare with the stored scores, which pyclarity reproduces for one scene at each rate."""
    clean, noisy = (
        torch.from_numpy(resample_poly(signal.numpy(), rate // 100, 160, axis=-1))
        for signal in scenes
    )
    is_one_enough = pyclarity.computed and pyclarity.new_outputs is None
    numbers = [RATES.index(rate)] if is_one_enough else range(len(SCENES))
    expected = []
    for i in numbers:
        arguments = clean[i].numpy(), noisy[i].numpy(), rate
        expected.append(
            float(pyclarity(f"mbstoi, scene {i}, {rate} Hz", reference.mbstoi, *arguments))
        )
    if pyclarity.computed:
        return
    assert max(expected) - min(expected) > 0.1
    assert mbstoi(noisy, clean, sample_rate=rate).tolist() == pytest.approx(expected, abs=1e-9)
    single = mbstoi(noisy.float(), clean.float(), sample_rate=rate)
    assert single.dtype == torch.float32
    assert single.tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "case", ["clean pauses", "one ear pauses", "deaf in one ear", "nothing", "shortest"]
)
def test_equals_pyclarity_of_silence(
    scenes: tuple[Tensor, Tensor], pyclarity: PyclarityOutputs, case: str
) -> None:
    x, y = (signal[1, :, :14400].clone() for signal in scenes)
    if case == "clean pauses":
        x[:, 4000:10000] = 0.0
    elif case == "one ear pauses":
        y[0, 4000:10000] = 0.0
    elif case == "deaf in one ear":
        x[1] = y[1] = 0.0
    elif case == "nothing":
        y = torch.zeros_like(y)
    else:
        x, y = x[:, 4000:10600], y[:, 4000:10600]
    expected = pyclarity(f"mbstoi, {case}", reference.mbstoi, x.numpy(), y.numpy(), 16000)
    assert float(mbstoi(y, x)) == pytest.approx(float(expected), abs=1e-6)


def test_a_batch_equals_its_items_in_any_number_of_segments_at_once(
    scenes: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    clean, noisy = scenes
    items = [mbstoi(y, x) for y, x in zip(noisy, clean, strict=True)]
    expected = torch.stack(items)[:, None]
    assert torch.equal(mbstoi(noisy[:, None], clean[:, None]), expected)
    monkeypatch.setattr(mbstoi_score, "CPU_SEGMENTS", 7)
    scores = mbstoi(noisy[:, None], clean[:, None])
    torch.testing.assert_close(scores, expected, atol=1e-12, rtol=0.0)


def test_items_at_once_as_on_a_gpu_equal_items_and_their_gradients(
    scenes: tuple[Tensor, Tensor],
) -> None:
    clean, noisy = (signal.clone() for signal in scenes)
    clean[1, :, 6000:14000] = 0.0  # items of different lengths without their pauses
    signals = torch.stack([clean, noisy], 1).requires_grad_()
    at_once = mbstoi_score._score_batch(signals, 16000)
    items = [mbstoi_score._score_batch(item[None], 16000) for item in signals]
    torch.testing.assert_close(at_once, torch.cat(items), atol=1e-12, rtol=0.0)
    gradients = [torch.autograd.grad(s.sum(), signals)[0] for s in (at_once, torch.cat(items))]
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-12)


def test_the_level_does_not_count_and_less_noise_is_better(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    torch.testing.assert_close(mbstoi(30.0 * noisy, clean), mbstoi(noisy, clean))
    gains = (3.0, 1.0, 0.3, 0.0)
    scores = torch.stack([mbstoi(clean + gain * (noisy - clean), clean) for gain in gains])
    assert bool((scores.diff(dim=0) > 0.0).all())
    torch.testing.assert_close(scores[-1], torch.ones(3, dtype=torch.float64))


def test_two_ears_score_more_than_either(scenes: tuple[Tensor, Tensor]) -> None:
    """Speech is in front and noise at the right, whose delay and level differ."""
    clean, noisy = (signal[0] for signal in scenes)
    either = [float(mbstoi(noisy[[ear, ear]], clean[[ear, ear]])) for ear in (0, 1)]
    assert float(mbstoi(noisy, clean)) > max(either) + 0.02


def test_gradient_equals_finite_differences(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = (signal[1] for signal in scenes)
    output = noisy.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(mbstoi(output, clean), output)
    direction, step = torch.randn_like(noisy) * noisy.std(), 1e-7
    after, before = (mbstoi(noisy + sign * step * direction, clean) for sign in (1, -1))
    expected = float(after - before) / (2.0 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-3)


def test_silence_has_a_finite_gradient(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    output = noisy.clone()
    output[0] = 0.0
    output[1, 0] = 0.0
    output[2, :, 5000:15000] = 0.0
    score = mbstoi(output.requires_grad_(), clean)
    assert float(score[0].detach().abs()) < 0.02
    (gradient,) = torch.autograd.grad(score.sum(), output)
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize(
    "change",
    [
        {"output": torch.zeros(16000), "clean": torch.zeros(16000)},
        {"clean": torch.ones(3, 16000)},
        {"clean": torch.ones(2, 12000)},
        {"output": torch.full((2, 16000), math.nan)},
        {"clean": torch.zeros(2, 16000)},
        {"output": torch.randn(2, 9), "clean": torch.randn(2, 9)},  # too short
        {"sample_rate": 8000},
    ],
)
def test_bad_arguments_raise_value_error(change: dict[str, Any]) -> None:
    arguments = {"output": torch.randn(2, 16000), "clean": torch.randn(2, 16000)} | change
    with pytest.raises(ValueError):
        mbstoi(**arguments)
