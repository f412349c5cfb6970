"""The Lightning module that both trainings share: schedule, validation scores, and initial weights."""

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
from hlsim.training.data_module import Batch
from hlsim.training.recipes import TrainingRecipe

Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config", bound=ModelConfig)

WARM_UP_STEPS = 50
"""Number of steps over which the learning rate rises."""


class TrainingModule(L.LightningModule):
    """A network in training.

    The learning rate depends on the step alone, and the training ends with a validation after the recipe's last step.
    Subclasses implement ``training_loss``, ``evaluate`` and ``summarise``.

    Args:
        network: network to train.
        recipe: learning rate, number of steps and whatever the subclass needs.

    Attributes:
        validation: values of the last validation, by name. Its ``score`` is highest for the best network.
        start_validation: the same, before the first step.
        description: settings and data that make this training differ from others.
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
        """Compute the loss of a batch. Shape: -> ()."""
        raise NotImplementedError

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """Compute measures of a validation batch by name, one value per item or per batch."""
        raise NotImplementedError

    def summarise(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Summarise the measures of all validation batches; ``score`` is highest for the best network."""
        raise NotImplementedError

    def trained_parameters(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.training_loss(batch)
        if not math.isfinite(float(loss.detach())):
            raise ValueError(
                f"the loss is {float(loss.detach())} at step {self.global_step}; try a lower learning rate"
            )
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_train_batch_end(self, *arguments: Any) -> None:
        # a stopped Trainer validates and saves its state, also where the last interval is a short one
        if self.global_step >= self.recipe.steps:
            self.trainer.should_stop = True

    def on_validation_epoch_start(self) -> None:
        self._evaluations = []

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        self._evaluations.append(self.evaluate(batch))

    def on_validation_epoch_end(self) -> None:
        self.validation = self.summarise(concatenate(self._evaluations))
        self.log_dict(self.validation, batch_size=1, sync_dist=True)
        shown = [
            f"{name} {value:.3f}" for name, value in self.validation.items() if name != "score"
        ]
        self.print(f"step {self.global_step}: {', '.join(shown)}")

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
    """Compute the learning rate of a step as a share of the highest one.

    It rises over the first 50 steps and falls as half a cosine, to 1 % at the last step.
    """
    rise = min(1.0, (step + 1) / WARM_UP_STEPS)
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / steps)))
    return rise * max(0.01, fall)


def concatenate(evaluations: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Concatenate the values of several batches by name; a batch may lack some names."""
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
    """Build the network to train, with random weights of the recipe's seed or with those of its ``start``.

    Args:
        recipe: ``start``, a checkpoint's name or folder; ``model``, the network's settings; ``seed``.
        config_kind: class of the network's settings.
        build: builds a network from its settings.
        load: loads a checkpoint by name.

    Raises:
        ValueError: there is no such checkpoint, or it is of another kind or has other settings.
    """
    config = config_kind.from_dict(recipe.model)
    if not recipe.start:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(recipe.seed)
            return build(config)
    network: Any = load(recipe.start)
    if not isinstance(getattr(network, "config", None), config_kind):
        raise ValueError(
            f"the recipe starts from {recipe.start!r}, a {type(network).__name__}; give a checkpoint of the recipe's kind"
        )
    if recipe.model and config != network.config:
        given, found = config.to_dict(), network.config.to_dict()
        differing = ", ".join(name for name in given if given[name] != found[name])
        raise ValueError(
            f"the recipe's model differs from that of its start {recipe.start!r} in {differing}; leave 'model' out"
        )
    trained: Network = network.train().requires_grad_(True)
    return trained
