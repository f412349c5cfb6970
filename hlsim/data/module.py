"""Batches for Lightning by step: of a prepared plan, made on the fly or read from disk, or of any other data set."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset, Sampler

from hlsim.audiogram import LOWEST_LEVEL
from hlsim.audiogram.thresholds import HIGHEST_SIMULATED
from hlsim.calibration import level_spl, set_level
from hlsim.data.instances import Instance, Plan
from hlsim.data.teacher import Teacher, check_grid
from hlsim.data.writing import Recipe, claimed
from hlsim.training.augment import augment_speech

_ENDLESS = 10_000_000  # steps: time or steps end a training, not the data
_TRIES = 8  # instances that cannot be read, one after the other, before training ends

Batch = dict[str, Tensor]
"""``clean``, ``signal``, ``impaired`` (items, time) in pascals, ``thresholds`` (items, 8) dB HL, ``lengths`` (items,).

Drawn batches have no ``lengths``, for all items are as long, and no batch has ``impaired`` before a teacher was asked.
``sounds`` marks the batches to validate on that are tones and clicks.
"""


class Step(NamedTuple):
    """The number of a training step, and which of how many processes asks; every batch is a function of these alone."""

    number: int
    rank: int = 0
    processes: int = 1


@dataclass(eq=False)
class Steps(Sampler[Step]):
    """The steps of one process without end, from ``first`` on."""

    first: int = 0
    rank: int = 0
    processes: int = 1

    def __len__(self) -> int:
        return _ENDLESS

    def __iter__(self) -> Iterator[Step]:
        return (Step(number, self.rank, self.processes) for number in count(self.first))


class TimedLoader(DataLoader[Any]):
    """A loader that knows how long it was waited for, ``waited`` in seconds; of ``Steps`` it gives each only once."""

    waited = 0.0

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        batches = super().__iter__()
        while True:
            began = time.perf_counter()
            try:
                if (batch := next(batches, None)) is None:
                    return
            except ValueError as error:  # a worker's has its traceback in its message
                raise ValueError(str(error).rpartition("ValueError: ")[2].strip()) from error
            self.waited += time.perf_counter() - began
            if isinstance(self.sampler, Steps):
                self.sampler.first += 1
            yield batch


class BatchData(L.LightningDataModule):
    """Training batches by step, and fixed batches to validate on.

    What an ear hears is said by the teacher where a batch does not have it: of training batches on the training device.
    Each iteration over training batches, and a training that goes on from a Trainer's state, begins after the batches
    already given. On several devices each has batches of its own: give the Trainer ``use_distributed_sampler=False``.

    Args:
        training: the batch of a ``Step``.
        validation: batches.
        workers: processes that make batches, beside the one that trains.
    """

    training: Dataset[Batch]
    loader: TimedLoader

    def __init__(
        self,
        training: Dataset[Batch] | None = None,
        validation: Sequence[Batch] = (),
        *,
        teacher: Teacher | None = None,
        workers: int = 0,
    ) -> None:
        super().__init__()
        if training is not None:
            self.training = training
        self.validation, self.teacher, self.workers = validation, teacher, workers

    def train_dataloader(self) -> DataLoader[Any]:
        steps = Steps()
        if self.trainer is not None:
            trainer = self.trainer
            steps = Steps(trainer.global_step, trainer.global_rank, trainer.world_size)
        self.loader = self._loader(self.training, batch_size=None, sampler=steps)
        return self.loader

    def val_dataloader(self) -> DataLoader[Any]:
        for batch in self.validation:
            self._hear(batch, blocks=False)
        return DataLoader(self.validation, batch_size=None)  # type: ignore[arg-type]

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Let the teacher say what is heard, on the device that the batch has come to."""
        clips = self.trainer is not None and self.trainer.training
        self._hear(batch, blocks=not clips)
        return batch

    def _hear(self, batch: Batch, *, blocks: bool) -> None:
        if self.teacher is not None and "impaired" not in batch:
            batch["impaired"] = self.teacher(batch["signal"], batch["thresholds"], blocks=blocks)

    def _loader(self, items: Dataset[Any], **options: Any) -> TimedLoader:
        prefetched = 4 if self.workers else None
        return TimedLoader(items, num_workers=self.workers, prefetch_factor=prefetched, **options)


class PlanItems(Dataset[Instance]):
    """Instances of one split, in order, whole and as they are; where ``prepared``, from disk, targets included."""

    def __init__(self, plan: Plan, split: str, *, prepared: bool = False) -> None:
        self.plan, self.prepared = plan, prepared
        self.indices = plan.indices(split)
        if not len(self.indices):
            raise ValueError(f"{plan.folder}: has no instances for {split}")

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, place: int) -> Instance:
        index = int(self.indices[place])
        return Instance.read(self.plan.path(index)) if self.prepared else self.plan.instance(index)


