"""Callbacks of a training: the average of the weights, and the checkpoint of the best network."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
from torch import Tensor

from hlsim.checkpoint import save_checkpoint


def update_averages(
    averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Any, *, decay: float
) -> None:
    """Update the exponential moving averages of weights in place.

    Lightning's ``WeightAveraging`` calls this after each step. Unlike its
    ``EMAWeightAveraging``, the averages forget faster at first: the decay is at most
    (1 + n) / (10 + n) after n steps. The random initial weights would otherwise dominate the
    averages of a short training.

    Args:
        averages: Average of each parameter.
        weights: Each parameter after the last step.
        steps: Number of updates so far.
        decay: Weight of the previous average in the new one, from 0 to below 1.

    >>> average, weights = [Tensor([0.0])], [Tensor([10.0])]
    >>> update_averages(average, weights, steps=8, decay=0.99)
    >>> average  # 0.5 * 0.0 + 0.5 * 10.0
    [tensor([5.])]
    """
    decay = min(decay, (1.0 + float(steps)) / (10.0 + float(steps)))
    for average, weight in zip(averages, weights, strict=True):
        average.lerp_(weight.to(average), 1.0 - decay)


class BestCheckpoint(L.Callback):
    """Callback that saves the network with the highest validation score in a folder.

    The first candidate is the network before the first step, the others are those whose states
    Lightning saves. The callback must come after that of the average of the weights.

    Args:
        folder: Folder to write, which ``load_pretrained`` or ``load_compensator`` reads.
        kind: Kind of the checkpoint, such as ``"hearing-aid"``.
        record: Entries about the training for the checkpoint's ``config.json``.

    Attributes:
        best_score: Highest validation score so far.

    >>> BestCheckpoint(Path("runs"), "hearing-aid", record={"seed": 0}).best_score
    -inf
    """

    def __init__(self, folder: Path, kind: str, record: dict[str, Any]) -> None:
        self.folder = folder
        self.kind = kind
        self.record = record
        self.best_score = -math.inf

    def on_sanity_check_end(self, trainer: L.Trainer, module: Any) -> None:
        self.record["start_validation"] = module.validation
        self._save_if_best(module, module.state_dict(), step=0, seconds=0.0)

    def on_save_checkpoint(
        self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]
    ) -> None:
        seconds = checkpoint["callbacks"]["Timer"]["time_elapsed"]["train"]
        self._save_if_best(module, checkpoint["state_dict"], checkpoint["global_step"], seconds)
        checkpoint |= {"best_score": self.best_score, "record": self.record}

    def on_load_checkpoint(
        self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]
    ) -> None:
        self.best_score = checkpoint["best_score"]
        self.record = checkpoint["record"]

    def _save_if_best(
        self, module: Any, weights: Mapping[str, Tensor], step: int, seconds: float
    ) -> None:
        """Save a network, unless an earlier one has a higher or equal validation score.

        Args:
            module: The ``TrainingModule`` after its validation.
            weights: State dict of the module that was validated.
            step: Number of the step.
            seconds: Duration of the training up to the step.
        """
        score = module.validation["score"]
        if score <= self.best_score:
            return
        self.best_score = score
        network = copy.deepcopy(module.network)
        network.load_state_dict(
            {name.removeprefix("network."): tensor for name, tensor in weights.items()}
        )
        record = {
            **self.record,
            "steps": step,
            "minutes": round(seconds / 60.0, 1),
            "validation": module.validation,
        }
        if module.trainer.is_global_zero:
            save_checkpoint(self.folder, self.kind, network, network.config.to_dict(), record)
