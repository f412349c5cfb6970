"""A training takes its steps, resumes, saves the best network, and rejects other settings."""

import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import Dataset

pytest.importorskip("lightning")

from hlsim.checkpoint import read_record
from hlsim.training.callbacks import update_averages
from hlsim.training.data_module import MAX_DEVICES, Batch, BatchData
from hlsim.training.module import TrainingModule, relative_learning_rate
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.trainer import train_network


class Vector(nn.Module):
    """A network whose only parameter is a vector."""

    def __init__(self) -> None:
        super().__init__()
        self.config = SimpleNamespace(to_dict=dict)
        self.values = nn.Parameter(torch.zeros(4))


class NoisyTargets(Dataset[Batch]):
    """Noisy versions of one vector, each a function of its index."""

    def __getitem__(self, index: int) -> Batch:
        assert index % MAX_DEVICES == 0
        generator = torch.Generator().manual_seed(index)
        return {"target": torch.arange(4.0) + 0.5 * torch.randn(4, generator=generator)}


class VectorTraining(TrainingModule):
    """Training of the vector on its targets.

    Args:
        scores: Score of the validation after each step; by default minus the sum of the vector.
        interrupt: "interrupted" in the step after the fifth, "stopped" after the fifth step, or
            "cut off" in the validation after the fourth.
    """

    def __init__(
        self, *, scores: dict[int, float] | None = None, interrupt: str = "", **settings: Any
    ) -> None:
        defaults: dict[str, Any] = {"steps": 9, "validate_every": 2, "learning_rate": 0.1}
        super().__init__(Vector(), SimulatorRecipe(**defaults | settings))
        self.scores = scores
        self.interrupt = interrupt
        self.steps_taken: list[int] = []

    def training_loss(self, batch: Batch) -> Tensor:
        self.steps_taken.append(self.global_step)
        if self.global_step == 5 and self.interrupt == "interrupted":
            raise KeyboardInterrupt
        if self.global_step == 4 and self.interrupt == "stopped":
            self.trainer.should_stop = True
        return (self.network.values - batch["target"]).square().mean()

    def evaluate(self, batch: Batch) -> Tensor:
        if self.global_step == 4 and self.interrupt == "cut off":
            raise KeyboardInterrupt
        total: Tensor = self.network.values.detach().sum()[None]
        return total

    def summarise(self, values: Tensor) -> dict[str, float]:
        total = float(values)
        score = -total if self.scores is None else self.scores[self.global_step]
        return {"score": score, "valid_sum": total}


def run(module: VectorTraining, out: Path, **options: Any) -> Path:
    data = BatchData(NoisyTargets(), [{}])
    settings: dict[str, Any] = {"about": {}, "accelerator": "cpu"}
    average = WeightAveraging(use_buffers=False, multi_avg_fn=partial(update_averages, decay=0.9))
    settings["callbacks"] = [average]
    return train_network(module, data, "vector", out=out, **settings | options)


def last_state(out: Path) -> dict[str, Any]:
    state: dict[str, Any] = torch.load(out / "last.ckpt", weights_only=True)
    return state


def released_step(out: Path) -> int:
    return int(read_record(out / "checkpoint")["about"]["steps"])


def assert_same(first: Any, second: Any) -> None:
    """Assert that two states are equal, bit for bit."""
    if isinstance(first, Tensor):
        assert torch.equal(first, second)
    elif isinstance(first, dict):
        assert first.keys() == second.keys()
        for name in first:
            assert_same(first[name], second[name])
    elif isinstance(first, list):
        assert len(first) == len(second)
        for first_entry, second_entry in zip(first, second, strict=True):
            assert_same(first_entry, second_entry)
    else:
        assert first == second


def test_takes_the_recipes_steps_and_validates_after_the_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = VectorTraining()
    assert run(module, tmp_path / "new" / "out") == tmp_path / "new" / "out" / "checkpoint"
    assert module.steps_taken == list(range(9))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"step {i} of 9" for i in (0, 2, 4, 6, 8, 9)]
    assert "valid_sum" in lines[0]
    assert last_state(tmp_path / "new" / "out")["global_step"] == 9
    assert list((tmp_path / "new" / "out" / "events").glob("events.out.tfevents.*"))


@pytest.mark.parametrize("interrupt", ["interrupted", "stopped", "cut off"])
def test_a_resumed_training_ends_as_an_uninterrupted_one(tmp_path: Path, interrupt: str) -> None:
    """Interruptions are in a step and in a validation; weights and averages are compared."""
    run(VectorTraining(), tmp_path / "whole")
    try:
        run(VectorTraining(interrupt=interrupt), tmp_path / "parts")
    except KeyboardInterrupt:
        assert interrupt != "stopped"
    reached = last_state(tmp_path / "parts")["global_step"]
    assert reached == {"interrupted": 4, "stopped": 5, "cut off": 2}[interrupt]
    resumed = VectorTraining()
    run(resumed, tmp_path / "parts")
    assert resumed.steps_taken == list(range(reached, 9))
    whole, parts = last_state(tmp_path / "whole"), last_state(tmp_path / "parts")
    names = ("state_dict", "current_model_state", "averaging_state", "optimizer_states")
    assert_same([whole[name] for name in names], [parts[name] for name in names])
    assert whole["lr_schedulers"] == parts["lr_schedulers"]
    assert not torch.equal(
        whole["state_dict"]["network.values"], whole["current_model_state"]["network.values"]
    )


