"""A training takes its steps, resumes, saves the best network, and rejects other settings."""

import math
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

pytest.importorskip("lightning")

from lightning.pytorch.callbacks import EMAWeightAveraging

from hlsim.checkpoint import HubModel, read_record
from hlsim.training.batches import MAX_DEVICES, Batch, BatchData
from hlsim.training.module import TrainingModule, relative_learning_rate
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.trainer import train_network


class Vector(nn.Module, HubModel):
    """A network whose only parameter is a vector."""

    kind = "vector"

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
        factor: Factor of the loss after the third step.
    """

    def __init__(
        self,
        *,
        scores: dict[int, float] | None = None,
        interrupt: str = "",
        factor: float = 1.0,
        **settings: Any,
    ) -> None:
        defaults: dict[str, Any] = {"steps": 9, "validate_every": 2, "learning_rate": 0.1}
        super().__init__(Vector(), SimulatorRecipe(**defaults | settings))
        self.scores = scores
        self.interrupt = interrupt
        self.factor = factor
        self.steps_taken: list[int] = []

    def compute_loss(self, batch: Batch) -> Tensor:
        self.steps_taken.append(self.global_step)
        if self.global_step == 5 and self.interrupt == "interrupted":
            raise KeyboardInterrupt
        if self.global_step == 4 and self.interrupt == "stopped":
            self.trainer.should_stop = True
        error = (self.network.values - batch["target"]).square().mean()
        return error * self.factor if self.global_step == 3 else error

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        if self.global_step == 4 and self.interrupt == "cut off":
            raise KeyboardInterrupt
        self.measured_values.append(self.network.values.detach().sum()[None])

    def summarise(self, values: Tensor) -> dict[str, float]:
        total = float(values)
        score = -total if self.scores is None else self.scores[self.global_step]
        return {"score": score, "valid_sum": total}


def run(module: VectorTraining, out: Path, **options: Any) -> Path:
    data = BatchData(NoisyTargets(), [{}])
    settings: dict[str, Any] = {"about": {}, "accelerator": "cpu"}
    settings["callbacks"] = [EMAWeightAveraging(use_buffers=False, decay=0.9)]
    return train_network(module, data, out=out, **settings | options)


def last_state(out: Path) -> dict[str, Any]:
    state: dict[str, Any] = torch.load(out / "last.ckpt", weights_only=True)
    return state


def saved_step(out: Path) -> int:
    return int(read_record(out / "checkpoint")["about"]["steps"])


def test_takes_the_recipes_steps_and_validates_after_the_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module = VectorTraining()
    assert run(module, tmp_path / "new" / "out") == tmp_path / "new" / "out" / "checkpoint"
    assert module.steps_taken == list(range(9))
    output = capsys.readouterr()
    lines = output.out.splitlines()
    assert [line.split(":")[0] for line in lines] == [f"step {i} of 9" for i in (0, 2, 4, 6, 8, 9)]
    assert "valid_sum" in lines[0]
    assert "0 of 9 steps (0%)\n" in output.err and "9 of 9 steps (100%); loss " in output.err
    assert list((tmp_path / "new" / "out" / "events").glob("events.out.tfevents.*"))
    again = VectorTraining()
    run(again, tmp_path / "new" / "out")
    assert again.steps_taken == []
    assert capsys.readouterr().out == "the training has finished: all 9 steps were taken\n"


@pytest.mark.parametrize(
    ("interrupt", "reached"), [("interrupted", 4), ("stopped", 5), ("cut off", 2)]
)
def test_a_resumed_training_ends_as_an_uninterrupted_one(
    tmp_path: Path, interrupt: str, reached: int
) -> None:
    """Interruptions are in a step and in a validation; weights and averages are compared."""
    run(VectorTraining(), tmp_path / "whole")
    try:
        run(VectorTraining(interrupt=interrupt), tmp_path / "parts")
    except KeyboardInterrupt:
        assert interrupt != "stopped"
    assert last_state(tmp_path / "parts")["global_step"] == reached
    resumed = VectorTraining()
    run(resumed, tmp_path / "parts")
    assert resumed.steps_taken == list(range(reached, 9))
    whole, parts = last_state(tmp_path / "whole"), last_state(tmp_path / "parts")
    weights = ("state_dict", "current_model_state", "averaging_state")
    names = (*weights, "optimizer_states", "lr_schedulers", "best_score")
    for name in names:
        torch.testing.assert_close(whole[name], parts[name], rtol=0, atol=0)
    assert not torch.equal(
        whole["state_dict"]["network.values"], whole["current_model_state"]["network.values"]
    )


def test_a_resumed_training_shows_its_total(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run(VectorTraining(interrupt="stopped"), tmp_path)
    capsys.readouterr()
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    run(VectorTraining(), tmp_path)
    output = capsys.readouterr()
    assert output.out.startswith("the training continues after step 5 of 9\n")
    lines = [line.strip() for line in output.err.split("\r") if "steps" in line]
    assert lines[0].startswith("6 of 9 steps")
    assert any(line.startswith("7 of 9 steps (78%), 0.0 min left") for line in lines)
    assert all(len(line) < 80 for line in lines)


def test_two_trainings_do_not_write_to_one_folder(tmp_path: Path) -> None:
    code = (
        "import signal; from hlsim.files import lock_folder\n"
        f"with lock_folder({str(tmp_path)!r}):\n"
        "    print(flush=True); signal.pause()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            with pytest.raises(ValueError, match="another process is writing to this folder"):
                run(VectorTraining(), tmp_path)
        finally:
            other.kill()
    run(VectorTraining(steps=1), tmp_path)


@pytest.mark.parametrize("file", ["checkpoint", "checkpoint/model.safetensors"])
def test_a_training_without_its_best_network_does_not_continue(tmp_path: Path, file: str) -> None:
    for interrupt in ("stopped", ""):
        run(VectorTraining(interrupt=interrupt), tmp_path)
        lost = (tmp_path / file).rename(tmp_path / "lost")
        with pytest.raises(ValueError, match=f"its best network is lost .* {tmp_path}/checkpoint"):
            run(VectorTraining(), tmp_path)
        lost.rename(tmp_path / file)


def test_the_network_of_another_training_is_not_replaced(tmp_path: Path) -> None:
    run(VectorTraining(scores={0: 0.0, 2: 1.0}, steps=2), tmp_path)
    (tmp_path / "last.ckpt").unlink()
    before = (tmp_path / "checkpoint" / "model.safetensors").read_bytes()
    with pytest.raises(ValueError, match=f"{tmp_path}/checkpoint: the network .* be replaced"):
        run(VectorTraining(seed=1), tmp_path)
    assert (tmp_path / "checkpoint" / "model.safetensors").read_bytes() == before


def test_a_training_that_ended_before_its_first_state_starts_again(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="step 3"):
        run(VectorTraining(factor=math.nan, validate_every=5), tmp_path)
    assert not (tmp_path / "last.ckpt").exists() and saved_step(tmp_path) == 0
    run(VectorTraining(), tmp_path)
    assert saved_step(tmp_path) == 0 and last_state(tmp_path)["global_step"] == 9


def test_a_training_that_ended_while_its_first_state_was_saved_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network of the first validation is saved before the state."""
    scores = {0: 0.0, 2: 1.0}
    with monkeypatch.context() as patch:
        patch.setattr("torch.save", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            run(VectorTraining(scores=scores), tmp_path)
    assert not (tmp_path / "last.ckpt").exists() and saved_step(tmp_path) == 2
    with pytest.raises(ValueError, match=r"2 steps\) would be replaced, .* remove the folder"):
        run(VectorTraining(), tmp_path)


def test_a_training_does_not_resume_with_another_number_of_devices(tmp_path: Path) -> None:
    run(VectorTraining(interrupt="stopped"), tmp_path)
    state = last_state(tmp_path)
    torch.save(state | {"record": state["record"] | {"devices": 2}}, tmp_path / "last.ckpt")
    with pytest.raises(ValueError, match="differs in devices;"):
        run(VectorTraining(), tmp_path)


def test_there_are_not_more_devices_than_batches_of_a_step(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected 64 devices at most.*, got 65"):
        run(VectorTraining(), tmp_path, devices=MAX_DEVICES + 1)


def test_gradients_are_not_accumulated(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="raise batch in the recipe"):
        run(VectorTraining(), tmp_path, accumulate_grad_batches=2)


def test_time_only_stops(tmp_path: Path) -> None:
    """The time limit includes the time before a resumption."""
    short, later, longer = (VectorTraining(steps=10_000) for _ in range(3))
    run(short, tmp_path, max_minutes=0.005)
    reached = last_state(tmp_path)["global_step"]
    assert 0 < reached < 10_000
    run(later, tmp_path, max_minutes=0.005)
    assert later.steps_taken == []
    run(longer, tmp_path, max_minutes=0.01)
    assert longer.steps_taken[0] == reached


def test_the_learning_rate_rises_over_fifty_steps_and_falls_to_one_percent() -> None:
    rates = [relative_learning_rate(step, 1000) for step in range(1000)]
    assert rates[:3] == pytest.approx([0.02, 0.04, 0.06], abs=1e-4)
    assert max(rates) == rates[49] > 0.99
    assert rates[500] == pytest.approx(0.5)
    assert rates[-1] == 0.01


@pytest.mark.parametrize(
    ("scores", "first", "last"),
    [
        ({0: 0.0, 2: 1.0, 4: 3.0, 5: 2.0, 6: 2.0, 8: 2.5, 9: 2.9}, 4, 4),
        ({0: 2.0, 2: 1.0, 4: 1.5, 5: 1.5, 6: 1.0, 8: 3.0, 9: 2.5}, 0, 8),
    ],
)
def test_the_best_validation_is_saved(
    tmp_path: Path, scores: dict[int, float], first: int, last: int
) -> None:
    run(VectorTraining(scores=scores, interrupt="stopped"), tmp_path)
    assert saved_step(tmp_path) == first
    run(VectorTraining(scores=scores), tmp_path)
    assert saved_step(tmp_path) == last
    about = read_record(tmp_path / "checkpoint")["about"]
    assert about["start_validation"]["score"] == scores[0]


def test_another_training_does_not_resume(tmp_path: Path) -> None:
    run(VectorTraining(interrupt="stopped"), tmp_path)
    before = (tmp_path / "last.ckpt").read_bytes()
    for settings, about in (({"seed": 1}, {}), ({"steps": 20}, {}), ({}, {"teacher": "another"})):
        with pytest.raises(ValueError, match=r"differs in (seed|steps|teacher);"):
            run(VectorTraining(**settings), tmp_path, about=about)
    assert (tmp_path / "last.ckpt").read_bytes() == before
    (tmp_path / "last.ckpt").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"last\.ckpt"):
        run(VectorTraining(), tmp_path)


def test_an_unusable_device_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError):
        run(VectorTraining(), tmp_path / "out", devices=0)
    assert not (tmp_path / "out").exists()


def test_a_validation_without_a_score_ends_the_training(tmp_path: Path) -> None:
    scores = {0: 1.0, 2: 2.0, 4: math.nan}
    with pytest.raises(ValueError, match="validation score is NaN at step 4"):
        run(VectorTraining(scores=scores), tmp_path)
    assert saved_step(tmp_path) == 2


@pytest.mark.parametrize("factor", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_ends_the_training(tmp_path: Path, factor: float) -> None:
    with pytest.raises(ValueError, match="step 3"):
        run(VectorTraining(factor=factor), tmp_path)
    assert last_state(tmp_path)["global_step"] == 2


def test_a_state_is_written_beside_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder of temporary files may be on another disk, from which files are copied."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "no such folder"))
    run(VectorTraining(steps=2), tmp_path / "out")
    assert last_state(tmp_path / "out")["global_step"] == 2
