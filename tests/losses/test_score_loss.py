"""The loss is 1 minus a score, also in batches with silence and clicks."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.losses.score_loss import SCORES, score_loss
from tests.helpers import mostly_slow

N3 = torch.tensor(Audiogram.standard("N3").thresholds)
TIME = 12000


@pytest.fixture(scope="module")
def clean(speech_dir: Path) -> Tensor:
    """0.75 s of speech at 68 dB SPL. Shape: (1, time)."""
    return read_audio(speech_dir / "valid" / "flite-rms-01.flac")[0][:, 8000 : 8000 + TIME]


@pytest.mark.parametrize("name", mostly_slow(SCORES, ["haspi"]))
def test_inaudible_clean_signals_have_neither_loss_nor_gradient(clean: Tensor, name: str) -> None:
    """The items are speech, silence, soft speech, a click, and a rumble below the threshold."""
    click = torch.zeros_like(clean)
    click[:, 5000] = 0.1
    rumble = 3e-3 * torch.sin(torch.arange(TIME) * (2.0 * torch.pi * 20.0 / 16000)).expand(1, -1)
    references = torch.cat((clean, 0.0 * clean, 1e-4 * clean, click, rumble))
    outputs = (references + 0.001).requires_grad_()
    losses = score_loss(name, outputs, references, N3.expand(5, -1), [TIME] * 5, 16000)
    (slope,) = torch.autograd.grad(losses.sum(), outputs)
    inaudible = slice(1, 5 if name == "haspi" else 4)
    score = SCORES[name](outputs[0], references[0], N3).detach()
    torch.testing.assert_close(losses[0].detach(), 1.0 - score)
    assert not bool(losses[inaudible].any())
    assert bool(losses.isfinite().all()) and bool(slope.isfinite().all())
    assert bool(slope[0].any()) and not bool(slope[inaudible].any())


def test_nan_affects_only_its_item_and_short_items_are_rejected(clean: Tensor) -> None:
    outputs = clean.repeat(2, 1)
    outputs[0, 300] = torch.nan
    arguments = outputs, clean.expand(2, -1), N3.expand(2, -1)
    assert score_loss("haspi", *arguments, [TIME] * 2, 16000).isnan().tolist() == [True, False]
    with pytest.raises(ValueError, match=r"^item 1: clean has an item of 0"):
        score_loss("haspi", *arguments, [TIME, 8000], 16000)
