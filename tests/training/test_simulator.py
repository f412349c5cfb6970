"""A simulator learns, from the exact MSBG or from another teacher."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("lightning")

from hlsim import MSBG
from hlsim.checkpoint import read_record
from hlsim.neuro import NeuroMSBG, load_pretrained
from hlsim.simulators import Attenuation
from hlsim.training.batches import Batch, TrainingData, make_data
from hlsim.training.gradients import gradient_error
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.simulator import SimulatorTraining, train_simulator
from tests.helpers import write_ears
from tests.training.gradients import check_gradients

SMALL = SimulatorRecipe(
    model={"structure": "dual-path", "channels": 4, "blocks": 1, "stride": [4, 3]},
    weights={"snr": 1.0, "log_spectrum": 0.5},
    sounds=0.0,
    steps=8,
    batch=2,
    seconds=0.25,
    average=0.9,
    validate_every=4,
    validation_items=8,
)
ALL_CRITERIA = {"snr": 1.0, "log_spectrum": 0.5}
ALL_CRITERIA |= {"magnitude": 0.9, "phase": 0.3, "complex": 0.1, "time": 0.2}


def training_batch(data: TrainingData, recipe: SimulatorRecipe) -> Batch:
    return make_data(data, recipe).training[0]


def test_a_training_leaves_the_best_average_with_its_record(
    data: TrainingData, tmp_path: Path
) -> None:
    recipe = replace(SMALL, learning_rate=0.02)
    folder = train_simulator(data, recipe, out=tmp_path, accelerator="cpu")
    about = read_record(folder)["about"]
    assert about["recipe"]["batch"] == 2 and about["steps"] == 8
    module = SimulatorTraining(recipe, MSBG())
    for name in ("start_validation", "validation"):
        module.on_validation_epoch_start()
        with torch.no_grad():
            for batch in make_data(data, recipe).validation:
                module.validation_step(batch, 0)
        summary = module.summarise(torch.cat(module.measured_values))
        assert about[name] == pytest.approx(summary, abs=1e-3)
        module.network = load_pretrained(folder)
    saved = module.network.state_dict()
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)
    average, current = state["state_dict"], state["current_model_state"]
    assert all(torch.equal(saved[name], average[f"network.{name}"]) for name in saved)
    assert any(not torch.equal(saved[name], current[f"network.{name}"]) for name in saved)


def test_the_median_of_an_even_number_of_items_is_the_mean_of_the_middle_two() -> None:
    summary = SimulatorTraining(SMALL, MSBG()).summarise(torch.tensor([40.0, 10.0, 20.0, 30.0]))
    assert summary["valid_snr_median"] == pytest.approx(25.0)
    assert summary["score"] == pytest.approx(25.0 + 0.5 * summary["valid_snr_worst_tenth"])


def test_a_start_has_the_same_trained_parameters_as_random_weights_of_a_seed() -> None:
    first, again = (SimulatorTraining(SMALL, MSBG()).network.state_dict() for _ in range(2))
    assert all(torch.equal(first[name], again[name]) for name in first)
    started = SimulatorTraining(replace(SMALL, model={}, start="neuro-msbg-cnn"), MSBG()).network
    random = NeuroMSBG(started.config)
    trained, expected = (
        {name for name, parameter in network.named_parameters() if parameter.requires_grad}
        for network in (started, random)
    )
    assert trained == expected and started.training


def test_bfloat16_is_near_and_keeps_gradients_precise(data: TrainingData) -> None:
    losses = []
    for precision in ("float32", "bfloat16"):
        recipe = replace(SMALL, precision=precision)  # type: ignore[arg-type]
        module = SimulatorTraining(recipe, MSBG())
        losses.append(check_gradients(module, training_batch(data, recipe)))
    assert losses[1] == pytest.approx(losses[0], abs=0.02)


def test_all_criteria_train_with_noise_and_measured_ears(
    data: TrainingData, tmp_path: Path
) -> None:
    recipe = replace(SMALL, weights=ALL_CRITERIA)
    ears = write_ears(tmp_path / "ears.csv", "N5")
    sources = replace(data, noise=data.speech, audiograms=ears)
    check_gradients(SimulatorTraining(recipe, MSBG()), training_batch(sources, recipe))


def test_the_cosine_of_gradients_is_one_for_the_teacher_and_trains_a_network(
    data: TrainingData,
) -> None:
    recipe = replace(SMALL, model={"channels": 4}, weights=SimulatorRecipe().weights)
    batch = training_batch(data, recipe)
    signal = batch["signal"].clone().requires_grad_()
    ears = batch["thresholds"]
    perceived = MSBG()(signal, ears)
    for sign, expected in ((1.0, 0.0), (-1.0, 2.0)):
        errors = gradient_error(sign * perceived, signal, batch["clean"], ears, MSBG())
        torch.testing.assert_close(errors, torch.full((2,), expected), atol=1e-4, rtol=0.0)
    check_gradients(SimulatorTraining(recipe, MSBG()), batch)


def test_gradients_alone_are_compared_in_every_step(
    data: TrainingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SimulatorTraining, "global_step", 1)
    recipe = replace(SMALL, model={"channels": 4}, weights={"gradient": 1.0})
    check_gradients(SimulatorTraining(recipe, MSBG()), training_batch(data, recipe))


class Fixed(torch.nn.Module):
    """Teacher without a gradient."""

    def forward(self, waveform: torch.Tensor, ears: torch.Tensor) -> torch.Tensor:
        return 0.5 * waveform.detach()


def test_a_teacher_without_a_gradient_needs_a_recipe_without_the_criterion(
    data: TrainingData,
) -> None:
    recipe = replace(SMALL, model={"channels": 4}, weights={"gradient": 1.0})
    with pytest.raises(ValueError, match=r"differentiable teacher.*set the weight"):
        SimulatorTraining(recipe, Fixed()).compute_loss(training_batch(data, recipe))


@pytest.mark.slow
def test_another_teacher_is_recorded_and_needs_another_folder(
    data: TrainingData, tmp_path: Path
) -> None:
    recipe = replace(SMALL, steps=1)
    teacher = f"{Path(__file__).parents[2]}/examples/training/dead_region.py:DeadRegion"
    folder = train_simulator(data, recipe, out=tmp_path, teacher=teacher, accelerator="cpu")
    assert read_record(folder)["about"]["teacher"] == teacher
    with pytest.raises(
        ValueError, match="differs in teacher, teacher_code_sha256, teacher_sha256;"
    ):
        train_simulator(data, recipe, out=tmp_path)


@pytest.mark.parametrize("missing", ["speech", "noise", "audiograms", "valid_speech"])
def test_missing_data_is_named_before_anything_is_written(
    data: TrainingData, tmp_path: Path, missing: str
) -> None:
    sources: Any = {missing: tmp_path / "nowhere"}
    with pytest.raises(ValueError, match=f"^{tmp_path}/nowhere"):
        train_simulator(replace(data, **sources), SMALL, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_target_is_the_output_of_the_teacher(data: TrainingData) -> None:
    teacher = Attenuation()
    module = SimulatorTraining(SMALL, teacher)
    for network in (teacher, MSBG()):
        module.network = network
        module.validation_step(training_batch(data, SMALL), 0)
    by_teacher, by_another = module.measured_values
    assert float(by_teacher.min()) > 59.0 > float(by_another.max())
