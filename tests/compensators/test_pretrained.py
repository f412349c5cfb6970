"""Compensators by name and folder."""

from pathlib import Path
from typing import Any

import pytest
import torch

from compensators import (
    NALR,
    MappingCompensator,
    MappingConfig,
    load_compensator,
    save_compensator,
    trained_for,
)
from hlsim import Audiogram
from hlsim.pretrained import save_checkpoint


def test_saved_and_loaded_is_the_same_to_the_bit(tmp_path: Path) -> None:
    model = MappingCompensator(MappingConfig(channels=8, blocks=1, start=0.3))
    torch.nn.init.normal_(model.magnitude_decoder.leave.weight, std=0.1)
    save_compensator(MappingCompensator(), tmp_path / "mine")
    save_compensator(model, tmp_path / "mine")  # in place of the other
    loaded = load_compensator(tmp_path / "mine")
    assert isinstance(loaded, MappingCompensator) and loaded.config == model.config
    assert not loaded.training and not any(
        parameter.requires_grad for parameter in loaded.parameters()
    )
    waveform, ear = 0.05 * torch.randn(2, 4000), Audiogram.standard("N4")
    assert torch.equal(loaded(waveform, ear), model.eval()(waveform, ear))


def test_saving_takes_nothing_else_away(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    (tmp_path / "file").write_text("kept")
    save_compensator(MappingCompensator(MappingConfig(channels=4, blocks=1)), tmp_path / "runs")
    (tmp_path / "runs" / "config.json").rename(tmp_path / "runs" / "notes.txt")
    for name in ("runs", "file", "."):
        with pytest.raises(ValueError):
            save_compensator(MappingCompensator(), tmp_path / name)
    assert (tmp_path / "file").read_text() == "kept" and (tmp_path / "runs" / "notes.txt").is_file()
    with pytest.raises(ValueError):
        save_compensator(NALR(), tmp_path / "nalr")  # type: ignore[arg-type]


def test_nalr_by_name() -> None:
    nalr = load_compensator("nalr", sample_rate=44100)
    assert isinstance(nalr, NALR) and nalr.sample_rate == 44100 and not nalr.training
    assert isinstance(load_compensator(Path("nalr")), NALR)


def test_linked_gains_by_name() -> None:
    for name in ("wdrc", "hearing-aid"):
        assert load_compensator(name, linked=True).linked and not load_compensator(name).linked
    for name in ("nalr", "compensator-general"):
        with pytest.raises(ValueError):
            load_compensator(name, linked=True)


def test_the_ear_that_a_compensator_was_trained_for(tmp_path: Path) -> None:
    model, ear = MappingCompensator(MappingConfig(channels=8, blocks=1)), Audiogram.standard("N4")
    for name, about in (
        ("one", {"audiogram": ear.to_dict()}),
        ("all", {"audiogram": None}),
        ("old", {}),
    ):
        save_checkpoint(
            tmp_path / name, "mapping-compensator", model, model.config.to_dict(), about
        )
    assert [trained_for(tmp_path / name) for name in ("one", "all", "old")] == [ear, None, None]
    save_compensator(model, tmp_path / "all", ear)
    assert trained_for(tmp_path / "all") == ear
    assert trained_for("nalr") is trained_for("compensator-general") is None
    with pytest.raises(ValueError):
        trained_for("nobody")


def test_another_kind_of_checkpoint_raises_value_error(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "other", "neuro-msbg", torch.nn.Linear(2, 2), {}, {})
    with pytest.raises(ValueError):
        load_compensator(tmp_path / "other")


@pytest.mark.parametrize("name", ["nobody", 3, None, NALR])
def test_bad_name_raises_value_error(name: Any) -> None:
    with pytest.raises(ValueError):
        load_compensator(name)
