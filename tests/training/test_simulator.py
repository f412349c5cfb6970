"""Training a Neuro-MSBG: recipes, what a run leaves, resuming after any end, and data that cannot be used."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from hlsim.audio import find_audio, write_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl
from hlsim.pretrained import load_pretrained

pytest.importorskip("lightning")

from hlsim.data.foreign import load_teacher
from hlsim.training.batches import (
    TrainingData,
    simulator_data,
    simulator_validation,
)
from hlsim.training.data_module import Batch, Step
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.simulator import SimulatorTraining, train_simulator

TINY = {
    "model": {"channels": 4, "blocks": 1, "stride": [4, 3], "kernel": [3, 3]},
    "batch": 2,
    "seconds": 0.25,
    "validate_every": 4,
    "validation_items": 8,
}


@pytest.fixture
def data(speech_dir: Path) -> TrainingData:
    return TrainingData(speech_dir / "train")


def train(
    data: TrainingData, out: Path, recipe: dict[str, Any] | None = None, **options: Any
) -> list[str]:
    """A few steps; the lines reported."""
    lines: list[str] = []
    settings = {
        "accelerator": "cpu",
        "progress": False,
        "report": lines.append,
    } | options
    folder = train_simulator(
        data, SimulatorRecipe.from_dict(TINY | (recipe or {})), out=out, **settings
    )
    assert folder == out / "checkpoint"
    return lines


def drawn(data: TrainingData, recipe: SimulatorRecipe, step: int = 0) -> Batch:
    """A batch as a training step is given it."""
    batches = simulator_data(data, recipe)
    batch: Batch = batches.on_after_batch_transfer(batches.training[Step(step)], 0)
    return batch


def figures(module: SimulatorTraining, data: TrainingData) -> dict[str, float]:
    return module.validate(simulator_data(data, module.recipe).val_dataloader())


def state(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = torch.load(out / "last.ckpt", weights_only=True)
    return loaded


def test_eight_steps_leave_a_checkpoint_that_loads_and_a_state(
    data: TrainingData, tmp_path: Path
) -> None:
    lines = train(data, tmp_path / "out", max_steps=8)
    assert [line.split(",")[0] for line in lines] == ["step 4", "step 8", "step 8"]
    assert "valid_snr_median" in lines[0] and "valid_snr_worst_tenth" in lines[0]
    assert state(tmp_path / "out")["global_step"] == 8

    model = load_pretrained(tmp_path / "out" / "checkpoint")
    assert model.config.channels == 4
    assert model(0.02 * torch.randn(800), Audiogram.standard("N2")).shape == (800,)
    about = json.loads((tmp_path / "out" / "checkpoint" / "config.json").read_text())["about"]
    assert about["recipe"]["batch"] == 2 and about["steps"] in (4, 8)
    assert set(about["validation"]) >= {"valid_snr_median", "valid_snr_worst_tenth"}
    # what was written is what was validated
    module = SimulatorTraining(SimulatorRecipe.from_dict(TINY))
    module.kept.module = model
    assert figures(module, data)["valid_snr_median"] == pytest.approx(
        about["validation"]["valid_snr_median"], abs=1e-3
    )


@pytest.mark.slow
def test_a_short_training_on_synthetic_speech_beats_the_untrained_network(
    speech_dir: Path, tmp_path: Path
) -> None:
    data = TrainingData(speech_dir / "train", valid_speech=speech_dir / "valid")
    recipe = {
        "model": {"channels": 16, "blocks": 1},
        "batch": 3,
        "seconds": 0.6,
        "learning_rate": 3e-3,
        "average": 0.9,
        "validate_every": 60,
        "validation_items": 16,
    }
    module = SimulatorTraining(SimulatorRecipe.from_dict(TINY | recipe))
    untrained = figures(module, data)["valid_snr_median"]
    train(data, tmp_path / "out", recipe, max_steps=60)
    module.kept.module = load_pretrained(tmp_path / "out" / "checkpoint")
    assert figures(module, data)["valid_snr_median"] > untrained + 0.5


def test_averaged_weights_are_what_is_validated_and_kept(
    data: TrainingData, tmp_path: Path
) -> None:
    train(data, tmp_path / "out", {"average": 0.9}, max_steps=4)
    kept = load_pretrained(tmp_path / "out" / "checkpoint").state_dict()
    states = state(tmp_path / "out")["state_dict"]
    assert all(torch.equal(kept[name], states[f"kept.module.{name}"]) for name in kept)
    assert any(not torch.equal(kept[name], states[f"student.{name}"]) for name in kept)


def test_lower_precision_is_near_and_leaves_the_physics_alone(data: TrainingData) -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        recipe = SimulatorRecipe.from_dict(TINY | {"precision": precision})
        module = SimulatorTraining(recipe)
        loss = module.training_loss(drawn(data, recipe))
        loss.backward()
        assert all(
            p.grad is not None and p.grad.dtype == torch.float32
            for p in module.trained_parameters()
        )
        losses.append(float(loss.detach()))
    assert losses[1] == pytest.approx(losses[0], abs=0.02)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ({"precision": "float16"}, "float32, bfloat16"),
        ({"average": 1.0}, "from 0 to below 1"),
        ({"unit_power": "both"}, "truth, input"),
        ({"seed": 2**62}, "seed 4611686018427387904 in the recipe; allowed: whole numbers between"),
        ({"levels": [80, 60]}, "a lowest and a highest"),
    ],
)
def test_values_of_a_recipe_that_are_not_allowed(setting: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SimulatorRecipe.from_dict(TINY | setting)


def test_stopped_and_resumed_is_as_good_as_uninterrupted(
    data: TrainingData, tmp_path: Path
) -> None:
    train(data, tmp_path / "whole", max_steps=8)
    train(data, tmp_path / "parts", max_steps=5)
    assert state(tmp_path / "parts")["global_step"] == 5
    lines = train(data, tmp_path / "parts", max_steps=8)
    assert [line.split(",")[0] for line in lines] == ["step 8", "step 8"]
    first, second = (state(tmp_path / name)["state_dict"] for name in ("whole", "parts"))
    assert set(first) == set(second)
    for name, values in first.items():
        assert torch.equal(second[name], values), name


KILLED = """
import sys
from pathlib import Path
import torch
from hlsim.training.batches import TrainingData
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.simulator import train_simulator

