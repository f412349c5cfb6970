"""The Lightning module of both trainings: learning rate, validation scores, and initial weights."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, TypeVar

import lightning as L
import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from hlsim.neuro.config import ModelConfig
from hlsim.training.callbacks import remove_score
from hlsim.training.data_module import Batch
from hlsim.training.recipes import TrainingRecipe

Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config", bound=ModelConfig)

_WARM_UP_STEPS = 50
"""Number of steps over which the learning rate rises."""


class TrainingModule(L.LightningModule):
    """Lightning module of both trainings: a network with its loss and its validation.

    The learning rate depends on the step alone, and the training ends with a validation after the
    recipe's last step. Subclasses implement ``training_loss``, ``evaluate`` and ``summarise``.

    Args:
        network: Network to train.
        recipe: Learning rate, number of steps, and settings of the subclass.

    Attributes:
        validation: Results of the last validation by name. The best network has the highest
            ``score``.
        start_validation: Results of the validation before the first step.
        description: Recipe and data. A training resumes only with the same description.

    >>> from hlsim.training.recipes import CompensatorRecipe
    >>> module = TrainingModule(nn.Linear(2, 1), CompensatorRecipe())
    >>> [parameter.numel() for parameter in module.trained_parameters()]
    [2, 1]
    """

    def __init__(self, network: nn.Module, recipe: TrainingRecipe) -> None:
        super().__init__()
        self.network: Any = network
        self.recipe = recipe
        self.validation: dict[str, float] = {}
        self.start_validation: dict[str, float] = {}
        self.description: dict[str, Any] = {}
        self._evaluations: list[dict[str, Tensor]] = []

    def training_loss(self, batch: Batch) -> Tensor:
        """Compute the loss of a batch, a scalar."""
        raise NotImplementedError

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """Measure the network on a validation batch.

        Returns:
            Named measured values, each with shape (items,) or, for a mean over items, (1,).
        """
        raise NotImplementedError

    def summarise(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Summarise the measured values of all validation batches.

        Args:
            values: Values of all items under each name, see ``evaluate``.

        Returns:
            Named means or quantiles, and ``score``, which is highest for the best network.
        """
        raise NotImplementedError

    def trained_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that the optimiser changes."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.training_loss(batch)
        if not math.isfinite(float(loss.detach())):
            raise ValueError(
                f"the loss is {float(loss.detach())} at step {self.global_step}, expected a finite "
                "value; lower learning_rate in the recipe"
            )
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_train_batch_end(self, *arguments: Any) -> None:
        # Stopping makes the Trainer validate and save its state, even if the last interval is
        # shorter than the others.
        if self.global_step >= self.recipe.steps:
            self.trainer.should_stop = True

    def on_validation_epoch_start(self) -> None:
        self._evaluations = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluations.append(self.evaluate(batch))

    def on_validation_epoch_end(self) -> None:
        self.validation = self.summarise(concatenate(self._evaluations))
        self.log_dict(self.validation, prog_bar=True, batch_size=1, sync_dist=True)
        if self.trainer.progress_bar_callback is None:  # a progress bar shows the measures
            measures = remove_score(self.validation)
            texts = [f"{name} {value:.3f}" for name, value in measures.items()]
            self.print(f"step {self.global_step} of {self.trainer.max_steps}: {', '.join(texts)}")

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["start_validation"] = self.start_validation
        checkpoint["description"] = self.description

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = torch.optim.AdamW(
            self.trained_parameters(), lr=self.recipe.learning_rate, weight_decay=1e-4
        )
        scheduler = LambdaLR(optimizer, partial(relative_learning_rate, steps=self.recipe.steps))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }


def relative_learning_rate(step: int, steps: int) -> float:
    """Compute the learning rate at a step, relative to the recipe's ``learning_rate``.

    The rate rises over the first 50 steps, and falls along half a period of a cosine to 1 % at the
    end.

    Args:
        step: Number of the step, from 0.
        steps: Number of steps of the training.

    >>> relative_learning_rate(25, 1000) < relative_learning_rate(50, 1000)
    True
    """
    rise = min(1.0, (step + 1) / _WARM_UP_STEPS)
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / steps)))
    return rise * max(0.01, fall)


def concatenate(evaluations: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Concatenate the measured values of several batches by name. A batch may lack names.

    >>> concatenate([{"snr": torch.ones(1)}, {"snr": torch.zeros(1)}, {}])
    {'snr': tensor([1., 0.])}
    """
    lists: dict[str, list[Tensor]] = {}
    for evaluation in evaluations:
        for name, values in evaluation.items():
            lists.setdefault(name, []).append(values)
    return {name: torch.cat(values) for name, values in lists.items()}


def initial_network(
    recipe: TrainingRecipe,
    config_kind: type[Config],
    build: Callable[[Config], Network],
    load: Callable[[str], nn.Module],
) -> Network:
    """Build the network to train, with random weights or with those of a checkpoint.

    Args:
        recipe: Recipe with the name of the checkpoint (``start``), the settings of the network
            (``model``) and the seed of random weights.
        config_kind: Class of the network's settings, such as ``NeuroConfig``.
        build: Function that builds a network with such settings.
        load: Function that loads the network of a checkpoint by its name.

    Raises:
        ValueError: There is no such checkpoint, it is of another kind, or its settings differ from
            those of the recipe.

    >>> from hlsim.neuro import NeuroConfig, NeuroMSBG, load_pretrained
    >>> from hlsim.training.recipes import SimulatorRecipe
    >>> recipe = SimulatorRecipe(model={"channels": 4, "blocks": 1})
    >>> initial_network(recipe, NeuroConfig, NeuroMSBG, load_pretrained).config.channels
    4
    """
    config = config_kind.from_dict(recipe.model)
    if not recipe.start:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            return build(config)
    network: Any = load(recipe.start)
    if not isinstance(getattr(network, "config", None), config_kind):
        raise ValueError(
            f"the checkpoint {recipe.start!r} is a {type(network).__name__}, expected a network "
            f"with {config_kind.__name__}; choose another start"
        )
    if recipe.model and config != network.config:
        settings = config.to_dict()
        start_settings = network.config.to_dict()
        names = [name for name, value in settings.items() if value != start_settings[name]]
        raise ValueError(
            f"the recipe's model differs from its start {recipe.start!r} in {', '.join(names)}; "
            "leave 'model' out"
        )
    trained: Network = network.train().requires_grad_(True)
    return trained
