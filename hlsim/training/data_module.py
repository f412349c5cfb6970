"""Loading of batches with Lightning. A batch depends on the number of the training step alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

Batch = dict[str, Tensor]
"""Tensors by name.

- ``clean``: clean speech in pascals with shape (items, time)
- ``signal``: input of the network in pascals with shape (items, time)
- ``thresholds``: ears in dB HL with shape (items, 8)
- ``impaired``: output of the teacher in pascals with shape (items, time), computed on the device
- ``noise_reduction``: strength of an aid's noise reduction, 0 or 1, with shape (items,)
"""

MAX_DEVICES = 64
"""Number of batches per training step, from which each training device has one of its own."""


class BatchData(L.LightningDataModule):
    """Lightning's data module of both trainings: batches by index, and fixed validation batches.

    The batch of device d at step s, both from 0, has the index 64 * s + d. A resumed training
    continues with the batch after the last one. The Trainer requires
    ``use_distributed_sampler=False``.

    Args:
        training: Data set that returns a batch for each index.
        validation: Batches for validation.
        teacher: Function from signals and thresholds to the ``impaired`` signals, called on the
            training device; None leaves batches as they are.
        workers: Number of processes that draw batches, in addition to the one that trains.

    >>> data = BatchData([], validation=[{"clean": Tensor([1.0])}])
    >>> next(iter(data.val_dataloader()))
    {'clean': tensor([1.])}
    """

    def __init__(
        self,
        training: Dataset[Batch],
        validation: Sequence[Batch],
        *,
        teacher: Callable[[Tensor, Tensor], Tensor] | None = None,
        workers: int = 0,
    ) -> None:
        super().__init__()
        self.training = training
        self.validation = validation
        self.teacher = teacher
        self.workers = workers

    def train_dataloader(self) -> DataLoader[Any]:
        trainer: Any = self.trainer
        first = MAX_DEVICES * trainer.global_step + trainer.global_rank
        indices = count(first, MAX_DEVICES)
        return DataLoader(self.training, batch_size=None, sampler=indices, num_workers=self.workers)

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]

    @torch.no_grad()
    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        if self.teacher is None:
            return batch
        return batch | {"impaired": self.teacher(batch["signal"], batch["thresholds"])}