torch.set_num_threads(1)
train_simulator(
    TrainingData(Path(sys.argv[1])), SimulatorRecipe.from_dict({recipe}), out=sys.argv[2],
    accelerator="cpu", progress=False,
)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on(data: TrainingData, tmp_path: Path) -> None:
    recipe = TINY | {"validate_every": 2}
    out = tmp_path / "out"
    root = str(Path(__file__).parents[2])
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join((root, os.environ.get("PYTHONPATH", "")))
    }
    code = KILLED.format(recipe=recipe)
    child = subprocess.Popen(
        [sys.executable, "-c", code, str(data.speech), str(out)],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        deadline = time.monotonic() + 120.0
        while not (
            (out / "last.ckpt").is_file() and (out / "checkpoint" / "config.json").is_file()
        ):
            assert child.poll() is None, child.stderr.read().decode() if child.stderr else ""
            assert time.monotonic() < deadline
            time.sleep(0.05)
        child.send_signal(signal.SIGKILL)
    finally:
        child.kill()
        child.communicate()
    assert child.returncode == -signal.SIGKILL

    reached = state(out)["global_step"]
    assert reached >= 2
    load_pretrained(out / "checkpoint")
    lines = train(data, out, {"validate_every": 2}, max_steps=reached + 2)
    assert {line.split(",")[0] for line in lines} == {f"step {reached + 2}"}
    assert state(out)["global_step"] == reached + 2


def test_another_recipe_or_other_data_need_another_folder(
    data: TrainingData, tmp_path: Path
) -> None:
    train(data, tmp_path, max_steps=4)
    before = (tmp_path / "last.ckpt").read_bytes()
    other = TrainingData(data.speech.parent / "valid")
    for changed, recipe, options in (
        (data, {"seed": 1}, {}),
        (data, {"model": TINY["model"] | {"channels": 5}}, {}),  # type: ignore[operator]
        (data, {"steps": 100}, {}),
        (other, {}, {}),
    ):
        with pytest.raises(ValueError, match=r"another recipe .*choose another --out"):
            train(changed, tmp_path, recipe, max_steps=8, **options)
    assert (tmp_path / "last.ckpt").read_bytes() == before


@pytest.mark.parametrize(
    ("recipe", "said"),
    [
        ({"batch": 0}, "counts from 1 up"),
        ({"learning_rate": -1.0}, "learning_rate above 0"),
        (
            {"epochs": 3},
            "unknown settings epochs in the recipe; allowed: model, start, steps, batch, seconds",
        ),
        (
            {"weights": {"loudness": 1.0}},
            "unknown criteria loudness in the recipe; allowed: complex, log_spectrum",
        ),
    ],
)
def test_unknown_names_in_a_recipe(recipe: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SimulatorRecipe.from_dict(recipe)


def test_another_teacher_is_told_and_needs_another_folder(
    data: TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "training")
    train(data, tmp_path / "out", max_steps=1, teacher="dead_region:DeadRegion")
    about = json.loads((tmp_path / "out" / "checkpoint" / "config.json").read_text())["about"]
    assert about["teacher"].startswith("dead_region:DeadRegion (sha256 ")
    with pytest.raises(ValueError, match=r"another recipe \(other teacher"):
        train(data, tmp_path / "out", max_steps=2)
    train(data, tmp_path / "out", max_steps=2, teacher="dead_region:DeadRegion")
    heard = []
    for teacher in (None, load_teacher("dead_region:DeadRegion")):
        batches = simulator_data(data, SimulatorRecipe.from_dict(TINY), teacher)
        heard.append(batches.on_after_batch_transfer(batches.training[Step(0)], 0))
    assert torch.equal(heard[0]["signal"], heard[1]["signal"])
    assert not torch.allclose(heard[0]["impaired"], heard[1]["impaired"])


def test_unknown_settings_of_the_network(data: TrainingData, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown network settings layers; allowed: fft, window"):
        train(data, tmp_path / "out", {"model": {"layers": 3}})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("missing", ["speech", "noise", "audiograms", "valid_speech"])
def test_missing_data_is_named_before_anything_is_written(
    speech_dir: Path, tmp_path: Path, missing: str
) -> None:
    nowhere = tmp_path / "nowhere"
    given = {"speech": speech_dir / "train"} | {missing: nowhere}
    with pytest.raises(ValueError, match=r"no such folder|cannot read audiograms") as caught:
        train(TrainingData(**given), tmp_path / "out", max_steps=1)
    assert str(caught.value).startswith(str(nowhere))
    assert not (tmp_path / "out").exists()


def test_files_trained_on_are_none_to_validate_on(speech_dir: Path, tmp_path: Path) -> None:
    train_dir, valid = speech_dir / "train", speech_dir / "valid"
    link = tmp_path / "link"
    link.symlink_to(train_dir)
    files = [*find_audio(train_dir), *find_audio(valid)]
    for name, given in (
        ("speech", {"speech": speech_dir, "valid_speech": valid}),
        ("speech", {"speech": train_dir, "valid_speech": link}),
        ("speech", {"speech": files, "valid_speech": valid}),
        ("noise", {"speech": train_dir, "noise": speech_dir, "valid_noise": valid}),
    ):
        data = TrainingData(**given)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=rf"^\d+ files of the {name} to validate on are also"):
            simulator_data(data, SimulatorRecipe.from_dict(TINY))


@pytest.fixture
def rich(speech_dir: Path, tmp_path: Path) -> TrainingData:
    """Speech, noise and measured ears."""
    write_audio(tmp_path / "noise" / "a.wav", torch.randn(1, 20000), 16000) if (
        tmp_path / "noise"
    ).mkdir() else None
    write_audio(tmp_path / "noise" / "a.wav", 0.1 * torch.randn(1, 20000), 16000)
    row = Audiogram.standard("N5").to_row()
    (tmp_path / "ears.csv").write_text(",".join(row) + "\n" + ",".join(row.values()) + "\n")
    return TrainingData(
        speech_dir / "train",
        tmp_path / "noise",
        tmp_path / "ears.csv",
        valid_speech=speech_dir / "valid",
    )


def test_noise_ears_and_all_criteria_train(rich: TrainingData) -> None:
    weights = {
        "snr": 1.0,
        "log_spectrum": 0.5,
        "magnitude": 0.9,
        "phase": 0.3,
        "complex": 0.1,
        "time": 0.2,
    }
    recipe = SimulatorRecipe.from_dict(TINY | {"weights": weights})
    module = SimulatorTraining(recipe)
    loss = module.training_loss(drawn(rich, recipe))
    assert bool(torch.isfinite(loss))
    loss.backward()
    assert all(
        p.grad is not None and bool(torch.isfinite(p.grad).all())
        for p in module.trained_parameters()
    )
    assert {id(p) for p in module.trained_parameters()} == {
        id(p) for p in module.parameters() if p.requires_grad
    }
    first, again = (module.training_loss(drawn(rich, recipe, 1)) for _ in range(2))
    assert torch.equal(first, again)


def test_the_validation_set_is_fixed_and_as_described(rich: TrainingData) -> None:
    recipe = SimulatorRecipe.from_dict(TINY | {"validation_items": 24})
    batches = simulator_validation(rich, recipe)
    torch.rand(3)
    for one, same in zip(batches, simulator_validation(rich, recipe), strict=True):
        assert all(torch.equal(one[name], same[name]) for name in ("signal", "thresholds"))
    signals = torch.cat([batch["signal"] for batch in batches])
    ears = torch.cat([batch["thresholds"] for batch in batches])
    assert signals.shape == (24, 32000) and ears.shape == (24, 8)
    levels = level_spl(signals)
    assert float(levels.min()) >= 50.0 and float(levels.max()) <= 80.0 and float(levels.std()) > 5.0
    again = simulator_validation(rich, SimulatorRecipe(validation_items=24, seed=1))
    other = torch.cat([batch["signal"] for batch in again])
    assert not torch.equal(other, signals)


def test_sounds_take_the_place_of_a_share_of_the_clips(data: TrainingData) -> None:
    def clips(sounds: float) -> torch.Tensor:
        recipe = TINY | {"batch": 40, "sounds": sounds, "treated": False}
        return simulator_data(data, SimulatorRecipe.from_dict(recipe)).training[Step(0)]["signal"]

    def clicks(signals: torch.Tensor) -> int:
        return int(((signals != 0.0).sum(-1) <= 8).sum())  # half of the sounds

    assert clicks(clips(0.0)) == 0 and clicks(clips(1.0)) == 20 and 4 <= clicks(clips(0.5)) <= 16


def test_sounds_are_validated_by_their_share(data: TrainingData) -> None:
    def of_share(sounds: float) -> dict[str, float]:
        recipe = SimulatorRecipe.from_dict(TINY | {"sounds": sounds})
        return figures(SimulatorTraining(recipe), data)

    speech, both = of_share(0.0), of_share(0.25)
    median, low = both["valid_sounds_snr_median"], both["valid_sounds_snr_worst_tenth"]
    assert set(speech) == {"score", "valid_snr_median", "valid_snr_worst_tenth"}
    assert all(both[name] == speech[name] for name in speech if name != "score")
    assert both["score"] == pytest.approx(0.75 * speech["score"] + 0.25 * (median + 0.5 * low))
    assert low < median != speech["valid_snr_median"]


@pytest.mark.parametrize(("treated", "low", "high"), [(True, 50.0, 80.0), (False, 85.0, 90.0)])
def test_validation_has_the_levels_of_speech_before_treatment(
    treated: bool, low: float, high: float, rich: TrainingData
) -> None:
    recipe = SimulatorRecipe(sounds=0.1, treated=treated, levels=(85.0, 90.0))
    batches = simulator_validation(rich, recipe)
    levels = torch.cat([level_spl(batch["signal"]) for batch in batches])
    assert len(levels) == 64 and sum("sounds" in batch for batch in batches) == 2
    assert low - 0.01 <= float(levels.min()) < float(levels.max()) <= high + 0.01


@pytest.mark.parametrize("sounds", [-0.1, 1.1])
def test_shares_that_are_none(sounds: float) -> None:
    with pytest.raises(ValueError, match=r"sounds .* in the recipe; allowed: 0 to 1"):
        SimulatorRecipe(sounds=sounds)
