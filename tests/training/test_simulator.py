"""A simulator learns, and its batches match their description."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("lightning")

from hlsim.audio import find_audio, write_audio
from hlsim.calibration import level_spl
from hlsim.checkpoint import read_record
from hlsim.neuro import NeuroMSBG, load_pretrained
from hlsim.training.batches import TrainingData, simulator_data, simulator_validation
from hlsim.training.data_module import Batch, Step
from hlsim.training.module import concatenate
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.simulator import SimulatorTraining, train_simulator
from hlsim.training.teacher import PluginTeacher
from tests.helpers import write_ears
from tests.training.gradients import check_gradients

SMALL = SimulatorRecipe(
    model={"channels": 4, "blocks": 1, "stride": [4, 3], "kernel": [3, 3]},
    steps=8,
    batch=2,
    seconds=0.25,
    average=0.9,
    validate_every=4,
    validation_items=8,
)
ALL_CRITERIA = {"snr": 1.0, "log_spectrum": 0.5}
ALL_CRITERIA |= {"magnitude": 0.9, "phase": 0.3, "complex": 0.1, "time": 0.2}


@pytest.fixture
def rich(speech_dir: Path, tmp_path: Path) -> TrainingData:
    """Speech, noise and a measured ear."""
    noise, ears = tmp_path / "noise", write_ears(tmp_path / "ears.csv", "N5")
    write_audio(noise / "a.wav", 0.1 * torch.randn(1, 20000), 16000)
    valid = speech_dir / "valid"
    return TrainingData(speech_dir / "train", noise, ears, valid_speech=valid)


def training_batch(data: TrainingData, recipe: SimulatorRecipe, step: int = 0) -> Batch:
    batches = simulator_data(data, recipe)
    batch: Batch = batches.on_after_batch_transfer(batches.training[Step(step)], 0)
    return batch


def validation(module: SimulatorTraining, data: TrainingData) -> dict[str, float]:
    """Validate without a Trainer."""
    with torch.no_grad():
        batches = list(simulator_data(data, module.recipe).val_dataloader())
        values = [module.evaluate(batch) for batch in batches]
    return module.summarise(concatenate(values))


def test_a_training_leaves_a_checkpoint_with_its_record(data: TrainingData, tmp_path: Path) -> None:
    folder = train_simulator(data, SMALL, out=tmp_path / "out", accelerator="cpu")
    about = read_record(folder)["about"]
    assert about["recipe"]["batch"] == 2 and about["steps"] in (4, 8)
    module = SimulatorTraining(SMALL)
    for name in ("start_validation", "validation"):
        summary = validation(module, data)
        score = summary.pop("score")
        assert about[name] == pytest.approx(summary, abs=1e-3) and score == pytest.approx(
            summary["valid_snr_median"] + 0.5 * summary["valid_snr_worst_tenth"]
        )
        module.network = load_pretrained(folder)


def test_the_average_is_validated_and_saved(data: TrainingData, tmp_path: Path) -> None:
    folder = train_simulator(data, replace(SMALL, steps=4), out=tmp_path, accelerator="cpu")
    assert read_record(folder)["about"]["steps"] == 4
    released = load_pretrained(folder).state_dict()
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)
    average, current = state["state_dict"], state["current_model_state"]
    assert all(torch.equal(released[name], average[f"network.{name}"]) for name in released)
    assert any(not torch.equal(released[name], current[f"network.{name}"]) for name in released)


@pytest.mark.slow
def test_a_short_training_beats_the_untrained_network(data: TrainingData, tmp_path: Path) -> None:
    recipe = SimulatorRecipe(
        model={"channels": 16, "blocks": 1, "stride": [4, 3], "kernel": [3, 3]},
        steps=60,
        batch=3,
        seconds=0.6,
        learning_rate=3e-3,
        average=0.9,
        validate_every=60,
        validation_items=16,
    )
    about = read_record(train_simulator(data, recipe, out=tmp_path, accelerator="cpu"))["about"]
    gain = about["validation"]["valid_snr_median"] - about["start_validation"]["valid_snr_median"]
    assert gain > 0.5


def test_a_start_has_the_same_trained_parameters_as_random_weights() -> None:
    started = SimulatorTraining(replace(SMALL, model={}, start="neuro-msbg-cnn")).network
    random = NeuroMSBG(started.config)
    trained, expected = (
        {name for name, parameter in network.named_parameters() if parameter.requires_grad}
        for network in (started, random)
    )
    assert trained == expected and started.training


def test_initial_weights_depend_on_the_seed_alone_and_change_no_other_draws() -> None:
    torch.manual_seed(5)
    first = SimulatorTraining(SMALL).network.state_dict()
    draw = torch.rand(())
    torch.manual_seed(5)
    assert torch.equal(draw, torch.rand(()))
    again = SimulatorTraining(SMALL).network.state_dict()
    assert all(torch.equal(first[name], again[name]) for name in first)


def test_bfloat16_is_near_and_keeps_gradients_precise(data: TrainingData) -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        recipe = replace(SMALL, precision=precision)  # type: ignore[arg-type]
        module = SimulatorTraining(recipe)
        losses.append(check_gradients(module, training_batch(data, recipe)))
    assert losses[1] == pytest.approx(losses[0], abs=0.02)


def test_noise_ears_and_all_criteria_train(rich: TrainingData) -> None:
    recipe = replace(SMALL, weights=ALL_CRITERIA)
    check_gradients(SimulatorTraining(recipe), training_batch(rich, recipe))


def test_another_teacher_is_recorded_and_needs_another_folder(
    data: TrainingData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "training")
    settings: dict[str, Any] = {"out": tmp_path, "accelerator": "cpu"}
    recipe = replace(SMALL, steps=1)
    folder = train_simulator(data, recipe, teacher="dead_region:DeadRegion", **settings)
    assert read_record(folder)["about"]["teacher"] == "dead_region:DeadRegion"
    with pytest.raises(ValueError, match="differs in teacher;"):
        train_simulator(data, recipe, **settings)
    targets = []
    for teacher in (None, PluginTeacher("dead_region:DeadRegion")):
        batches = simulator_data(data, SMALL, teacher)
        targets.append(batches.on_after_batch_transfer(batches.training[Step(0)], 0))
    assert torch.equal(targets[0]["signal"], targets[1]["signal"])
    assert not torch.allclose(targets[0]["impaired"], targets[1]["impaired"])


@pytest.mark.parametrize("missing", ["speech", "noise", "audiograms", "valid_speech"])
def test_missing_data_is_named_before_anything_is_written(
    speech_dir: Path, tmp_path: Path, missing: str
) -> None:
    nowhere = tmp_path / "nowhere"
    sources: dict[str, Any] = {"speech": speech_dir / "train"} | {missing: nowhere}
    with pytest.raises(ValueError, match=f"^{nowhere}"):
        train_simulator(TrainingData(**sources), SMALL, out=tmp_path / "out", accelerator="cpu")
    assert not (tmp_path / "out").exists()


def test_files_are_not_used_for_both_training_and_validation(
    speech_dir: Path, tmp_path: Path
) -> None:
    train_dir, valid = speech_dir / "train", speech_dir / "valid"
    link = tmp_path / "link"
    link.symlink_to(train_dir)
    files = [*find_audio(train_dir), *find_audio(valid)]
    sources: tuple[dict[str, Any], ...] = (
        {"speech": speech_dir, "valid_speech": valid},
        {"speech": train_dir, "valid_speech": link},
        {"speech": files, "valid_speech": valid},
        {"speech": train_dir, "noise": speech_dir, "valid_noise": valid},
    )
    for source in sources:
        with pytest.raises(ValueError, match="both training and validation"):
            simulator_data(TrainingData(**source), SMALL)


def test_the_validation_set_is_fixed_and_as_described(rich: TrainingData) -> None:
    recipe = replace(SMALL, validation_items=24)
    batches = simulator_validation(rich, recipe)
    for first, second in zip(batches, simulator_validation(rich, recipe), strict=True):
        assert all(torch.equal(first[name], second[name]) for name in ("signal", "thresholds"))
    signals = torch.cat([batch["signal"] for batch in batches])
    ears = torch.cat([batch["thresholds"] for batch in batches])
    assert signals.shape == (24, 32000) and ears.shape == (24, 8)
    levels = level_spl(signals)
    assert float(levels.min()) >= 50.0 and float(levels.max()) <= 80.0 and float(levels.std()) > 5.0
    again = simulator_validation(rich, replace(recipe, seed=1))
    other = torch.cat([batch["signal"] for batch in again])
    assert not torch.equal(other, signals)


def test_sounds_are_validated_by_their_share(data: TrainingData) -> None:
    speech, both = (
        validation(SimulatorTraining(recipe), data)
        for recipe in (SMALL, replace(SMALL, sounds=0.25))
    )
    median, low = both["valid_sounds_snr_median"], both["valid_sounds_snr_worst_tenth"]
    assert both["valid_snr_median"] == speech["valid_snr_median"]
    assert both["score"] == pytest.approx(0.75 * speech["score"] + 0.25 * (median + 0.5 * low))


@pytest.mark.parametrize(("treated", "low", "high"), [(True, 50.0, 80.0), (False, 85.0, 90.0)])
def test_validation_has_the_levels_of_speech_before_treatment(
    treated: bool, low: float, high: float, rich: TrainingData
) -> None:
    recipe = SimulatorRecipe(sounds=0.1, treated=treated, levels=(85.0, 90.0))
    batches = simulator_validation(rich, recipe)
    levels = torch.cat([level_spl(batch["signal"]) for batch in batches])
    assert len(levels) == 64 and sum("sounds" in batch for batch in batches) == 2
    assert low - 0.01 <= float(levels.min()) < float(levels.max()) <= high + 0.01