@dataclass(eq=False)
class PlannedBatches(Dataset[Batch]):
    """Clips of the instances of one split in an endless random order: clip p depends on the seed and p alone.

    Every instance comes once before any comes again. An instance that cannot be read is told of and replaced by the next.

    Args:
        items: where they come from.
        batch: clips of a batch.
        seconds: length of a clip; shorter utterances are followed by silence.
        augment: change what is not prepared: another ear of the split, moved by up to 5 dB, another noise of the split
            where noise is mixed in, and SNR, level, equalisation, amplification and compression as ``augment_speech``.
        seed: of order and augmentation.
        levels, treated: as ``augment_speech`` takes them.
    """

    items: PlanItems
    batch: int = 6
    seconds: float = 1.3
    augment: bool = True
    seed: int = 0
    levels: tuple[float, float] = (40.0, 95.0)
    treated: bool = True

    def __post_init__(self) -> None:
        rate = self.items.plan.rate
        self.samples = round(self.seconds * rate)
        self.augment = self.augment and not self.items.prepared
        self.grid = 1 if self.augment else check_grid(rate)
        self._order = (-1, torch.empty(0))

    def __getitem__(self, step: Step) -> Batch:
        first = step.number * self.batch
        return collate(
            [self.clip(step.rank + (first + i) * step.processes) for i in range(self.batch)]
        )

    def clip(self, position: int) -> Instance:
        for offset in range(_TRIES):
            try:
                return self._clip(position, offset)
            except ValueError as error:
                warnings.warn(f"left out: {error}", stacklevel=2)
                last = error
        raise ValueError(f"{_TRIES} instances in a row cannot be read, the last: {last}")

    def _clip(self, position: int, offset: int) -> Instance:
        plan, indices, count = self.items.plan, self.items.indices, len(self.items)
        epoch, place = divmod(position, count)
        if self._order[0] != epoch:
            self._order = (epoch, torch.randperm(count, generator=self._generator(-epoch - 1)))
        number = int(self._order[1][(place + offset) % count])
        generator = self._generator(position)
        instance = self.items[number]
        spare = max(0, instance.signal.shape[-1] - self.samples)
        first = self.grid * int(torch.randint(spare // self.grid + 1, (), generator=generator))
        if not self.augment:
            return instance.clip(first, self.samples)
        clip = Instance(*plan.pair(int(indices[number])), instance.thresholds).clip(
            first, self.samples
        )
        other, another = indices[torch.randint(len(indices), (2,), generator=generator)].tolist()
        donor = plan.utterance(another)
        noise = (
            plan.noise(donor, self.samples, plan.rate) if donor.mixed else clip.signal - clip.clean
        )
        ear = plan.thresholds(other) + 10.0 * torch.rand((), generator=generator) - 5.0
        ear = ear.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)
        added = noise[None] if bool(noise.any()) else None
        given = (clip.clean[None], added, ear[None], plan.rate, generator)
        (signal,) = augment_speech(*given, levels=self.levels, treated=self.treated)
        return Instance(set_level(clip.clean, level_spl(signal)), signal, ear)

    def _generator(self, number: int) -> torch.Generator:
        return torch.Generator().manual_seed((self.seed * 1_000_003 + number) % 2**63)


class PlanData(BatchData):
    """Batches of a plan, with the impaired speech made by MSBG on the training device or read from disk.

    Training batches are clips; validation and test batches are whole utterances, padded with silence. Without ``augment``
    item k is the plan's instance k however it is made: whole, the same as ``hlsim prepare --write`` puts on disk (to the
    rounding of a batch). Clips that are not augmented start where frames of MSBG's smearing do (every 0.64 s at 16 kHz),
    so that they too are the same both ways, but for 50 ms at either end, where the target from disk knows what follows.

    Args:
        folder: what ``hlsim prepare`` wrote.
        root: where the audio lies, if not where it was prepared.
        prepared: read the instances that ``--write`` left there, instead of making them.
        recipe: alignment of targets made on the fly, or that of the prepared.
        workers: processes that read and augment, beside the one that trains.
        clips: see ``PlannedBatches``.

    Raises:
        ValueError: the folder is no plan, or holds no instances where ``prepared``.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        root: str | Path | None = None,
        prepared: bool = False,
        recipe: Recipe | None = None,
        workers: int = 1,
        **clips: Any,
    ) -> None:
        self.plan = Plan(folder, root)
        super().__init__(teacher=(recipe or Recipe()).teacher(self.plan.rate), workers=workers)
        self.prepared, self.clips = prepared, clips
        self.made_of = claimed(self.plan) if prepared else self.plan.digest

    @cached_property
    def training(self) -> Dataset[Batch]:  # type: ignore[override]
        return PlannedBatches(self.items("train"), **self.clips)

    def items(self, split: str) -> PlanItems:
        """Raises ValueError where the plan has no such split."""
        return PlanItems(self.plan, split, prepared=self.prepared)

    def val_dataloader(self) -> DataLoader[Any]:
        """The validation split, or where there is none the test split."""
        return self._whole("valid" if len(self.plan.indices("valid")) else "test")

    def test_dataloader(self) -> DataLoader[Any]:
        return self._whole("test")

    def _whole(self, split: str) -> TimedLoader:
        return self._loader(
            self.items(split), batch_size=self.clips.get("batch", 6), collate_fn=collate
        )


def collate(instances: list[Instance]) -> Batch:
    """A batch, shorter items followed by silence."""
    batch = {"lengths": torch.tensor([instance.signal.shape[-1] for instance in instances])}
    for name in ("clean", "signal", "impaired", "thresholds"):
        values = [getattr(instance, name) for instance in instances]
        if all(value is not None for value in values):
            longest = max(value.shape[-1] for value in values)
            batch[name] = torch.stack(
                [functional.pad(x, (0, longest - x.shape[-1])) for x in values]
            )
    return batch
