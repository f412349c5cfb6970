"""Callbacks of a training: averaged weights, the best network as a checkpoint folder, and a progress bar."""

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

from hlsim.pretrained import save_checkpoint

CHECKPOINT = "checkpoint"
"""Folder of the best network, which ``load_pretrained`` or ``load_compensator`` reads."""


class WeightAverage(WeightAveraging):
    """Exponential moving average of the weights, which is what is validated and saved.

    Args:
        decay: weight of the past, from 0 to below 1.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=average_function(decay))


def average_function(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Any], None]:
    """Make the function with which ``AveragedModel`` updates its weights.

    Lightning's ``EMAWeightAveraging`` has one decay throughout. Here the early decay is lower, (1 + n) / (10 + n) after
    n steps, so that a short training forgets its random initial weights.
    """

    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Any) -> None:
        present = 1.0 - min(decay, (1.0 + float(steps)) / (10.0 + float(steps)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight.to(average), present)

    return update


class BestCheckpoint(ModelCheckpoint):
    """Lightning's state with the highest validation score, and its network as a folder that hlsim loads.

    Args:
        folder: folder of the training, for ``best.ckpt`` and ``checkpoint``.
        kind: kind of the network's checkpoint.
        record: how the network was trained, for its ``config.json``.

    Attributes:
        score_to_beat: score up to which no network is released.
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
        """Write the network of a module, with other weights, as a checkpoint.

        Args:
            module: the module in training.
            weights: its state dict at the step.
            step: number of steps taken.
            seconds: duration of the training until then.
        """
        network = copy.deepcopy(module.network)
        network.load_state_dict(
            {name.removeprefix("network."): tensor for name, tensor in weights.items()}
        )
        record = {
            **self.record,
            "start_validation": without_score(module.start_validation),
            "steps": step,
            "minutes": round(seconds / 60.0, 1),
            "validation": without_score(module.validation),
        }
        save_checkpoint(self.released, self.kind, network, network.config.to_dict(), record)


def without_score(validation: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in validation.items() if name != "score"}


class ProgressBar(TQDMProgressBar):
    """Lightning's progress bar, without numbers of epochs and versions: a training is one epoch."""

    def get_metrics(self, trainer: L.Trainer, module: L.LightningModule) -> dict[str, Any]:
        metrics: dict[str, Any] = super().get_metrics(trainer, module)
        metrics.pop("v_num", None)
        return metrics

    def on_train_epoch_start(self, trainer: L.Trainer, *arguments: Any) -> None:
        super().on_train_epoch_start(trainer, *arguments)
        self.train_progress_bar.set_description("Training")
