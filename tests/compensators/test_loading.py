"""Compensators are loaded by name and saved in folders."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import (
    CAMFIT,
    NALR,
    NALRP,
    WDRC,
    MappingCompensator,
    load_compensator,
    save_compensator,
    trained_for,
)
from hlsim.audiogram import Audiogram
from hlsim.checkpoint import save_checkpoint
from tests.compensators.aids import EAR, SMALL


def test_aids_without_training_have_names() -> None:
    kinds = {"nalr": NALR, Path("nalr"): NALR, "nalrp": NALRP, "wdrc": WDRC, "camfit": CAMFIT}
    for name, kind in kinds.items():
        aid = load_compensator(name, sample_rate=44100, full_scale_spl=100.0)
        assert type(aid) is kind
        assert (aid.sample_rate, aid.full_scale_spl, aid.training) == (44100, 100.0, False)


def test_a_checkpoint_names_the_ear_that_it_was_trained_for(tmp_path: Path) -> None:
    model = MappingCompensator(config=SMALL)
    records = {"one": {"audiogram": EAR.to_dict()}, "all": {"audiogram": None}, "old": {}}
    for name, record in records.items():
        settings = model.config.to_dict()
        save_checkpoint(tmp_path / name, "mapping-compensator", model, settings, record)
    assert [trained_for(tmp_path / name) for name in records] == [EAR, None, None]
    save_compensator(model, tmp_path / "all", EAR)
    assert trained_for(tmp_path / "all") == EAR
    save_compensator(model, tmp_path / "all", "n3")
    assert trained_for(tmp_path / "all") == Audiogram.standard("N3")
    assert trained_for("nalr") is trained_for("compensator-general") is None


@pytest.mark.parametrize("about", [None, ["N3"], {"audiogram": 5}, {"audiogram": {"hl": [1]}}])
def test_an_ear_that_was_edited_wrongly_is_an_error(tmp_path: Path, about: Any) -> None:
    save_checkpoint(tmp_path, "mapping-compensator", torch.nn.Linear(2, 2), {}, {})
    path = tmp_path / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"about": about}))
    with pytest.raises(ValueError, match=r"as about\.audiogram in config\.json.*correct the file"):
        trained_for(tmp_path)


def test_what_is_no_compensator_raises_value_error(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "other", "neuro-msbg", torch.nn.Linear(2, 2), {}, {})
    calls: list[tuple[Any, ...]] = [
        *((load_compensator, name) for name in (tmp_path / "other", "nobody", 3, None, NALR)),
        *(
            (partial(load_compensator, linked=True), name)
            for name in ("nalr", "compensator-general")
        ),
        (trained_for, "nobody"),
        (save_compensator, NALR(), tmp_path / "nalr"),
    ]
    for call, *arguments in calls:
        with pytest.raises(ValueError):
            call(*arguments)
