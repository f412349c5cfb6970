"""Aids as conditions: an aid at the level of another one."""

import pytest
import torch
from torch import Tensor, nn

from hlsim import NALR, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation import Condition, Item, run_study
from hlsim.evaluation.conditions import AtLevelOf
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
