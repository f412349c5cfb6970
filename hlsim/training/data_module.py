"""Loading of batches with Lightning. A batch depends on the number of the training step alone."""

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
- ``signal``: input of the network in pascals with shape (items, time)
- ``thresholds``: ears in dB HL with shape (items, 8)
- ``impaired``: output of the teacher in pascals with shape (items, time), computed on the device
- ``noise_reduction``: strength of an aid's noise reduction, 0 or 1, with shape (items,)
- ``sounds``: present in validation batches of tones and clicks only
"""

_MANY_STEPS = 10_000_000
"""Number of training batches without a Trainer."""


class Step(NamedTuple):
    """Index of a training batch, from which its random seed follows.

    Attributes:
        number: Number of earlier optimiser steps in the training, 0 for the first batch.
        rank: Number of the process among those that train together, from 0. Each draws batches of
            its own.

    >>> Step(3)
    Step(number=3, rank=0)
    """

    number: int
    rank: int = 0


@dataclass(eq=False)
class _Steps(Sampler[Step]):
    """Steps that one process takes, from ``first`` to ``end``, which is not included."""

    first: int
    end: int
    rank: int

    def __len__(self) -> int:
        return self.end  # Lightning also counts the steps before a resumption.

    def __iter__(self) -> Iterator[Step]:
        return (Step(number, self.rank) for number in range(self.first, self.end))


class _ReturnedErrors(Dataset[Any]):
    """Data set that returns a ValueError instead of raising it.

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
    """Lightning's data module of both trainings: batches by step, and fixed validation batches.

    A resumed training continues with the batch after the last one. Each device draws its own
    batches, for which the Trainer requires ``use_distributed_sampler=False``.

    Args:
        training: Data set that returns the batch of a ``Step``.
        validation: Batches for validation.
        teacher: Simulator that computes ``impaired`` for batches without it, on the training
            device; None leaves batches as they are.
        workers: Number of processes that draw batches, in addition to the one that trains.

    >>> batches = {Step(0): {"clean": Tensor([1.0])}}
    >>> next(iter(BatchData(batches).train_dataloader()))
    {'clean': tensor([1.])}
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
        if trainer is None:
            steps = _Steps(0, _MANY_STEPS, rank=0)
        else:
            steps = _Steps(trainer.global_step, trainer.max_steps, trainer.global_rank)
        return DataLoader(
            _ReturnedErrors(self.training),
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
