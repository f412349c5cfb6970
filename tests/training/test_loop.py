"""The training loop on a module of one number: time, steps, resuming, what is kept, what is refused."""

import json
import math
import os
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("lightning")

from hlsim.training.batches import DrawnBatches
from hlsim.training.data_module import Batch, BatchData
from hlsim.training.loop import run
from hlsim.training.module import ScheduledModule
from hlsim.training.state import BEST, CHECKPOINT, LAST

EVER = 10**6  # steps, so that the learning rate does not fall within a test


class Draws(DrawnBatches):
    """Random vectors."""

    def __init__(self, seed: int) -> None:
        self.batch, self.seed = 1, seed

    def draw(self, count: int, generator: torch.Generator) -> Batch:
        return {"noise": torch.randn(4, generator=generator)}


class Toy(ScheduledModule):
    """Fits a vector to noisy draws of another; ``scores`` says what the validations tell, by step."""

    def __init__(
        self,
        *,
        steps: int = EVER,
        learning_rate: float = 0.1,
        scores: dict[int, float] | None = None,
        seed: int = 3,
    ) -> None:
        super().__init__(learning_rate, steps)
        self.draws = Draws(seed)
        self.vector = torch.nn.Parameter(torch.zeros(4))
        self.scores = scores
        self.seen: list[int] = []
        self.rates: list[float] = []

    def training_loss(self, batch: Batch) -> Tensor:
        self.seen.append(self.global_step)
        self.rates.append(self.optimizers().param_groups[0]["lr"])  # type: ignore[union-attr]
        target = torch.arange(4.0) + 0.5 * batch["noise"]
        return (self.vector - target).square().mean()

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        return {"valid_sum": self.vector.detach().sum()[None]}

    def figures(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        total = float(values["valid_sum"])
        return {
            "score": self.scores[self.global_step] if self.scores else -total,
            "valid_sum": total,
        }


def go(
    module: Toy, out: Path, max_steps: int | None = 6, **options: Any
) -> tuple[list[dict[str, Any]], list[str]]:
    """Run; what was written and reported."""
    written: list[dict[str, Any]] = []
    lines: list[str] = []

    def write(figures: dict[str, Any]) -> None:
        (out / CHECKPOINT).mkdir(exist_ok=True)
        written.append(figures)

    settings: dict[str, Any] = {
        "recipe": {"a": 1},
        "write": write,
        "validate_every": 2,
        "accelerator": "cpu",
        "report": lines.append,
        "progress": False,
    }
    run(module, BatchData(module.draws, [{}]), out=out, max_steps=max_steps, **(settings | options))
    return written, lines


def test_runs_the_steps_asked_for_and_leaves_state_recipe_and_events(tmp_path: Path) -> None:
    module = Toy()
    _, lines = go(module, tmp_path / "new" / "folder")
    assert module.seen == [0, 1, 2, 3, 4, 5]
    folder = tmp_path / "new" / "folder"
    assert json.loads((folder / "recipe.json").read_text()) == {"a": 1}
    state = torch.load(folder / LAST, weights_only=True)
    assert state["global_step"] == 6
    assert list((folder / "events").glob("events.out.tfevents.*"))
    assert [line.split(",")[0] for line in lines] == ["step 2", "step 4", "step 6", "step 6"]
    assert "valid_sum " in lines[0] and "score" not in lines[0]


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(tmp_path: Path) -> None:
    whole, first, second = Toy(), Toy(), Toy()
    go(whole, tmp_path / "whole", max_steps=9)
    go(first, tmp_path / "parts", max_steps=5)
    go(second, tmp_path / "parts", max_steps=9)
    assert first.seen + second.seen == whole.seen == list(range(9))
    assert torch.equal(second.vector, whole.vector)
    assert first.rates + second.rates == whole.rates


def test_steps_draw_by_seed_and_step_and_not_by_history(tmp_path: Path) -> None:
    one, other = Toy(learning_rate=0.0), Toy(learning_rate=0.0)
    draws: list[list[float]] = [[], []]
    for module, out, kept in ((one, "a", draws[0]), (other, "b", draws[1])):
        loss = module.training_loss

        def keep(batch: Batch, loss: Any = loss, kept: list[float] = kept) -> Tensor:
            value: Tensor = loss(batch)
            kept.append(float(value.detach()))
            return value

        module.training_loss = keep  # type: ignore[method-assign]
        torch.rand(len(out))
        go(module, tmp_path / out, max_steps=3)
    assert draws[0] == draws[1]
    assert len(set(draws[0])) == 3


@pytest.mark.parametrize("seed", [2**62 - 1, -(2**62) + 1])
def test_large_seeds_draw_too(tmp_path: Path, seed: int) -> None:
    module = Toy(seed=seed)
    go(module, tmp_path, max_steps=1)
    assert module.seen == [0]


def test_interruption_goes_on_from_the_last_state(tmp_path: Path) -> None:
    def stop(line: str) -> None:
        if line.startswith("step 4"):
            raise KeyboardInterrupt

    first = Toy()
    with pytest.raises(KeyboardInterrupt):
        go(first, tmp_path, max_steps=20, report=stop)
    assert first.seen == [0, 1, 2, 3]
    second = Toy()
    go(second, tmp_path, max_steps=7)
    assert second.seen[0] in (2, 4) and second.seen[-1] == 6
    whole = Toy()
    go(whole, tmp_path / "whole", max_steps=7)
    assert torch.equal(second.vector, whole.vector)


def test_being_told_to_end_is_no_interruption(tmp_path: Path) -> None:
    def end(line: str) -> None:
        if line.startswith("step 4"):
            os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGINT)  # ignored where the tests run in the background
    with pytest.raises(SystemExit) as ended:
        go(Toy(), tmp_path, max_steps=20, report=end)
    assert ended.value.code == 128 + signal.SIGTERM  # what comes next in a script is not to begin
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_training_in_the_folder_is_refused_until_the_first_is_over(tmp_path: Path) -> None:
    refused = []

    def meanwhile(line: str) -> None:
        if not refused:
            refused.append(line)
            with pytest.raises(ValueError, match="another process is writing there"):
                go(Toy(), tmp_path, max_steps=2)

    go(Toy(), tmp_path, max_steps=4, report=meanwhile)
    assert refused
    second = Toy()
    go(second, tmp_path, max_steps=6)
    assert second.seen == [4, 5]


