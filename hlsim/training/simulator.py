"""Training of a Neuro-MSBG on the output of the exact MSBG or of another teacher."""

from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from torch import Tensor, nn

from hlsim.losses.criteria import weighted_sum
from hlsim.losses.paper import paper_parts
from hlsim.losses.teacher_distance import (
    band_level_distance_db,
    log_spectral_distance_db,
    noise_to_signal_db,
)
from hlsim.neuro import NeuroConfig, NeuroMSBG, load_pretrained
from hlsim.simulators import load_simulator
from hlsim.training.batches import Batch, TrainingData, make_data
from hlsim.training.gradients import gradient_error
from hlsim.training.module import TrainingModule, describe_simulator, initial_network
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.trainer import train_network

_POWER_FLOOR = 1e-18
"""Power in Pa^2 that is added to the power of a signal before a division by this power."""

_GRADIENT_INTERVAL = 3
"""Number of steps from one comparison of gradients to the next."""


class SimulatorTraining(TrainingModule):
    """Lightning module that trains a Neuro-MSBG on the output of a teacher.

    Args:
        recipe: Settings of the network and of the training run.
        teacher: Simulator at 16 kHz, which is moved to the device of the training.

    Raises:
        ValueError: The settings of the network are not valid, or the network with which the recipe
            starts does not exist or has other settings.

    >>> recipe = SimulatorRecipe(model={"channels": 4, "blocks": 1})
    >>> signal, ears = 0.02 * torch.randn(1, 4000), torch.full((1, 8), 40.0)
    >>> module = SimulatorTraining(recipe, load_simulator("msbg"))
    >>> module.validation_step({"signal": signal, "thresholds": ears}, 0)
    >>> len(module.measured_values)
    1
    """

    recipe: SimulatorRecipe

    def __init__(self, recipe: SimulatorRecipe, teacher: nn.Module) -> None:
        build = partial(NeuroMSBG, NeuroConfig.from_dict(recipe.model))
        network = initial_network(recipe, build, load_pretrained)
        network.autocast_dtype = None if recipe.precision == "float32" else torch.bfloat16
        super().__init__(network, recipe)
        self._teacher = (teacher,)  # in a tuple, because it is neither trained nor saved

    def compute_loss(self, batch: Batch) -> Tensor:
        """Compute the loss of a batch, a scalar: the weighted sum of the recipe's criteria.

        The criterion ``gradient`` takes part in every third step only, unless it is the only one.
        """
        weights = {name: weight for name, weight in self.recipe.weights.items() if weight}
        if self.global_step % _GRADIENT_INTERVAL and len(weights) > 1:
            weights.pop("gradient", None)
        compares_gradients = "gradient" in weights
        signal = batch["signal"].detach().requires_grad_(compares_gradients)
        target, perceived = self._simulate(signal, batch["thresholds"])
        parts = {}
        if compares_gradients:
            parts["gradient"] = gradient_error(
                perceived, signal, batch["clean"], batch["thresholds"], *self._teacher
            )
        if "levels" in weights:
            parts["levels"] = band_level_distance_db(perceived, target, batch["signal"]) / 10.0
        unit = target if self.recipe.unit_power == "truth" else batch["signal"]
        scale = unit.square().mean(-1, keepdim=True).add(_POWER_FLOOR).rsqrt()
        target = target * scale
        perceived = perceived * scale
        parts["snr"] = noise_to_signal_db(perceived, target) / 10.0
        if "log_spectrum" in weights:
            parts["log_spectrum"] = log_spectral_distance_db(perceived, target) / 10.0
        if weights.keys() - parts.keys():
            parts |= paper_parts(perceived, target)
        return weighted_sum(parts, weights).mean()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        # ratio of the teacher's output to the network's error in dB
        target, perceived = self._simulate(batch["signal"], batch["thresholds"])
        self.measured_values.append(-noise_to_signal_db(perceived, target))

    def _simulate(self, signal: Tensor, ears: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs of the teacher, without a gradient, and of the network.

        Shape: (items, time) in pascals, (items, 8) in dB HL -> (items, time) in pascals each.
        """
        (teacher,) = self._teacher
        with torch.no_grad():
            target = teacher.to(signal.device)(signal, ears)
        return target, self.network(signal, ears)

    def summarise(self, values: Tensor) -> dict[str, float]:
        """Compute the median and the 10th percentile of the items' SNRs in dB, and ``score``.

        The score is the median plus half the 10th percentile.

        Args:
            values: Ratios of the teacher's output to the network's error in dB, (items,).
        """
        median = float(values.quantile(0.5))  # torch's median is the lower middle value
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
        teacher: ``"msbg"``, the exact model, or the name of another simulator, see
            ``load_simulator``.
        options: ``max_minutes`` and options of Lightning's ``Trainer``, see ``train_network``.

    Returns:
        The folder that ``load_pretrained`` reads, ``out/checkpoint``.

    Raises:
        ValueError: The data, the recipe or the teacher is invalid, or the training fails, see
            ``train_network``.
        TypeError, KeyboardInterrupt: See ``train_network``.

    >>> from hlsim import load_pretrained
    >>> def train_and_load(speech: str, out: str) -> NeuroMSBG:
    ...     recipe = SimulatorRecipe(steps=1000)
    ...     return load_pretrained(train_simulator(TrainingData(Path(speech)), recipe, out=out))
    """
    return train_network(
        SimulatorTraining(recipe, load_simulator(teacher)),
        make_data(data, recipe),
        out=out,
        about={"data": data.identity(), **describe_simulator("teacher", teacher)},
        callbacks=[EMAWeightAveraging(use_buffers=False, decay=recipe.average)],
        **options,
    )
