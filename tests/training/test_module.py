"""Training that starts from a checkpoint's weights."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

pytest.importorskip("lightning")

from compensators import MappingCompensator, load_compensator
from hlsim import Audiogram, NeuroMSBG, load_pretrained
from hlsim.cli.main import main
from hlsim.pretrained import CONFIG, checkpoint_digest
from hlsim.training.batches import TrainingData, compensator_data
from hlsim.training.compensator import CompensatorTraining, train_compensator
from hlsim.training.module import exponential_average
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe
from hlsim.training.simulator import SimulatorTraining, train_simulator

SHORT = {
    "batch": 1,
    "seconds": 0.25,
    "validate_every": 1,
    "validation_items": 4,
    "learning_rate": 1e-6,
}
RUN = {"accelerator": "cpu", "progress": False, "report": lambda line: None}


def furthest(one: torch.nn.Module, other: torch.nn.Module) -> float:
    return max(
        float((a - b).abs().max())
        for a, b in zip(one.parameters(), other.parameters(), strict=True)
    )


def test_a_simulator_goes_on_from_a_checkpoint(data: TrainingData, tmp_path: Path) -> None:
    recipe = SimulatorRecipe.from_dict(SHORT | {"start": "neuro-msbg"})
    folder = train_simulator(data, recipe, out=tmp_path, max_steps=1, **RUN)
    start, trained = load_pretrained("neuro-msbg"), load_pretrained(folder)
    assert trained.config == start.config
    assert furthest(trained, start) < 1e-5
    about = json.loads((folder / CONFIG).read_text())["about"]
    assert about["recipe"]["start"] == "neuro-msbg"
    assert about["start_sha256"] == checkpoint_digest("neuro-msbg")
    with pytest.raises(ValueError, match=r"another recipe \(other start, start_sha256"):
        train_simulator(
            data,
            SimulatorRecipe.from_dict(SHORT | {"start": "neuro-msbg-cnn"}),
            out=tmp_path,
            **RUN,
        )


def test_all_is_trained_that_is_trained_from_the_beginning() -> None:
    started = SimulatorTraining(SimulatorRecipe.from_dict(SHORT | {"start": "neuro-msbg"}))
    anew = NeuroMSBG(started.student.config)
    names = [
        {name for name, parameter in model.named_parameters() if parameter.requires_grad}
        for model in (started.student, anew)
    ]
    assert names[0] == names[1] and started.student.training
    assert furthest(started.kept.module, load_pretrained("neuro-msbg")) == 0.0


def test_a_compensator_for_one_ear_starts_from_that_for_all(
    data: TrainingData, tmp_path: Path
) -> None:
    ear = Audiogram.standard("N4")
    recipes = [
        CompensatorRecipe.from_dict(SHORT | {"start": start})
        for start in ("compensator-general", "")
    ]
    valid = compensator_data(data, recipes[0], ear).validation
    general, random = (
        CompensatorTraining(recipe, simulator="msbg").validate(valid) for recipe in recipes
    )
    assert general["valid_loss"] < 0.7 * random["valid_loss"]

    folder = train_compensator(
        data, recipes[0], out=tmp_path, max_steps=1, audiogram=ear, simulator="msbg", **RUN
    )
    trained, start = load_compensator(folder), load_compensator("compensator-general")
    assert isinstance(trained, MappingCompensator) and furthest(trained, start) < 1e-5
    about = json.loads((folder / CONFIG).read_text())["about"]
    assert about["start_valid_loss"] == pytest.approx(general["valid_loss"])
    assert about["start_sha256"] == checkpoint_digest("compensator-general")


def test_what_makes_the_start_worse_is_not_kept(data: TrainingData, tmp_path: Path) -> None:
    recipe = CompensatorRecipe.from_dict(
        SHORT | {"start": "compensator-general", "learning_rate": 10.0}
    )
    folder = train_compensator(data, recipe, out=tmp_path, max_steps=1, simulator="msbg", **RUN)
    assert furthest(load_compensator(folder), load_compensator("compensator-general")) == 0.0
    about = json.loads((folder / CONFIG).read_text())["about"]
    assert about["steps"] == 0
    assert about["validation"]["valid_loss"] == pytest.approx(about["start_valid_loss"], rel=1e-5)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            {"start": "nalr"},
            "start 'nalr' in the recipe is a NALR; allowed: a checkpoint of the recipe's kind",
        ),
        ({"start": "none"}, "no checkpoint 'none'; allowed: nalr, wdrc, compensator-general"),
        ({"start": "neuro-msbg"}, "a checkpoint of kind 'neuro-msbg'; needed here"),
        (
            {"start": "compensator-general", "model": {"channels": 8}},
            r"other settings of the model than the recipe \(channels\); allowed: the same, or no 'model'",
        ),
        ({"start": 3}, "start 3 in the recipe; allowed: text"),
    ],
)
def test_what_cannot_be_started_from(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        CompensatorTraining(CompensatorRecipe.from_dict(SHORT | settings), simulator="msbg")


def test_the_model_may_be_given_again() -> None:
    model = load_compensator("compensator-general").config.to_dict()  # type: ignore[union-attr]
    recipe = CompensatorRecipe.from_dict(SHORT | {"start": "compensator-general", "model": model})
    assert CompensatorTraining(recipe, simulator="msbg").compensator.config.to_dict() == model


def test_the_program_starts_from_a_checkpoint(
    speech_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "".join(f"{name}: {value}\n" for name, value in SHORT.items() if name != "learning_rate")
    (tmp_path / "recipe.yaml").write_text(text)
    command = [
        "--config",
        tmp_path / "recipe.yaml",
        "--speech",
        speech_dir / "train",
        "--out",
        tmp_path,
    ]
    command += ["--max-steps", "1", "--quiet", "--device", "cpu", "--start"]
    arguments = [str(part) for part in ("train-compensator", "--audiogram", "N3", *command)]
    assert main([*arguments, "compensator-general"]) == 0
    about = json.loads((tmp_path / "checkpoint" / CONFIG).read_text())["about"]
    assert about["recipe"]["start"] == "compensator-general"
    assert main([*arguments, "missing"]) == 2
    assert "no checkpoint 'missing'" in capsys.readouterr().err


def follow(decay: float, values: list[float]) -> float:
    model = nn.Linear(1, 1, bias=False)
    nn.init.constant_(model.weight, 5.0)
    average = exponential_average(model, decay)
    for value in values:
        nn.init.constant_(model.weight, value)
        average.update_parameters(model)
    return float(average.module.weight)


def test_is_an_exponential_average_that_forgets_its_start() -> None:
    expected, values = 0.0, [1.0, 4.0, 2.0, 8.0]
    for count, value in enumerate(values):
        weight = 0.0 if count == 0 else min(0.2, (1.0 + count) / (10.0 + count))
        expected = weight * expected + (1.0 - weight) * value
    assert follow(0.2, values) == pytest.approx(expected, rel=1e-6)
    assert follow(0.0, values) == 8.0
    assert follow(0.99, [3.0] * 50) == pytest.approx(3.0)


def test_asks_for_no_gradient_and_leaves_the_model_s() -> None:
    model = nn.Linear(2, 2)
    average = exponential_average(model, 0.9)
    assert not any(parameter.requires_grad for parameter in average.parameters())
    assert all(parameter.requires_grad for parameter in model.parameters())
    assert torch.equal(average(torch.ones(2)), model(torch.ones(2)))