def test_a_file_of_the_users_in_the_checkpoints_folder_is_told_before_the_training(
    tmp_path: Path,
) -> None:
    (tmp_path / CHECKPOINT).mkdir()
    (tmp_path / CHECKPOINT / "mine.txt").touch()
    module = Toy()
    with pytest.raises(ValueError, match=r"checkpoint: holds something else \(mine.txt\)"):
        go(module, tmp_path, max_steps=2)
    assert not module.seen


def test_another_recipe_in_the_same_folder_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    go(Toy(), tmp_path, max_steps=2)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    module = Toy()
    with pytest.raises(
        ValueError,
        match=r"another recipe \(other a, b; see .*another --out, from its weights with --start .*checkpoint",
    ) as caught:
        go(module, tmp_path, max_steps=4, recipe={"a": 2, "b": None})
    assert str(caught.value).startswith(str(tmp_path))
    assert not module.seen
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_a_state_is_written_beside_its_place_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go(Toy(), tmp_path, max_steps=2)
    before = (tmp_path / LAST).read_bytes()
    replace, made = os.replace, []

    def killed(source: Path, target: Path) -> None:
        if Path(target).name == LAST:
            made.append(Path(source))
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(ValueError, match=r"last\.ckpt: the disk is full"):
        go(Toy(), tmp_path, max_steps=4)
    assert made[0].parent == tmp_path and (tmp_path / LAST).read_bytes() == before
    assert not list(tmp_path.glob("*.part"))


def test_leftovers_of_a_killed_run_go(tmp_path: Path) -> None:
    (tmp_path / f".{LAST}.99.part").write_bytes(b"half")
    (tmp_path / ".checkpoint.old").mkdir()
    (tmp_path / ".checkpoint.abcd1234").mkdir()
    go(Toy(), tmp_path, max_steps=1)
    assert not list(tmp_path.glob(".*")) and (tmp_path / CHECKPOINT).is_dir()


