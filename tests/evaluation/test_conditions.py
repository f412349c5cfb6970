"""Aids as conditions: at the level of another aid, and for several microphones."""

import pytest
import torch
from torch import Tensor, nn

from compensators.directional import DifferentialMicrophone, DirectionalAid
from hlsim import NALR, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation import Condition, Item, run_study
from hlsim.evaluation.conditions import AtLevelOf, OnMicrophones, Unaided
from hlsim.evaluation.measures import LEVELS
from hlsim.shortcuts import example_speech

pytest.importorskip("pandas")


class LongAid(nn.Module):
    """Amplifies, and returns 0.1 s of loud noise after the end of its input."""

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return torch.cat((2.0 * waveform, torch.ones(1600)))


@pytest.mark.filterwarnings("ignore:.*both are cut")
def test_levels_are_equal_where_an_aid_returns_more_than_its_input() -> None:
    speech, ear, aid = example_speech()[:16000], Audiogram.standard("N3"), LongAid()
    conditions = [Condition("long", aid), Condition("NAL-R", AtLevelOf(NALR(), aid))]
    table = run_study([Item("s", speech, speech, ear)], conditions, [LEVELS], jobs=1)
    assert table.level[0] == pytest.approx(float(level_spl(2.0 * speech)), abs=1e-4)
    assert table.level[1] == pytest.approx(table.level[0], abs=1e-4)


def test_aids_get_the_microphones_that_they_take() -> None:
    speech, ear = example_speech()[:4000], Audiogram.standard("N3")
    signals = speech * torch.tensor([[1.0, 0.9], [0.8, 0.7]])[..., None]
    directional = DirectionalAid(DifferentialMicrophone(), NALR())
    both, single = (OnMicrophones(aid, (2, 2)) for aid in (directional, Unaided()))
    assert torch.equal(both(signals, ear), directional(signals, ear)[0])
    assert torch.equal(both(speech, ear), NALR()(speech, ear))
    assert torch.equal(single(signals, ear), signals[0, 0])
    assert torch.equal(single(speech, ear), speech)
