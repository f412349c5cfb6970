"""What is trained: a network's first weights, its steps, its average over steps, and its figures in validation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import lightning as L
import torch
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from hlsim.neuro.config import ModelConfig
from hlsim.training.data_module import Batch

Network = TypeVar("Network", bound=nn.Module)
Config = TypeVar("Config", bound=ModelConfig)

WARM_UP_STEPS = 50
"""Number of steps over which the learning rate rises."""


class ScheduledModule(L.LightningModule):
    """A module whose learning rate depends on the step alone: a short rise, then half a cosine down to 1 %.

    Subclasses implement ``training_loss``, ``evaluate``, ``figures`` and ``released``.

    Args:
        learning_rate: highest learning rate of AdamW.
        steps: number of steps of the whole training.
    """

    timer: Timer

    def __init__(self, learning_rate: float, steps: int) -> None:
        super().__init__()
        self.learning_rate = learning_rate
        self.steps = steps
        self.values: list[dict[str, Tensor]] = []  # of the validation under way

    def training_loss(self, batch: Batch) -> Tensor:
        raise NotImplementedError

    def evaluate(self, batch: Batch) -> dict[str, Tensor]:
        """Values of a validation batch by name, one an item or one a batch."""
        raise NotImplementedError

    def figures(self, values: Mapping[str, Tensor]) -> dict[str, float]:
        """Figures of all values by name; ``score`` is what the best checkpoint has most of."""
        raise NotImplementedError

    def examples(self, batch: Batch) -> dict[str, Tensor]:
        """Signals for TensorBoard by name, (time,) in pascals at 16 kHz."""
        return {}

    def released(self) -> nn.Module:
        """The network that is kept in the checkpoint."""
        raise NotImplementedError

    def validate(self, batches: Iterable[Batch]) -> dict[str, float]:
        """The figures on batches, without a Trainer."""
        with torch.no_grad():
            placed = (
                {name: value.to(self.device) for name, value in batch.items()} for batch in batches
            )
            return self._figures([self.evaluate(batch) for batch in placed])

    def trained_parameters(self) -> list[nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def training_step(self, batch: Batch, index: int) -> Tensor:
        loss = self.training_loss(batch)
        if not math.isfinite(value := float(loss.detach())):
            raise ValueError(
                f"the loss is {value} at step {self.global_step}; a lower learning rate may help"
            )
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_validation_epoch_start(self) -> None:
        self.values = []

    def validation_step(self, batch: Batch, index: int) -> None:
        self.values.append(self.evaluate(batch))

    def on_validation_epoch_end(self) -> None:
        self.log_dict(self._figures(self.values), prog_bar=True, batch_size=1, sync_dist=True)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = torch.optim.AdamW(
            self.trained_parameters(), lr=self.learning_rate, weight_decay=1e-4
        )
        scheduler = LambdaLR(optimizer, partial(relative_learning_rate, steps=self.steps))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }

    def _figures(self, values: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
        names = dict.fromkeys(name for one in values for name in one)
        return self.figures(
            {name: torch.cat([one[name] for one in values if name in one]) for name in names}
        )


def relative_learning_rate(step: int, steps: int) -> float:
    """Compute the learning rate of a step as a share of the highest one.

    It rises over the first 50 steps and falls as half a cosine, to 1 % at the last step.
    """
    rise = min(1.0, (step + 1) / WARM_UP_STEPS)
    fall = 0.5 * (1.0 + math.cos(math.pi * min(1.0, step / steps)))
    return rise * max(0.01, fall)


def exponential_average(model: nn.Module, decay: float) -> AveragedModel:
    """A copy of a model that follows it as an exponential moving average (EMA); ``.module`` is the averaged model.

    The first steps count as much as their number allows, (1 + n) / (10 + n), so that it does not keep its random start.

    Args:
        decay: weight of the past, 0 to below 1; 0 copies.
    """

    def follow(kept: Sequence[Tensor], new: Sequence[Tensor], count: Tensor | int) -> None:
        weight = min(decay, (1.0 + float(count)) / (10.0 + float(count)))
        for old, now in zip(kept, new, strict=True):
            old.lerp_(now.to(old), 1.0 - weight)

    average = AveragedModel(model, multi_avg_fn=follow)
    average.requires_grad_(False)  # several processes would wait for its gradients
    return average


def initial_network(
    start: str,
    settings: Mapping[str, Any],
    config_kind: type[Config],
    build: Callable[[Config], Network],
    load: Callable[[str], nn.Module],
) -> Network:
    """The network to train, with random weights or those of a checkpoint.

    Args:
        start: a checkpoint's name or folder; empty for random weights.
        settings: of the network; with ``start`` those of the checkpoint, or none.
        load: loads a checkpoint by name, frozen.

    Raises:
        ValueError: no such checkpoint, or one of another kind or with other settings.
    """
    config = config_kind.from_dict(settings)
    if not start:
        return build(config)
    network: Any = load(start)
    what = f"start {start!r} in the recipe"
    if not isinstance(getattr(network, "config", None), config_kind):
        raise ValueError(
            f"{what} is a {type(network).__name__}; allowed: a checkpoint of the recipe's kind"
        )
    if settings and config != network.config:
        ours, theirs = config.to_dict(), network.config.to_dict()
        differing = ", ".join(name for name in ours if ours[name] != theirs[name])
        raise ValueError(
            f"{what} has other settings of the model than the recipe ({differing}); allowed: the same, or no 'model' in "
            "the recipe"
        )
    trained: Network = network.train().requires_grad_(True)
    return trained
