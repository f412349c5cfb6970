"""Batches for Lightning, each a function of the number of its training step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

import lightning as L
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from hlsim.training.teacher import Teacher

Batch = dict[str, Tensor]
"""``clean``, ``signal`` and ``impaired`` (items, time) in pascals, ``thresholds`` (items, 8) dB HL.

``impaired``, the teacher's output, is computed on the training device. ``sounds`` marks validation batches of tones and
clicks.
"""


class Step(NamedTuple):
    """Number of a training step, and rank and number of the processes that train."""

    number: int
    rank: int = 0
    processes: int = 1


@dataclass(eq=False)
class Steps(Sampler[Step]):
    """Endless steps of one process, from ``first`` on."""

    first: int = 0
    rank: int = 0
    processes: int = 1

    def __len__(self) -> int:
        return 10_000_000  # time or steps end a training, not the data

    def __iter__(self) -> Iterator[Step]:
        return (Step(number, self.rank, self.processes) for number in count(self.first))


class TimedLoader(DataLoader[Any]):
    """A loader that measures how long training waits for it, and continues with the next step when it is iterated again.

    Attributes:
        waited: waiting time in seconds.
    """

    waited = 0.0

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        batches = super().__iter__()
        while True:
            start = time.perf_counter()
            try:
                batch = next(batches, None)
            except ValueError as error:  # that of a worker has its traceback in its message
                raise ValueError(str(error).rpartition("ValueError: ")[2].strip()) from error
            if batch is None:
                return
            self.waited += time.perf_counter() - start
            if isinstance(self.sampler, Steps):
                self.sampler.first += 1
            yield batch


class BatchData(L.LightningDataModule):
    """Training batches by step, and fixed batches to validate on.

    A training that continues from a Trainer's state begins with the batch after the last one. On several devices, each
    draws its own batches: give the Trainer ``use_distributed_sampler=False``.

    Args:
        training: data set whose items are the batches of a ``Step``.
        validation: batches to validate on.
        teacher: computes ``impaired`` for batches without it, on the training device.
        workers: number of processes that draw batches, beside the one that trains.
    """

    loader: TimedLoader

    def __init__(
        self,
        training: Dataset[Batch],
        validation: Sequence[Batch] = (),
        *,
        teacher: Teacher | None = None,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.training = training
        self.validation = validation
        self.teacher = teacher
        self.workers = workers

    def train_dataloader(self) -> DataLoader[Any]:
        steps = Steps()
        if self.trainer is not None:
            trainer = self.trainer
            steps = Steps(trainer.global_step, trainer.global_rank, trainer.world_size)
        self.loader = TimedLoader(
            self.training,
            batch_size=None,
            sampler=steps,
            num_workers=self.workers,
            prefetch_factor=4 if self.workers else None,
        )
        return self.loader

    def val_dataloader(self) -> DataLoader[Any]:
        for batch in self.validation:
            self._add_target(batch)
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        self._add_target(batch)
        return batch

    def _add_target(self, batch: Batch) -> None:
        if self.teacher is not None and "impaired" not in batch:
            batch["impaired"] = self.teacher(batch["signal"], batch["thresholds"])
