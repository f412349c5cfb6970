"""Training from a manifest: on the fly, prepared and resumed, with the wait for data in the log."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from hlsim.audio import write_audio

pytest.importorskip("lightning")

from hlsim.cli.main import main
from hlsim.data.instances import Instance
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.data.writing import Recipe, write_instances
from hlsim.pretrained import load_pretrained
from hlsim.training.batches import PlannedData, PlannedSource
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
def plan(tmp_path: Path) -> Path:
    """Five speakers of noise-like speech, with a validation split."""
    generator = torch.Generator().manual_seed(0)
    for i in range(10):
        folder = tmp_path / "speech" / f"s{i % 5}"
        folder.mkdir(parents=True, exist_ok=True)
        wave = torch.randn(9600, generator=generator) * torch.linspace(0, 0.1, 9600)
        write_audio(folder / f"{i}.wav", wave, 16000)
    prepare(PlanSettings(tmp_path / "speech", valid_share=0.2), tmp_path / "plan", jobs=1)
    return tmp_path / "plan"


def train(source: PlannedSource, out: Path, steps: int) -> list[str]:
    lines: list[str] = []
    train_simulator(
        source,
        SimulatorRecipe.from_dict(TINY),
        out=out,
        max_steps=steps,
        accelerator="cpu",
        progress=False,
        report=lines.append,
    )
    return lines


def state(out: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = torch.load(out / "last.ckpt", weights_only=True)
    return loaded


def test_stopped_and_resumed_is_as_good_as_uninterrupted(plan: Path, tmp_path: Path) -> None:
    source = PlannedSource(plan / "manifest.csv", workers=0)
    lines = train(source, tmp_path / "whole", 8)
    assert [line.split(",")[0] for line in lines] == ["step 4", "step 8", "step 8"]
    assert all(word in lines[0] for word in ("data_wait 0.", "valid_snr_median", "loss"))
    train(source, tmp_path / "parts", 4)
    train(source, tmp_path / "parts", 8)
    first, second = (state(tmp_path / name)["state_dict"] for name in ("whole", "parts"))
    for name, values in first.items():
        torch.testing.assert_close(second[name], values, rtol=1e-4, atol=1e-6)
    load_pretrained(tmp_path / "whole" / "checkpoint")


def test_prepared_instances_train_too(plan: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no instances of this plan"):
        train(PlannedSource(plan, prepared=True), tmp_path / "out", 1)
    assert not (tmp_path / "out").exists()
    write_instances(plan, Recipe(), jobs=1)
    assert len(train(PlannedSource(plan, prepared=True, workers=0), tmp_path / "out", 4)) == 2


def test_prepared_validation_is_on_what_lies_on_disk_and_needs_no_corpus(
    plan: Path, tmp_path: Path
) -> None:
    write_instances(plan, Recipe(alignment="impulse"), jobs=1)
    (tmp_path / "speech").rename(tmp_path / "gone")
    source = PlannedSource(plan, prepared=True, workers=0)
    data = PlannedData(source, SimulatorRecipe.from_dict(TINY))
    (batch,) = data.val_dataloader()
    opened = data.plan
    for place, index in enumerate(opened.indices("valid").tolist()):
        stored = Instance.read(opened.path(index))
        assert stored.impaired is not None
        for cut, whole in (
            (batch["signal"][place], stored.signal),
            (batch["impaired"][place], stored.impaired),
        ):
            assert torch.equal(cut[:9600], whole) and not bool(cut[9600:].any())  # shorter than 2 s
    examples = SimulatorTraining(SimulatorRecipe.from_dict(TINY)).examples(batch)
    assert torch.equal(examples["heard/truth"], batch["impaired"][-1])
    train(source, tmp_path / "out", 1)


def test_another_plan_in_the_same_folder_is_another_training(plan: Path, tmp_path: Path) -> None:
    source = PlannedSource(plan, workers=0)
    train(source, tmp_path / "out", 1)
    prepare(PlanSettings(tmp_path / "speech", valid_share=0.2, seed=1), plan, jobs=1)
    with pytest.raises(ValueError, match=r"another recipe \(other instances; see recipe.json\)"):
        train(source, tmp_path / "out", 2)
    for name in ("structural", "impulse"):
        shutil.rmtree(plan / "instances", ignore_errors=True)
        write_instances(plan, Recipe(name), jobs=1)
        prepared = PlannedSource(plan, prepared=True, workers=0)
        if name == "structural":
            train(prepared, tmp_path / "prepared", 1)
    with pytest.raises(ValueError, match=r"another recipe \(other instances; see recipe.json\)"):
        train(prepared, tmp_path / "prepared", 2)


def test_the_validation_split_is_used(plan: Path) -> None:
    data = PlannedData(PlannedSource(plan, workers=0), SimulatorRecipe.from_dict(TINY))
    assert [(len(batch["signal"]), batch["thresholds"].shape) for batch in data.validation] == [
        (4, (4, 8))
    ]
    opened = data.plan
    expected = torch.stack([opened.thresholds(int(index)) for index in opened.indices("valid")])
    assert torch.equal(data.validation[0]["thresholds"], expected)


def test_a_plan_has_no_sounds_but_its_own(plan: Path) -> None:
    recipe = SimulatorRecipe.from_dict(TINY | {"sounds": 0.1})
    with pytest.raises(ValueError, match=r"sounds 0\.1 in the recipe, with a manifest; allowed: 0"):
        PlannedData(PlannedSource(plan, workers=0), recipe)


def test_a_plan_without_a_validation_split_says_what_it_is_chosen_on(
    plan: Path, tmp_path: Path
) -> None:
    prepare(PlanSettings(tmp_path / "speech"), tmp_path / "other", jobs=1)
    with pytest.warns(UserWarning, match="chosen on 'test'"):
        PlannedData(PlannedSource(tmp_path / "other", workers=0), SimulatorRecipe.from_dict(TINY))


def test_bad_calls(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("batch: 2\n")
    call = ["train-simulator", "--config", str(recipe), "--out", str(tmp_path / "out")]
    for options, said in (
        ([], "nothing to train on; allowed: --speech, a folder, or --manifest"),
        (
            ["--speech", "s", "--root", "r", "--workers", "0"],
            "--root, --workers without --manifest",
        ),
        (["--speech", "s", "--prepared"], "--prepared without --manifest; allowed: with it alone"),
        (["--manifest", str(plan), "--noise", "n"], "--manifest with --noise"),
        (["--manifest", str(tmp_path / "manifest.csv")], "not prepared"),
    ):
        assert main([*call, *options]) == 2
        error = capsys.readouterr().err.strip()
        assert len(error.splitlines()) == 1 and said in error
    prepare(PlanSettings(tmp_path / "speech", rate=22050), tmp_path / "fast", jobs=1)
    assert main([*call, "--manifest", str(tmp_path / "fast")]) == 2
    assert "prepared at 22050 Hz; allowed: 16000" in capsys.readouterr().err
