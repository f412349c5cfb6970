"""Training of a Neuro-MSBG on the output of the exact MSBG or of another teacher."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Unpack

import torch
from torch import Tensor

from hlsim.checkpoint import SIMULATOR
from hlsim.losses.criteria import weighted_sum
from hlsim.losses.paper import paper_parts
from hlsim.losses.waveform import log_spectral_distance_db, noise_to_signal_db
from hlsim.neuro import NeuroConfig, NeuroMSBG, load_pretrained
from hlsim.training.batches import TrainingData, simulator_data
from hlsim.training.callbacks import WeightAverage
from hlsim.training.data_module import Batch
from hlsim.training.module import TrainingModule, initial_network
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.teacher import find_teacher
from hlsim.training.trainer import TrainerOptions, train_network

_POWER_FLOOR = 1e-18
"""Power in Pa^2 that is added to the power of a signal before dividing by it."""


class SimulatorTraining(TrainingModule):
    """Lightning module that trains a Neuro-MSBG on the output of a teacher.

    Batches contain the output of the teacher as ``impaired``.

    Args:
        recipe: Settings of the network and of the training.

    >>> recipe = SimulatorRecipe(model={"channels": 4, "blocks": 1})
    >>> signal, ears = 0.02 * torch.randn(1, 4000), torch.full((1, 8), 40.0)
    >>> batch = {"signal": signal, "thresholds": ears, "impaired": 0.1 * signal}
    >>> SimulatorTraining(recipe).evaluate(batch)["valid_snr"].shape
    torch.Size([1])
    """

    recipe: SimulatorRecipe

    def __init__(self, recipe: SimulatorRecipe) -> None:
        network = initial_network(recipe, NeuroConfig, NeuroMSBG, load_pretrained)
        network.autocast_dtype = None if recipe.precision == "float32" else torch.bfloat16
        super().__init__(network, recipe)

    def training_loss(self, batch: Batch) -> Tensor:
        signal, target = batch["signal"], batch["impaired"]
        perceived = self.network(signal, batch["thresholds"])
        unit = target if self.recipe.unit_power == "truth" else signal
        scale = unit.square().mean(-1, keepdim=True).add(_POWER_FLOOR).rsqrt()
        target = target * scale
        perceived = perceived * scale
        weights = self.recipe.weights
        parts = {"snr": noise_to_signal_db(perceived, target) / 10.0}
        self.log("snr", -10.0 * parts["snr"].mean(), prog_bar=True)
        if weights.get("log_spectrum"):
            parts["log_spectrum"] = log_spectral_distance_db(perceived, target) / 10.0
        if set(weights) - {"snr", "log_spectrum"}:
            parts |= paper_parts(perceived, target)
        return weighted_sum(parts, weights).mean()

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """Compute the ratio of the teacher's output to the network's error for each item.

        Returns:
            The ratios in dB, (items,), under one name: ``valid_snr`` for a batch of speech, or
            ``valid_sounds_snr`` for a batch of tones and clicks.
        """
        perceived = self.network(batch["signal"], batch["thresholds"])
        name = "valid_sounds_snr" if "sounds" in batch else "valid_snr"
        return {name: -noise_to_signal_db(perceived, batch["impaired"])}

    def summarise(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Compute the median and the 10th percentile of the ratios, and a score for the network.

        The score is the median plus half the 10th percentile in dB. Those of speech and of sounds
        are weighted by their shares in training.
        """
        summary: dict[str, float] = {}
        score = 0.0
        for name, snr in values.items():
            median = float(snr.median())
            lowest_tenth = float(snr.quantile(0.1))
            summary[f"{name}_median"] = median
            summary[f"{name}_worst_tenth"] = lowest_tenth
            sounds = self.recipe.sounds
            share = sounds if name == "valid_sounds_snr" else 1.0 - sounds
            score += share * (median + 0.5 * lowest_tenth)
        return {"score": score, **summary}


def train_simulator(
    data: TrainingData,
    recipe: SimulatorRecipe,
    *,
    out: str | Path,
    teacher: str = "msbg",
    **options: Unpack[TrainerOptions],
) -> Path:
    """Train a simulator, or resume its training, and save it as it is when it validates best.

    Args:
        data: Speech, noise and ears for training and validation.
        recipe: Network, criteria and number of steps.
        out: Folder for the results. A training that was interrupted resumes from it.
        teacher: ``"msbg"``, the exact MSBG, or the name of a plug-in, see ``PluginTeacher``.
        options: Device, time limit and progress, see ``TrainerOptions``.

    Returns:
        The folder that ``load_pretrained`` reads, ``out/checkpoint``.

    Raises:
        ValueError: The data, the recipe or the teacher is invalid.

    >>> from hlsim import load_pretrained
    >>> def train_and_load(speech: str, out: str) -> NeuroMSBG:
    ...     recipe = SimulatorRecipe(steps=1000)
    ...     return load_pretrained(train_simulator(TrainingData(Path(speech)), recipe, out=out))
    """
    module = SimulatorTraining(recipe)
    plugin = find_teacher(teacher)
    about = {} if plugin is None else {"teacher": str(plugin)}
    batches = simulator_data(data, recipe, plugin)
    return train_network(
        module,
        batches,
        SIMULATOR,
        out=out,
        identity=data.identity() | about,
        about=about,
        callbacks=[WeightAverage(recipe.average)] if recipe.average else [],
        **options,
    )
