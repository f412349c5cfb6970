"""Training of a Neuro-MSBG on the output of the exact MSBG or of another teacher."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from torch import Tensor

from hlsim.checkpoint import SIMULATOR
from hlsim.losses.criteria import weighted_sum
from hlsim.losses.paper import paper_parts
from hlsim.losses.waveform import (
    band_level_distance_db,
    log_spectral_distance_db,
    noise_to_signal_db,
)
from hlsim.msbg import MSBG
from hlsim.neuro import NeuroConfig, NeuroMSBG, load_pretrained
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.batches import Batch, TrainingData, simulator_data
from hlsim.training.gradients import exact_gradients, gradient_error
from hlsim.training.module import TrainingModule, initial_network
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.teacher import find_teacher
from hlsim.training.trainer import train_network

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
    >>> SimulatorTraining(recipe).evaluate(batch).shape
    torch.Size([1])
    """

    recipe: SimulatorRecipe

    def __init__(self, recipe: SimulatorRecipe) -> None:
        build = partial(NeuroMSBG, NeuroConfig.from_dict(recipe.model))
        network = initial_network(recipe, build, load_pretrained)
        network.autocast_dtype = None if recipe.precision == "float32" else torch.bfloat16
        super().__init__(network, recipe)

    def training_loss(self, batch: Batch) -> Tensor:
        signal, target, ears = batch["signal"], batch["impaired"], batch["thresholds"]
        weights = dict(self.recipe.weights)
        if self.global_step % self.recipe.gradient_every:
            weights.pop("gradient", None)
        compares_gradients = bool(weights.get("gradient"))
        network_input = signal.detach().requires_grad_(compares_gradients)
        perceived = self.network(network_input, ears)
        parts = {}
        if compares_gradients:
            expected = exact_gradients(signal, batch["clean"], ears)
            parts["gradient"] = gradient_error(perceived, network_input, expected)
        if weights.get("levels"):
            parts["levels"] = band_level_distance_db(perceived, target, signal) / 10.0
        unit = target if self.recipe.unit_power == "truth" else signal
        scale = unit.square().mean(-1, keepdim=True).add(_POWER_FLOOR).rsqrt()
        target = target * scale
        perceived = perceived * scale
        parts["snr"] = noise_to_signal_db(perceived, target) / 10.0
        if weights.get("log_spectrum"):
            parts["log_spectrum"] = log_spectral_distance_db(perceived, target) / 10.0
        if set(weights) - parts.keys() - {"log_spectrum"}:
            parts |= paper_parts(perceived, target)
        return weighted_sum(parts, weights).mean()

    def evaluate(self, batch: Batch) -> Tensor:
        """Compute the ratio of the teacher's output to the network's error in dB for each item."""
        perceived = self.network(batch["signal"], batch["thresholds"])
        return -noise_to_signal_db(perceived, batch["impaired"])

    def summarise(self, values: Tensor) -> dict[str, float]:
        """Compute the median and the 10th percentile of the ratios, and a score for the network.

        The score is the median plus half the 10th percentile in dB.
        """
        median = float(values.median())
        worst_tenth = float(values.quantile(0.1))
        return {
            "score": median + 0.5 * worst_tenth,
            "valid_snr_median": median,
            "valid_snr_worst_tenth": worst_tenth,
        }


def train_simulator(
    data: TrainingData,
    recipe: SimulatorRecipe,
    *,
    out: str | Path,
    teacher: str = "msbg",
    **options: Any,
) -> Path:
    """Train a simulator, or resume its training, and save it as it is when it validates best.

    Args:
        data: Speech, noise and ears for training and validation.
        recipe: Network, criteria and number of steps.
        out: Folder for the results. A training that was interrupted resumes from it.
        teacher: ``"msbg"``, the exact MSBG, or the name of a plug-in, see ``PluginTeacher``.
        options: ``max_minutes`` and options of Lightning's ``Trainer``, see ``train_network``.

    Returns:
        The folder that ``load_pretrained`` reads, ``out/checkpoint``.

    Raises:
        ValueError: The data, the recipe or the teacher is invalid.

    >>> from hlsim import load_pretrained
    >>> def train_and_load(speech: str, out: str) -> NeuroMSBG:
    ...     recipe = SimulatorRecipe(steps=1000)
    ...     return load_pretrained(train_simulator(TrainingData(Path(speech)), recipe, out=out))
    """
    plugin = find_teacher(teacher)
    about = {"data": data.identity()}
    if plugin is not None:
        about["teacher"] = str(plugin)
    return train_network(
        SimulatorTraining(recipe),
        simulator_data(data, recipe, plugin or MSBG(sample_rate=NEURO_RATE)),
        SIMULATOR,
        out=out,
        about=about,
        callbacks=[EMAWeightAveraging(use_buffers=False, decay=recipe.average)],
        **options,
    )
