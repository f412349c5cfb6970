"""1 minus a score, in batches that hold silence and clicks."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.metrics.objective import SCORES, score_loss

N3, N4 = (torch.tensor(Audiogram.standard(name).thresholds) for name in ("N3", "N4"))
TIME = 12000


@pytest.fixture(scope="module")
def clean(speech_dir: Path) -> Tensor:
    """0.75 s of speech at 68 dB SPL. Shape: (1, time)."""
    return read_audio(speech_dir / "valid" / "flite-rms-01.flac")[0][:, 8000 : 8000 + TIME]


@pytest.mark.parametrize("name", SCORES)
def test_it_is_1_less_the_score(clean: Tensor, name: str) -> None:
    pair, ears = torch.cat((2.0 * clean, clean + 0.02)), torch.stack((N3, N4))
    found = score_loss(name, pair, clean.expand(2, -1), ears, [TIME, 11500], 16000)
    for item, end in enumerate((TIME, 11500)):
        alone = SCORES[name](pair[item, :end], clean[0, :end], ears[item])
        assert float(found[item]) == pytest.approx(1.0 - float(alone), abs=1e-6)


@pytest.mark.parametrize("name", SCORES)
def test_what_nobody_hears_counts_nothing(clean: Tensor, name: str) -> None:
    """Beside an item that does: silence, faint speech, a click, and a rumble under the threshold of hearing."""
    click = torch.zeros_like(clean)
    click[:, 5000] = 0.1
    rumble = 3e-3 * torch.sin(torch.arange(TIME) * (2.0 * torch.pi * 20.0 / 16000)).expand(1, -1)
    truth = torch.cat((clean, 0.0 * clean, 1e-4 * clean, click, rumble))
    given = truth.expand(5, -1).clone().add_(0.001).requires_grad_()
    found = score_loss(name, given, truth, N3.expand(5, -1), [TIME] * 5, 16000)
    (slope,) = torch.autograd.grad(found.sum(), given)
    unheard = slice(1, 5 if name == "haspi" else 4)
    assert float(found[0].detach()) > 0.0 and not bool(found[unheard].any())
    assert bool(found.isfinite().all()) and bool(slope.isfinite().all())
    assert bool(slope[0].any()) and not bool(slope[unheard].any())


def test_nan_stays_with_its_item(clean: Tensor) -> None:
    given = clean.repeat(2, 1)
    given[0, 300] = torch.nan
    found = score_loss("haspi", given, clean.expand(2, -1), N3.expand(2, -1), [TIME] * 2, 16000)
    assert found.isnan().tolist() == [True, False]


def test_a_short_item_is_refused(clean: Tensor) -> None:
    with pytest.raises(ValueError):
        score_loss("haspi", clean, clean, N3[None], [8000], 16000)
