"""A hearing aid is trained by the likelihood of words, by a small random Whisper."""

import doctest
import struct
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG
from hlsim.calibration import level_spl
from hlsim.data.clips import Clips
from tests.helpers import FIGURES, load_figure

WIDTH, TOKENS, PROMPT = 64, 12, [10, 11]
EARS = torch.full((3, 8), 50.0)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FIGURES)
        return load_figure("train_by_recogniser.py")


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    """Random weights of a Whisper with one layer in each half, by CTranslate2's names."""
    shapes: dict[str, tuple[int, ...]] = {
        "encoder/conv1/weight": (WIDTH, 8, 3),
        "encoder/conv1/bias": (WIDTH,),
        "encoder/conv2/weight": (WIDTH, WIDTH, 3),
        "encoder/conv2/bias": (WIDTH,),
        "encoder/position_encodings/encodings": (250, WIDTH),
        "decoder/position_encodings/encodings": (20, WIDTH),
        "decoder/embeddings/weight": (TOKENS, WIDTH),
        "decoder/layer_0/attention/linear_0/weight": (WIDTH, WIDTH),
        "decoder/layer_0/attention/linear_1/weight": (2 * WIDTH, WIDTH),
        "decoder/layer_0/attention/linear_2/weight": (WIDTH, WIDTH),
    }
    norms = ["encoder", "decoder", "decoder/layer_0/attention"]
    for half in ("encoder", "decoder"):
        shapes[f"{half}/layer_0/self_attention/linear_0/weight"] = (3 * WIDTH, WIDTH)
        for name in ("self_attention/linear_1", "ffn/linear_0", "ffn/linear_1"):
            shapes[f"{half}/layer_0/{name}/weight"] = (WIDTH, WIDTH)
        norms += [f"{half}/layer_0/self_attention", f"{half}/layer_0/ffn"]
    for name in norms:
        shapes |= {f"{name}/layer_norm/{part}": (WIDTH,) for part in ("gamma", "beta")}
    generator = torch.Generator().manual_seed(0)
    return {name: 0.2 * torch.randn(shape, generator=generator) for name, shape in shapes.items()}


@pytest.fixture
def likelihood(example: ModuleType, weights: dict[str, Tensor]) -> Any:
    return example.TextLikelihood(weights, torch.rand(8, 201), PROMPT)


def test_examples_of_docstrings(example: ModuleType) -> None:
    result = doctest.testmod(example)
    assert result.attempted >= 1 and result.failed == 0


def test_probabilities_of_all_tokens_add_up_to_1_and_depend_on_the_sound(likelihood: Any) -> None:
    waveform = 0.1 * torch.randn(1, 16000).expand(TOKENS, -1)
    # All beginnings are equal; the last token takes every value.
    texts = torch.tensor([[3, 7, last] for last in range(TOKENS)])
    logs = likelihood(waveform, texts)
    torch.testing.assert_close(logs[:, 2].exp().sum(), torch.tensor(1.0))
    torch.testing.assert_close(logs[:, :2], logs[:1, :2].expand(TOKENS, -1))
    other = likelihood(0.1 * torch.randn(1, 16000), texts[:1])
    assert float((logs[0] - other).abs().max()) > 1e-4


def test_weights_are_read_from_a_file(
    example: ModuleType, weights: dict[str, Tensor], tmp_path: Path
) -> None:
    def text(value: str) -> bytes:
        return struct.pack("<H", len(value) + 1) + value.encode() + b"\0"

    content = struct.pack("<I", 6) + text("WhisperSpec") + struct.pack("<II", 3, len(weights))
    for name, value in weights.items():
        data = value.numpy().astype(np.float16).tobytes()
        shape = struct.pack(f"<B{value.ndim}I", value.ndim, *value.shape)
        content += text(name) + shape + struct.pack("<BI", 4, len(data)) + data
    (tmp_path / "model.bin").write_bytes(content)
    read = example.read_weights(tmp_path / "model.bin")
    torch.testing.assert_close(
        read, {name: value.half().float() for name, value in weights.items()}
    )


@pytest.fixture
def batches(example: ModuleType, speech_dir: Path) -> Iterator[Any]:
    """Batches of four items of a second, with speech as noise."""
    speech = Clips(speech_dir / "train", sample_rate=16000, seconds=1.0)
    generator = torch.Generator().manual_seed(0)
    clips = [
        example.TextClip(clip, torch.arange(2 + number))
        for number, clip in enumerate(speech.draw(3, generator))
    ]
    return example.draw_batches(clips, speech, EARS, 4, generator)


def test_a_batch_has_the_levels_and_ratios_of_training(batches: Iterator[Any]) -> None:
    batch = next(batches)
    levels = level_spl(batch.clean)
    assert bool(((levels >= 57.9) & (levels <= 72.1)).all())
    # The level of speech without its pauses is up to a few dB higher than that with them.
    snrs = levels - level_spl(batch.noisy - batch.clean)
    assert bool(((snrs > -8.0) & (snrs < 10.1)).all())
    assert batch.ears.shape == (4, 8) and batch.tokens.shape[0] == 4


@pytest.mark.slow
def test_terms_know_gain_and_noise(
    example: ModuleType, likelihood: Any, batches: Iterator[Any]
) -> None:
    """An aid that amplifies by 6 dB is 6 dB too loud; its level in noise is equalised."""
    batch = next(batches)._replace(ears=torch.zeros(4, 8))
    simulator = MSBG(sample_rate=16000)

    def terms(aid: Any) -> dict[str, Tensor]:
        return example.loss_terms(aid, lambda x, ears: x, batch, likelihood, simulator)

    plain, loud = terms(lambda x, ears: x), terms(lambda x, ears: 2.0 * x)
    decibels = 20.0 * torch.log10(torch.tensor(2.0))
    for name in ("level", "clean_bands", "clean_loudness"):
        torch.testing.assert_close(loud[name], decibels.expand_as(loud[name]), atol=1e-3, rtol=0)
    torch.testing.assert_close(loud["words"], plain["words"], atol=1e-3, rtol=0)
    torch.testing.assert_close(loud["bands"], plain["bands"], atol=1e-3, rtol=0)
    assert float(plain["bands"].min()) > 1.0
    noise = terms(lambda x, ears: 0.02 * torch.randn_like(x))
    assert float(noise["haspi"]) > 0.5 > float(plain["haspi"])


def test_a_step_trains_both_parts(
    example: ModuleType, likelihood: Any, batches: Iterator[Any], capsys: Any
) -> None:
    aid, before = load_compensator("hearing-aid"), load_compensator("hearing-aid").state_dict()
    example.train(aid, batches, likelihood, steps=1)
    after = aid.state_dict()
    for name in ("correct.0.weight", "enter.weight", "leave.weight"):
        assert not torch.equal(after[name], before[name]), name
    line = capsys.readouterr().out
    # The aid has not changed before the first step, so neither has its level.
    assert line.startswith("step 1: words ") and ", level 0.000, " in line
