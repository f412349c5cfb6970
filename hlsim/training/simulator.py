"""Training a Neuro-MSBG on what the exact MSBG, or another teacher, says is heard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import torch
from torch import Tensor

from hlsim.losses.paper import paper_parts, weighted_sum
from hlsim.losses.waveform import log_spectral_distance_db, noise_to_signal_db
from hlsim.neuro import NeuroConfig, NeuroMSBG
from hlsim.pretrained import SIMULATOR, load_pretrained
from hlsim.training.batches import TrainingData, simulator_data
from hlsim.training.data_module import Batch
from hlsim.training.loop import RunOptions, train_network
from hlsim.training.module import ScheduledModule, exponential_average, initial_network
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.teacher import find_teacher, name_of


class SimulatorTraining(ScheduledModule):
    """Teaches the network what is heard, ``impaired`` in a batch; the average of its weights is validated and kept."""

    def __init__(self, recipe: SimulatorRecipe) -> None:
        super().__init__(recipe.learning_rate, recipe.steps)
        torch.manual_seed(recipe.seed)
        self.recipe = recipe
        self.student = initial_network(
            recipe.start, recipe.model, NeuroConfig, NeuroMSBG, load_pretrained
        )
        self.student.autocast_dtype = None if recipe.precision == "float32" else torch.bfloat16
        self.kept = exponential_average(self.student, recipe.average)

    def training_loss(self, batch: Batch) -> Tensor:
        signal, target = batch["signal"], batch["impaired"]
        heard = self.student(signal, batch["thresholds"])
        unit = target if self.recipe.unit_power == "truth" else signal
        scale = unit.square().mean(-1, keepdim=True).add(1e-18).rsqrt()
        target, heard = target * scale, heard * scale
        weights = self.recipe.weights
        parts = {"snr": noise_to_signal_db(heard, target) / 10.0}
        self.log("snr", -10.0 * parts["snr"].mean(), prog_bar=True)
        if weights.get("log_spectrum"):
            parts["log_spectrum"] = log_spectral_distance_db(heard, target) / 10.0
        if set(weights) - {"snr", "log_spectrum"}:
            parts |= paper_parts(heard, target)
        return weighted_sum(parts, weights).mean()

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """SNR in dB of each item."""
        heard = self.kept.module(batch["signal"], batch["thresholds"])
        name = "valid_sounds_snr" if "sounds" in batch else "valid_snr"
        return {name: -noise_to_signal_db(heard, batch["impaired"])}

    def figures(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Median and worst tenth of the SNR over the validation items, and of sounds where it trains on them.

        They score by their share of the training.
        """
        figures: dict[str, float] = {}
        score = 0.0
        for name, snr in values.items():
            median, low = float(snr.median()), float(snr.quantile(0.1))
            figures |= {f"{name}_median": median, f"{name}_worst_tenth": low}
            share = self.recipe.sounds if name == "valid_sounds_snr" else 1.0 - self.recipe.sounds
            score += share * (median + 0.5 * low)
        return {"score": score, **figures}

    def examples(self, batch: Batch) -> dict[str, Tensor]:
        heard = self.kept.module(batch["signal"][-1:], batch["thresholds"][-1:])
        signal, target = batch["signal"][-1], batch["impaired"][-1]
        return {"given": signal, "heard/truth": target, "heard/network": heard[0]}

    def released(self) -> Any:
        return self.kept.module

    def on_train_batch_end(self, *arguments: Any) -> None:
        self.kept.update_parameters(self.student)


def train_simulator(
    data: TrainingData,
    recipe: SimulatorRecipe,
    *,
    out: str | Path,
    teacher: str = "msbg",
    **options: Unpack[RunOptions],
) -> Path:
    """Train, resume, and keep the best checkpoint.

    Args:
        data: speech, noise and ears to draw batches from.
        teacher: ``"msbg"``, the exact one, ``"pyclarity"``'s, or anyone's simulator, ``package.module:name``, as
            ``hlsim.data.foreign.load_teacher`` takes it.

    Returns: the folder that ``load_pretrained`` takes, ``out/checkpoint``.

    Raises:
        ValueError: data, recipe or teacher that cannot be used; the message names them.
    """
    module = SimulatorTraining(recipe)
    reference = find_teacher(teacher)
    # nothing of hlsim's own: trainings that began before there were others go on
    told = {} if reference is None else {"teacher": name_of(reference)}
    batches = simulator_data(data, recipe, reference)
    how: dict[str, Any] = {
        "out": out,
        "identity": data.identity() | told,
        "about": told,
    }
    return train_network(module, batches, recipe, SIMULATOR, **how, **options)
