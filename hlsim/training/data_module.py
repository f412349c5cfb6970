"""Batches for Lightning, which depend on the number of the training step alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import lightning as L
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from hlsim.training.teacher import Teacher

Batch = dict[str, Tensor]
"""Tensors by name.

- ``clean``: clean speech in pascals with shape (items, time)
- ``signal``: input in pascals with shape (items, time)
- ``thresholds``: ears in dB HL with shape (items, 8)
- ``impaired``: output of the teacher in pascals with shape (items, time), computed on the device
- ``sounds``: a mark of validation batches of tones and clicks
"""

MANY_STEPS = 10_000_000
"""Number of training batches if the Trainer has no number of steps."""


class Step(NamedTuple):
    """Number of a training step, rank of its process, and number of processes."""

    number: int
    rank: int = 0
    processes: int = 1


@dataclass(eq=False)
class Steps(Sampler[Step]):
    """Steps of one process from ``first`` to ``end``, which is not included."""

    first: int = 0
    rank: int = 0
    processes: int = 1
    end: int = MANY_STEPS

    def __len__(self) -> int:
        return self.end  # Lightning also counts the steps before a resumption.

    def __iter__(self) -> Iterator[Step]:
        return (Step(number, self.rank, self.processes) for number in range(self.first, self.end))


class ReturnedErrors(Dataset[Any]):
    """Data set that returns an error instead of raising it, if a batch cannot be drawn.

    A DataLoader would add the traceback of its worker to the message.
    """

    def __init__(self, batches: Dataset[Batch]) -> None:
        self.batches = batches

    def __getitem__(self, step: Step) -> Batch | ValueError:
        try:
            return self.batches[step]
        except ValueError as error:
            return error


class BatchData(L.LightningDataModule):
    """Training batches by step, and fixed validation batches.

    A resumed training continues with the batch after the last one. Each device draws its own
    batches, for which the Trainer requires ``use_distributed_sampler=False``.

    Args:
        training: Data set that returns the batch of a ``Step``.
        validation: Batches for validation.
        teacher: Module that computes ``impaired`` for batches without it, on the training device.
        workers: Number of processes that draw batches, in addition to the one that trains.
    """

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
        trainer = self.trainer
        steps = Steps()
        if trainer is not None:
            end = MANY_STEPS if trainer.max_steps < 0 else trainer.max_steps
            steps = Steps(trainer.global_step, trainer.global_rank, trainer.world_size, end)
        return DataLoader(
            ReturnedErrors(self.training),
            batch_size=None,
            sampler=steps,
            num_workers=self.workers,
            prefetch_factor=4 if self.workers else None,
        )

    def val_dataloader(self) -> DataLoader[Any]:
        for batch in self.validation:
            self._add_target(batch)
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]

    def on_before_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        if isinstance(batch, ValueError):
            raise batch
        return batch

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        self._add_target(batch)
        return batch

    def _add_target(self, batch: Batch) -> None:
        if self.teacher is not None and "impaired" not in batch:
            batch["impaired"] = self.teacher(batch["signal"], batch["thresholds"])
