"""MBSTOI in torch against pyclarity, its laws, its batches, its gradient and its refusals."""

import importlib.util
import math
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor
from torch.nn import functional

from hlsim.audio import read_audio
from hlsim.dsp.resample import resample
from hlsim.metrics import mbstoi
from tests import pyclarity as reference
from tests.pyclarity import PyclarityOutputs

EXAMPLE = Path(__file__).parents[2] / "examples" / "mbstoi_parity.py"

# directions of speech and noise in degrees, and the SNR in dB
SCENES = ((0.0, 90.0, -8.0), (-40.0, 30.0, 0.0), (70.0, 160.0, 8.0))


@pytest.fixture(scope="module")
def scenes(speech_dir: Path) -> tuple[Tensor, Tensor]:
    """Clean and noisy speech at two ears, (scenes, 2, time) at 16 kHz, 1.5 s; the noise is another voice, or hisses."""
    spec = importlib.util.spec_from_file_location(EXAMPLE.stem, EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    voices = [
        read_audio(speech_dir / "valid" / f"flite-rms-0{i}.flac")[0][0, 8000:32000]
        for i in (1, 2, 3)
    ]
    other, rate = read_audio(speech_dir / "valid" / "espeak-us-annie-01.flac")
    hisses = torch.randn(2, 24000, generator=torch.Generator().manual_seed(0))
    noises = [hisses[0], resample(other[0], rate, 16000)[4000:28000], hisses[1]]
    mixed = [
        example.mix_at_ears(voice.double(), noise.double(), (front, around), snr, 16000)
        for voice, noise, (front, around, snr) in zip(voices, noises, SCENES, strict=True)
    ]
    clean, noisy = torch.stack(mixed).unbind(1)
    return clean, noisy


@pytest.mark.parametrize("rate", [16000, 44100, 48000])
def test_equals_pyclarity(
    scenes: tuple[Tensor, Tensor], pyclarity: PyclarityOutputs, rate: int
) -> None:
    clean, noisy = (
        torch.from_numpy(resample_poly(signal.numpy(), rate // 100, 160, axis=-1))
        for signal in scenes
    )
    expected = [
        float(pyclarity(f"mbstoi, scene {i}, {rate} Hz", reference.mbstoi, x, y, rate))
        for i, (x, y) in enumerate(zip(clean.numpy(), noisy.numpy(), strict=True))
    ]
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
    x, y = (signal[1].clone() for signal in scenes)
    if case == "clean pauses":
        x[:, 6000:14000] = 0.0
    elif case == "one ear pauses":
        y[0, 6000:14000] = 0.0
    elif case == "deaf in one ear":
        x[1] = y[1] = 0.0
    elif case == "nothing":
        y = torch.zeros_like(y)
    else:
        x, y = x[:, 4000:10600], y[:, 4000:10600]
    expected = pyclarity(f"mbstoi, {case}", reference.mbstoi, x.numpy(), y.numpy(), 16000)
    assert float(mbstoi(y, x)) == pytest.approx(float(expected), abs=1e-6)


def test_batch_equals_its_items(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    clean, noisy = torch.stack([clean, clean.flip(0)]), torch.stack([noisy, clean.flip(0)])
    scores = mbstoi(noisy, clean)
    assert scores.shape == (2, 3)
    one_by_one = [
        [mbstoi(y, x) for y, x in zip(*rows, strict=True)]
        for rows in zip(noisy, clean, strict=True)
    ]
    torch.testing.assert_close(
        scores, torch.tensor(one_by_one, dtype=torch.float64), atol=1e-12, rtol=0.0
    )
    assert torch.equal(scores, mbstoi(noisy, clean))


def test_padded_items_equal_their_own(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    ends = (24000, 17011, 12000)
    given, reference = (
        torch.stack(
            [
                functional.pad(row[:, :end], (0, 24000 - end))
                for row, end in zip(rows, ends, strict=True)
            ]
        )
        for rows in (noisy, clean)
    )
    alone = [
        float(mbstoi(y[:, :end], x[:, :end])) for y, x, end in zip(noisy, clean, ends, strict=True)
    ]
    assert mbstoi(given, reference, lengths=ends).tolist() == pytest.approx(alone, abs=1e-12)


def test_identical_signals_give_one_at_any_level(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    torch.testing.assert_close(mbstoi(0.1 * clean, clean), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(mbstoi(30.0 * noisy, clean), mbstoi(noisy, clean))


def test_less_noise_scores_more(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    shares = torch.tensor([3.0, 1.0, 0.3, 0.1])
    scores = torch.stack([mbstoi(clean + share * (noisy - clean), clean) for share in shares])
    assert bool((scores.diff(dim=0) > 0.0).all())


def test_two_ears_understand_more_than_either(scenes: tuple[Tensor, Tensor]) -> None:
    """Speech in front, noise at the right: its delay and level differ, so that it can be cancelled."""
    clean, noisy = (signal[0] for signal in scenes)
    either = [float(mbstoi(noisy[[ear, ear]], clean[[ear, ear]])) for ear in (0, 1)]
    assert float(mbstoi(noisy, clean)) > max(either) + 0.02


def test_blocks_do_not_change_the_score(
    scenes: tuple[Tensor, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    clean, noisy = scenes
    whole = mbstoi(noisy, clean)
    monkeypatch.setattr(sys.modules["hlsim.metrics.mbstoi_score"], "CPU_SEGMENTS", 7)
    torch.testing.assert_close(mbstoi(noisy, clean), whole, atol=1e-12, rtol=0.0)


def test_gradient_is_that_of_differences(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = (signal[1] for signal in scenes)
    given = noisy.clone().requires_grad_()
    mbstoi(given, clean).backward()
    assert given.grad is not None
    way = torch.randn_like(noisy) * noisy.std()
    step = 1e-7
    difference = (mbstoi(noisy + step * way, clean) - mbstoi(noisy - step * way, clean)) / (
        2.0 * step
    )
    assert float((given.grad * way).sum()) == pytest.approx(float(difference), rel=1e-3)


def test_steps_along_the_gradient_raise_the_score(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = (signal.float() for signal in scenes)
    given = noisy.clone().requires_grad_()
    optimiser = torch.optim.Adam([given], lr=0.02 * float(noisy.std()))
    scores = []
    for _ in range(5):
        optimiser.zero_grad()
        score = mbstoi(given, clean)
        (1.0 - score).mean().backward()
        assert given.grad is not None and bool(given.grad.isfinite().all())
        optimiser.step()
        scores.append(score.detach())
    assert bool((torch.stack(scores).diff(dim=0) > 0.0).all())


def test_silence_has_a_finite_gradient(scenes: tuple[Tensor, Tensor]) -> None:
    clean, noisy = scenes
    given = noisy.clone()
    given[0] = 0.0
    given[1, 0] = 0.0
    given[2, :, 5000:15000] = 0.0
    given.requires_grad_()
    score = mbstoi(given, clean)
    assert float(score[0].detach().abs()) < 0.02
    score.sum().backward()
    assert given.grad is not None and bool(given.grad.isfinite().all())


@pytest.mark.parametrize(
    "change",
    [
        {"processed": torch.zeros(16000), "clean": torch.zeros(16000)},
        {"clean": torch.ones(3, 16000)},
        {"clean": torch.ones(2, 12000)},
        {"processed": torch.full((2, 16000), math.nan)},
        {"clean": torch.zeros(2, 16000)},
        {"processed": torch.ones(2, 16000, dtype=torch.int16)},
        {"processed": torch.randn(2, 6000), "clean": torch.randn(2, 6000)},  # too short
        {"processed": torch.randn(2, 9), "clean": torch.randn(2, 9)},
        {"sample_rate": 8000},
        {"lengths": [16000, 16000]},
    ],
)
def test_bad_input_raises_value_error(change: dict[str, Any]) -> None:
    arguments = {"processed": torch.randn(2, 16000), "clean": torch.randn(2, 16000)} | change
    with pytest.raises(ValueError):
        mbstoi(**arguments)