@pytest.mark.parametrize("broken", [b"", b"no state", None, "one byte"])
def test_a_broken_state_is_named(tmp_path: Path, broken: bytes | str | None) -> None:
    go(Toy(), tmp_path, max_steps=2)
    last = tmp_path / LAST
    if broken is None:
        torch.save({}, last)
    elif broken == "one byte":
        state = bytearray(last.read_bytes())
        weight = torch.load(last, weights_only=True)["state_dict"].popitem()[1]
        place = state.index(weight.numpy().tobytes())
        state[place] ^= 1
        last.write_bytes(state)
    else:
        last.write_bytes(broken)
    with pytest.raises(
        ValueError, match="not readable as a state; remove it to start anew"
    ) as caught:
        go(Toy(), tmp_path, max_steps=4)
    assert str(caught.value).startswith(str(last))
    last.unlink()
    go(Toy(), tmp_path, max_steps=2)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"devices": 0}, "cannot train with device cpu, devices 0"),
        ({"strategy": "none"}, "strategy"),
        pytest.param(
            {"accelerator": "gpu"},
            "cannot train with device gpu, .*gpu",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU"),
        ),
    ],
)
def test_where_it_cannot_train_nothing_is_written(
    tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        go(Toy(), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_what_slurm_makes_it_store_belongs_to_the_folder_and_its_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = Toy()
    go(module, tmp_path, max_steps=1)
    assert module.trainer.default_root_dir == str(tmp_path)
    (tmp_path / LAST).rename(tmp_path / "hpc_ckpt_1.ckpt")
    with pytest.raises(ValueError, match="another recipe"):
        go(Toy(), tmp_path, recipe={"a": 2})


def test_the_newest_state_is_gone_on_from(tmp_path: Path) -> None:
    go(Toy(), tmp_path / "whole", max_steps=3)
    go(Toy(), tmp_path / "parts", max_steps=2)
    first, last = tmp_path / "whole" / LAST, tmp_path / "parts" / LAST
    first.rename(last.with_name("hpc_ckpt_1.ckpt"))
    os.utime(last.with_name("hpc_ckpt_1.ckpt"), (last.stat().st_atime, last.stat().st_mtime + 1.0))
    module = Toy()
    go(module, tmp_path / "parts", max_steps=4)
    assert module.seen == [3]
    os.utime(last, (last.stat().st_atime, last.stat().st_mtime + 60.0))
    module = Toy()
    go(module, tmp_path / "parts", max_steps=6)
    assert module.seen == [4, 5]


def test_a_recipe_without_a_state_may_be_replaced(tmp_path: Path) -> None:
    (tmp_path / "recipe.json").write_text("{}")
    go(Toy(), tmp_path, max_steps=2)
    assert json.loads((tmp_path / "recipe.json").read_text()) == {"a": 1}


def test_time_is_limited_and_counted_over_all_parts(tmp_path: Path) -> None:
    options: dict[str, Any] = {"max_steps": None, "max_minutes": 0.01, "validate_every": 1000}
    first, second = Toy(), Toy()
    go(first, tmp_path, **options)
    assert len(first.seen) > 5
    assert (tmp_path / LAST).is_file()
    go(second, tmp_path, **options)
    assert len(second.seen) <= 1


def test_the_minutes_told_are_of_all_parts(tmp_path: Path) -> None:
    go(Toy(), tmp_path, max_steps=2)
    state = torch.load(tmp_path / LAST, weights_only=True)
    state["callbacks"]["Timer"]["time_elapsed"]["train"] = 720.0
    torch.save(state, tmp_path / LAST)
    _, lines = go(Toy(), tmp_path, max_steps=4)
    assert {line.split(":")[0] for line in lines} == {"step 4, 12.0 min"}


def test_learning_rate_rises_over_fifty_steps_and_falls_with_the_steps(tmp_path: Path) -> None:
    module = Toy(learning_rate=0.5, steps=200)
    go(module, tmp_path, max_steps=None, validate_every=100)
    assert len(module.rates) == 200
    assert max(module.rates) == module.rates[49]
    assert module.rates[9] == pytest.approx(0.1, rel=0.01)
    assert module.rates[100] == pytest.approx(0.25)
    assert module.rates[-1] == pytest.approx(0.005)


def test_the_best_validation_is_what_is_written(tmp_path: Path) -> None:
    scores = {2: 1.0, 4: 3.0, 6: 2.0}
    written, _ = go(Toy(scores=scores), tmp_path, max_steps=6)
    assert [(note["steps"], set(note["validation"])) for note in written] == [
        (2, {"valid_sum"}),
        (4, {"valid_sum"}),
    ]
    assert all(note["minutes"] >= 0.0 for note in written)
    # resumed: what was best stays best
    written, _ = go(Toy(scores=scores | {8: 2.9, 10: 3.5}), tmp_path, max_steps=10)
    assert [note["steps"] for note in written] == [10]


def test_weights_begun_with_are_the_best_until_others_are_better(tmp_path: Path) -> None:
    scores = {0: 2.0, 2: 1.0, 4: 3.0, 6: 2.5}
    written, lines = go(Toy(scores=scores), tmp_path, max_steps=2, begun=True)
    assert [(note["steps"], note["minutes"], set(note["validation"])) for note in written] == [
        (0, 0.0, {"valid_sum"})
    ]
    assert [line.split(",")[0] for line in lines] == ["step 0", "step 2", "step 2"]
    written, lines = go(Toy(scores=scores), tmp_path, max_steps=6, begun=True)
    assert [note["steps"] for note in written] == [4]
    assert [line.split(",")[0] for line in lines] == ["step 4", "step 6", "step 6"]


def test_the_best_of_a_killed_run_is_not_replaced_by_a_worse_one(tmp_path: Path) -> None:
    def killed(line: str) -> None:
        if line.startswith("step 4"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        go(Toy(scores={2: 1.0, 4: 3.0}), tmp_path, max_steps=20, report=killed)
    # as after a kill during that validation: the last state is from before its score
    state = torch.load(tmp_path / LAST, weights_only=True)
    for name, kept in state["callbacks"].items():
        if name.startswith("KeepBest"):
            kept["best"] = 1.0
    torch.save(state, tmp_path / LAST)
    written, _ = go(Toy(scores=dict.fromkeys(range(2, 12, 2), 2.0)), tmp_path, max_steps=8)
    assert written == []


@pytest.mark.parametrize("note", ["", "[]", "{}", '{"best": null}', '{"best": "?"}', None])
def test_without_a_note_of_the_best_the_state_knows_it(tmp_path: Path, note: str | None) -> None:
    scores = {2: 3.0, 4: 2.0, 6: 2.5}
    go(Toy(scores=scores), tmp_path, max_steps=2)
    (tmp_path / BEST).unlink()
    if note is not None:
        (tmp_path / BEST).write_text(note)
    assert go(Toy(scores=scores), tmp_path, max_steps=4)[0] == []


def test_a_checkpoint_that_was_removed_is_written_again(tmp_path: Path) -> None:
    scores = {2: 3.0, 4: 2.0, 6: 1.0}
    go(Toy(scores=scores), tmp_path, max_steps=2)
    (tmp_path / CHECKPOINT).rmdir()
    assert [note["steps"] for note in go(Toy(scores=scores), tmp_path, max_steps=6)[0]] == [4]


def test_a_validation_that_was_cut_off_is_made_up_for(tmp_path: Path) -> None:
    class Stopped(Toy):
        def evaluate(self, batch: Batch) -> dict[str, Tensor]:
            if self.global_step == 4:
                raise KeyboardInterrupt
            return super().evaluate(batch)

    scores = {2: 1.0, 4: 9.0, 6: 2.0, 8: 2.0}
    with pytest.raises(KeyboardInterrupt):
        go(Stopped(scores=scores), tmp_path, max_steps=20)
    module = Toy(scores=scores)
    written, lines = go(module, tmp_path, max_steps=8)
    assert [note["steps"] for note in written] == [4]
    assert [line.split(",")[0] for line in lines] == ["step 4", "step 6", "step 8", "step 8"]
    whole = Toy(scores=scores)
    go(whole, tmp_path / "whole", max_steps=8)
    assert torch.equal(module.vector, whole.vector)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_says_so(tmp_path: Path, value: float) -> None:
    class Broken(Toy):
        def training_loss(self, batch: Batch) -> Tensor:
            loss = super().training_loss(batch)
            return loss * value if self.global_step == 3 else loss

    with pytest.raises(ValueError, match=rf"the loss is {value} at step 3; a lower learning rate"):
        go(Broken(), tmp_path)
    assert torch.load(tmp_path / LAST, weights_only=True)["global_step"] == 2


def test_other_modules_say_that_they_are_unfinished() -> None:
    module = ScheduledModule(0.1, 1.0)
    for method in (module.training_loss, module.evaluate, module.figures):
        with pytest.raises(NotImplementedError):
            method({})
    with pytest.raises(NotImplementedError):
        module.released()
