"""Callbacks of a training: average weights, the best network as a checkpoint, and a progress
bar."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar, WeightAveraging
from torch import Tensor

from hlsim.checkpoint import save_checkpoint

CHECKPOINT = "checkpoint"
"""Name of the folder that ``load_pretrained`` or ``load_compensator`` reads."""


class WeightAverage(WeightAveraging):
    """Exponential moving average of the weights, which replaces them in validation and checkpoints.

    Args:
        decay: Weight of the past, from 0 to below 1.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=make_average_update(decay))


def make_average_update(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Any], None]:
    """Make the function with which ``AveragedModel`` updates its weights.

    Unlike Lightning's ``EMAWeightAveraging``, it has a lower decay at first: (1 + n) / (10 + n)
    after n steps. The random initial weights would otherwise dominate the average of a short
    training.

    Args:
        decay: Weight of the past, from 0 to below 1.
    """

    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Any) -> None:
        present = 1.0 - min(decay, (1.0 + float(steps)) / (10.0 + float(steps)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight.to(average), present)

    return update


class BestCheckpoint(ModelCheckpoint):
    """Callback that saves the network with the highest validation score.

    It saves Lightning's state, and a checkpoint folder that hlsim loads.

    Args:
        folder: Folder of the training, where ``best.ckpt`` and ``checkpoint`` are written.
        kind: Kind of the network's checkpoint.
        record: Training record for the checkpoint's ``config.json``.

    Attributes:
        score_to_beat: Score above which a checkpoint is written.
    """

    def __init__(self, folder: Path, kind: str, record: Mapping[str, Any]) -> None:
        super().__init__(
            dirpath=folder,
            filename="best",
            monitor="score",
            mode="max",
            save_on_train_epoch_end=False,
            enable_version_counter=False,
        )
        self.released = folder / CHECKPOINT
        self.kind = kind
        self.record = record
        self.score_to_beat = -math.inf

    def on_validation_end(self, trainer: L.Trainer, module: Any) -> None:
        previous_score = self.best_model_score
        super().on_validation_end(trainer, module)
        score = self.best_model_score
        if score is None or score is previous_score or not trainer.is_global_zero:
            return
        if float(score) > self.score_to_beat:
            state = torch.load(self.best_model_path, map_location="cpu", weights_only=True)
            seconds = state["callbacks"]["Timer"]["time_elapsed"]["train"]
            self.release(module, state["state_dict"], state["global_step"], seconds)

    def release(
        self, module: Any, weights: Mapping[str, Tensor], step: int, seconds: float
    ) -> None:
        """Write the network of a module as a checkpoint.

        Args:
            module: Module in training.
            weights: State dict of the module at the step.
            step: Number of steps.
            seconds: Duration of the training up to the step.
        """
        network = copy.deepcopy(module.network)
        network.load_state_dict(
            {name.removeprefix("network."): tensor for name, tensor in weights.items()}
        )
        record = {
            **self.record,
            "start_validation": remove_score(module.start_validation),
            "steps": step,
            "minutes": round(seconds / 60.0, 1),
            "validation": remove_score(module.validation),
        }
        save_checkpoint(self.released, self.kind, network, network.config.to_dict(), record)


def remove_score(validation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the measures of a validation without the score that is computed from them."""
    return {name: value for name, value in validation.items() if name != "score"}


class ProgressBar(TQDMProgressBar):
    """Lightning's progress bar without epoch and version, because a training is one epoch."""

    def get_metrics(self, trainer: L.Trainer, module: L.LightningModule) -> dict[str, Any]:
        metrics: dict[str, Any] = super().get_metrics(trainer, module)
        metrics.pop("v_num", None)
        return remove_score(metrics)

    def on_train_epoch_start(self, trainer: L.Trainer, *arguments: Any) -> None:
        super().on_train_epoch_start(trainer, *arguments)
        self.train_progress_bar.set_description("Training")
