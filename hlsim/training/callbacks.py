"""Callbacks of a training: the average of the weights, and the checkpoint of the best network."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, WeightAveraging
from torch import Tensor

from hlsim.checkpoint import save_checkpoint

CHECKPOINT = "checkpoint"
"""Name of the folder that ``load_pretrained`` or ``load_compensator`` reads."""


class WeightAverage(WeightAveraging):
    """Exponential moving average of the weights, which replaces them in validation and checkpoints.

    Unlike that of Lightning's ``EMAWeightAveraging``, this average forgets faster at first: the
    decay is at most (1 + n) / (10 + n) after n steps. The random initial weights would otherwise
    dominate the average of a short training.

    Args:
        decay: Weight of the previous average in the new one, from 0 to below 1.

    >>> average, weights = [torch.tensor([0.0])], [torch.tensor([10.0])]
    >>> WeightAverage(0.99).update_averages(average, weights, steps=8)
    >>> average  # 0.5 * 0.0 + 0.5 * 10.0
    [tensor([5.])]
    """

    def __init__(self, decay: float) -> None:
        self.decay = decay
        super().__init__(use_buffers=False, multi_avg_fn=self.update_averages)

    def update_averages(
        self, averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Any
    ) -> None:
        """Update averages in place, as ``torch.optim.swa_utils.AveragedModel`` requires.

        Args:
            averages: Average of each parameter.
            weights: Each parameter after the last step.
            steps: Number of updates so far.
        """
        decay = min(self.decay, (1.0 + float(steps)) / (10.0 + float(steps)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight.to(average), 1.0 - decay)


class BestCheckpoint(ModelCheckpoint):
    """Callback that saves the network with the highest validation score.

    It writes Lightning's state, ``best.ckpt``, and a folder ``checkpoint`` that hlsim loads.

    Args:
        folder: Folder of the training.
        kind: Kind of the network's checkpoint, such as ``"hearing-aid"``.
        record: Entries about the training for the checkpoint's ``config.json``.

    Attributes:
        score_to_beat: Validation score above which a checkpoint is written.

    >>> BestCheckpoint(Path("runs"), "hearing-aid", record={"seed": 0}).monitor
    'score'
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
        self.folder = folder / CHECKPOINT
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
            self.write_checkpoint(module, state["state_dict"], state["global_step"], seconds)

    def write_checkpoint(
        self, module: Any, weights: Mapping[str, Tensor], step: int, seconds: float
    ) -> None:
        """Write a checkpoint of the network in training, with weights of an earlier step.

        Args:
            module: The ``TrainingModule``.
            weights: State dict of the module after the step.
            step: Number of the step.
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
        save_checkpoint(self.folder, self.kind, network, network.config.to_dict(), record)


def remove_score(validation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of a validation without the score that is computed from them.

    >>> remove_score({"score": -0.5, "valid_loss": 0.5})
    {'valid_loss': 0.5}
    """
    return {name: value for name, value in validation.items() if name != "score"}
