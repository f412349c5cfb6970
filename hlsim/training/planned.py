"""Training a Neuro-MSBG on a corpus that ``hlsim prepare`` has planned."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from hlsim.data.module import PlanData, PlanItems
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.loop import Counter
from hlsim.training.simulator import SimulatorTraining

_VALID_SECONDS = 2.0
_WINDOW = 20  # steps over which the time spent waiting for data is averaged


@dataclass(frozen=True)
class PlannedSource:
    """Where a training's batches come from.

    Attributes:
        manifest: ``manifest.csv`` of a prepared folder, or the folder.
        root: where the audio lies, if not where it was prepared.
        prepared: take the instances that ``hlsim prepare --write`` made, clips of them unchanged, instead of making and
            varying them on the fly.
        workers: processes that read and vary.
    """

    manifest: Path
    root: Path | None = None
    prepared: bool = False
    workers: int = field(default=1, compare=False)  # a run may go on with others


class PlannedTraining(SimulatorTraining):
    """Batches from a plan's training split; validation on its validation split, or else on test's, or training's.

    What is prepared is heard as it lies on disk, in validation too, and needs no corpus.

    Logs ``data_wait``, the share of a step's time that is spent waiting for data.
    """

    batch: dict[str, Tensor]
    batches: _Batches

    def take(self, data: Any) -> None:
        if not isinstance(data, PlannedSource):
            raise ValueError(f"data is {type(data).__name__}; allowed: PlannedSource")
        if self.recipe.sounds:
            raise ValueError(f"sounds {self.recipe.sounds} in the recipe, with a manifest; allowed: 0")
        self.batches = self.datamodule = _Batches(
            data.manifest,
            root=data.root,
            prepared=data.prepared,
            batch=self.recipe.batch,
            seconds=self.recipe.seconds,
            workers=data.workers,
            seed=self.recipe.seed,
            levels=self.recipe.levels,
            treated=self.recipe.treated,
        )
        if self.batches.plan.rate != NEURO_RATE:
            raise ValueError(
                f"{data.manifest}: prepared at {self.batches.plan.rate} Hz; allowed: {NEURO_RATE}"
            )
        self.valid, self.truths = _validation(self.batches, self.recipe.validation_items)
        self._marks: list[tuple[float, float]] = []

    def identity(self, data: Any) -> dict[str, str]:
        return super().identity(data) | {"instances": self.batches.made_of}

    def training_step(self, batch: Any, index: int) -> Tensor:
        self.batch = batch
        assert self.batches.loader is not None
        # from the second step on, for the first one waits until the workers have started
        self._marks = [*self._marks[-_WINDOW:], (time.perf_counter(), self.batches.loader.waited)]
        (began, before), (now, waited) = self._marks[0], self._marks[-1]
        if now > began:
            self.log("data_wait", (waited - before) / (now - began))
        return super().training_step(batch, index)

    def on_validation_end(self) -> None:
        self._marks = []  # that was no step

    def training_loss(self, generator: torch.Generator) -> Tensor:
        return self.loss_on(self.batch["signal"], self.batch["thresholds"], self.batch["impaired"])


class _Batches(PlanData):
    """Training batches; the modules here validate on items of their own."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing: a batch is a step, and the step is right where SLURM has a state stored in the midst of one."""
        return {}

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(Counter(1), batch_size=None)


def _validation(data: PlanData, count: int) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor]]:
    """The middle 2 s of instances evenly spread over the split, and what is heard of them where that is prepared.

    Shape: [((8, time), (8, 8))], [(8, time)].
    """
    for split in ("valid", "test", "train"):
        try:
            items = PlanItems(data.plan, split, prepared=data.prepared)
            break
        except ValueError:
            continue
    if split != "valid":
        warnings.warn(
            f"the plan has no split 'valid': the best checkpoint is chosen on {split!r}, whose figures then say too much",
            stacklevel=2,
        )
    samples = round(_VALID_SECONDS * data.plan.rate)
    chosen = torch.linspace(0, len(items) - 1, min(count, len(items))).round().int().tolist()
    signals, ears, heard = [], [], []
    for place in chosen:
        instance = items[place]
        signals.append(_middle(instance.signal, samples))
        ears.append(instance.thresholds)
        if instance.impaired is not None:
            heard.append(_middle(instance.impaired, samples))
    pairs = [
        (torch.stack(signals[i : i + 8]), torch.stack(ears[i : i + 8])) for i in range(0, len(chosen), 8)
    ]
    return pairs, [torch.stack(heard[i : i + 8]) for i in range(0, len(heard), 8)]


def _middle(value: Tensor, samples: int) -> Tensor:
    first = max(0, (value.shape[-1] - samples) // 2)
    cut = value[first : first + samples]
    return torch.nn.functional.pad(cut, (0, samples - cut.shape[-1]))