def test_a_finished_training_takes_no_further_step(tmp_path: Path) -> None:
    run(VectorTraining(), tmp_path)
    again = VectorTraining()
    run(again, tmp_path)
    assert again.steps_taken == []


def test_time_only_stops(tmp_path: Path) -> None:
    """The time limit includes the time before a resumption."""
    short, later, longer = (VectorTraining(steps=10_000) for _ in range(3))
    run(short, tmp_path, max_minutes=0.01)
    reached = last_state(tmp_path)["global_step"]
    assert 0 < reached < 10_000
    run(later, tmp_path, max_minutes=0.01)
    assert later.steps_taken == []
    run(longer, tmp_path, max_minutes=0.02)
    assert longer.steps_taken[0] == reached


def test_the_learning_rate_rises_over_fifty_steps_and_falls_to_one_percent() -> None:
    rates = [relative_learning_rate(step, 1000) for step in range(1000)]
    assert rates[:3] == pytest.approx([0.02, 0.04, 0.06], abs=1e-4)
    assert max(rates) == rates[49] > 0.99
    assert rates[500] == pytest.approx(0.5)
    assert rates[-1] == 0.01


def test_the_best_validation_is_released(tmp_path: Path) -> None:
    scores = {0: 0.0, 2: 1.0, 4: 3.0, 5: 2.0, 6: 2.0, 8: 2.5, 9: 2.9}
    run(VectorTraining(scores=scores, interrupt="stopped"), tmp_path)
    assert released_step(tmp_path) == 4
    run(VectorTraining(scores=scores), tmp_path)
    assert released_step(tmp_path) == 4


def test_the_first_weights_stay_the_best_until_others_are_better(tmp_path: Path) -> None:
    scores = {0: 2.0, 2: 1.0, 4: 1.5, 5: 1.5, 6: 1.0, 8: 3.0, 9: 2.5}
    run(VectorTraining(scores=scores, interrupt="stopped"), tmp_path)
    assert released_step(tmp_path) == 0
    run(VectorTraining(scores=scores), tmp_path)
    assert released_step(tmp_path) == 8
    assert read_record(tmp_path / "checkpoint")["about"]["start_validation"]["score"] == 2.0


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        ({"seed": 1}, {}),
        ({"steps": 20}, {}),
        ({}, {"about": {"teacher": "another"}}),
    ],
)
def test_another_training_does_not_resume(
    tmp_path: Path, settings: dict[str, Any], options: dict[str, Any]
) -> None:
    run(VectorTraining(interrupt="stopped"), tmp_path)
    before = (tmp_path / "last.ckpt").read_bytes()
    with pytest.raises(ValueError, match=r"differs in (seed|steps|teacher);"):
        run(VectorTraining(**settings), tmp_path, **options)
    assert (tmp_path / "last.ckpt").read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"no state", b"PK\x03\x04"])
def test_a_broken_state_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "last.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match=r"last\.ckpt"):
        run(VectorTraining(), tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        {"devices": 0},
        pytest.param(
            {"accelerator": "gpu"},
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU"),
        ),
    ],
)
def test_an_unusable_device_leaves_no_folder(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        run(VectorTraining(), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_ends_the_training(tmp_path: Path, value: float) -> None:
    class Diverging(VectorTraining):
        def training_loss(self, batch: Batch) -> Tensor:
            loss = super().training_loss(batch)
            return loss * value if self.global_step == 3 else loss

    with pytest.raises(ValueError, match="step 3"):
        run(Diverging(), tmp_path)
    assert last_state(tmp_path)["global_step"] == 2


def test_the_average_forgets_the_initial_weights() -> None:
    """The decay is (1 + n) / (10 + n) after n steps, up to its final value."""
    values, expected = [1.0, 4.0, 2.0, 8.0], 0.0
    for step, value in enumerate(values):
        decay = 0.0 if step == 0 else min(0.2, (1.0 + step) / (10.0 + step))
        expected = decay * expected + (1.0 - decay) * value
    for decay, limit in ((0.2, expected), (0.0, 8.0)):
        average = AveragedModel(Vector(), multi_avg_fn=partial(update_averages, decay=decay))
        for value in values:
            network = Vector()
            nn.init.constant_(network.values, value)
            average.update_parameters(network)
        assert average.module.values.tolist() == pytest.approx([limit] * 4)
