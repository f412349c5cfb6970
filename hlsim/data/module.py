"""Batches of a prepared plan for Lightning: made on the fly, or read from disk."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, Dataset

from hlsim.audiogram import HIGHEST_SIMULATED, LOWEST_LEVEL
from hlsim.calibration import level_spl, set_level
from hlsim.data.augment import vary
from hlsim.data.instances import Instance, Plan
from hlsim.data.teacher import Teacher, grid_of
from hlsim.data.writing import Recipe, claimed

_ENDLESS = 10_000_000  # steps: time or steps end a training, not the data
_TRIES = 8  # instances that cannot be read, one after the other, before training ends

Batch = dict[str, Tensor]
"""``clean``, ``signal``, ``impaired`` (items, time) in pascals, ``thresholds`` (items, 8) dB HL, ``lengths`` (items,)."""


class PlanItems(Dataset[Instance]):
    """Instances of one split, in order, whole and as they are.

    Args:
        prepared: read them, targets included, from disk.
    """

    def __init__(self, plan: Plan, split: str, *, prepared: bool = False) -> None:
        self.plan = plan
        self.split = split
        self.indices = plan.indices(split)
        self.prepared = prepared
        if not len(self.indices):
            raise ValueError(f"{plan.folder}: has no instances for {split}")

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, place: int) -> Instance:
        index = int(self.indices[place])
        return Instance.read(self.plan.path(index)) if self.prepared else self.plan.instance(index)


class TrainingItems(Dataset[Instance]):
    """Instances of one split in an endless random order, as clips: item p depends on the seed and p alone.

    Every instance comes once before any comes again. An instance that cannot be read is told of and replaced by the next.

    Args:
        items: where they come from.
        seconds: length of the clips; shorter utterances are followed by silence.
        augment: vary what is not prepared: another ear of the split, moved by up to 5 dB, another noise of the split
            where noise is mixed in, and SNR, level, equalisation, amplification and compression as ``vary``.
        start, stride: first p, so that a training goes on where it was, and step to the next.
        levels, treated: as ``vary`` takes them.
    """

    def __init__(
        self,
        items: PlanItems,
        *,
        seconds: float,
        augment: bool,
        seed: int,
        length: int,
        start: int = 0,
        stride: int = 1,
        levels: tuple[float, float] = (40.0, 95.0),
        treated: bool = True,
    ) -> None:
        self.items = items
        self.samples = round(seconds * items.plan.rate)
        self.augment = augment and not items.prepared
        self.grid = grid_of(items.plan.rate)
        self.seed = seed
        self.start, self.stride = start, stride
        self.skip = 0  # items, given before
        self.length = length
        self.levels, self.treated = levels, treated
        self._order = (-1, torch.empty(0))

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, place: int) -> Instance:
        for offset in range(_TRIES):
            try:
                return self._clip(self.start + (self.skip + place) * self.stride, offset)
            except ValueError as error:
                warnings.warn(f"left out: {error}", stacklevel=2)
                last = error
        raise ValueError(f"{_TRIES} instances in a row cannot be read, the last: {last}")

    def _clip(self, position: int, offset: int) -> Instance:
        count = len(self.items)
        epoch, place = divmod(position, count)
        if self._order[0] != epoch:
            order = torch.randperm(count, generator=torch.Generator().manual_seed(self._mixed(-epoch - 1)))
            self._order = (epoch, order)
        number = int(self._order[1][(place + offset) % count])
        generator = torch.Generator().manual_seed(self._mixed(position))
        instance = self.items[number]
        spare = max(0, instance.signal.shape[-1] - self.samples)
        step = 1 if self.augment else self.grid
        first = step * int(torch.randint(spare // step + 1, (), generator=generator))
        heard = instance.impaired
        clip = Instance(
            self._cut(instance.clean, first),
            self._cut(instance.signal, first),
            instance.thresholds,
            None if heard is None else self._cut(heard, first),
        )
        return self._varied(clip, number, first, generator) if self.augment else clip

    def _cut(self, value: Tensor, first: int) -> Tensor:
        cut = value[first : first + self.samples]
        return functional.pad(cut, (0, self.samples - cut.shape[-1]))

    def _varied(self, clip: Instance, number: int, first: int, generator: torch.Generator) -> Instance:
        plan = self.items.plan
        clean, noisy = (self._cut(x, first) for x in plan.pair(int(self.items.indices[number])))
        other, another = self.items.indices[
            torch.randint(len(self.items), (2,), generator=generator)
        ].tolist()
        mixed = plan.utterance(another).mixed
        noise = plan.noise(another, self.samples) if mixed else noisy - clean
        ears = plan.thresholds(other) + 10.0 * torch.rand((), generator=generator) - 5.0
        ears = ears.clamp(LOWEST_LEVEL, HIGHEST_SIMULATED)
        noises = noise[None] if bool(noise.any()) else None
        signal = vary(
            clean[None],
            noises,
            ears[None],
            plan.rate,
            generator,
            levels=self.levels,
            treated=self.treated,
        )[0]
        return replace(clip, clean=set_level(clean, level_spl(signal)), signal=signal, thresholds=ears)

    def _mixed(self, number: int) -> int:
        return (self.seed * 1_000_003 + number) % 2**63


class PlanData(L.LightningDataModule):
    """Batches of a plan, with the impaired speech made by MSBG on the training device or read from disk.

    Training batches are clips; validation and test batches are whole utterances, padded with silence. Without ``augment``
    item k is the plan's instance k however it is made: whole, the same as ``hlsim prepare --write`` puts on disk (to the
    rounding of a batch). Clips that are not varied start where frames of MSBG's smearing do (every 0.64 s at 16 kHz), so
    that they too are the same both ways, but for 50 ms at either end, where the target from disk knows what lies beyond.
    On several devices each takes its own share: give the Trainer ``use_distributed_sampler=False``. Each iteration over
    training batches, and a training that goes on from a Trainer's state, begins after the batches already given.

    Args:
        folder: what ``hlsim prepare`` wrote.
        root: where the audio lies, if not where it was prepared.
        prepared: read the instances that ``--write`` left there, instead of making them.
        recipe: alignment of targets made on the fly, or that of the prepared.
        batch: items.
        seconds: of a training clip.
        augment: see ``TrainingItems``.
        workers: processes that read and vary, beside the one that trains.
        seed: of order and variation.
        levels, treated: of the variation, as ``vary`` takes them.

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
        batch: int = 6,
        seconds: float = 1.3,
        augment: bool = True,
        workers: int = 1,
        seed: int = 0,
        levels: tuple[float, float] = (40.0, 95.0),
        treated: bool = True,
    ) -> None:
        super().__init__()
        self.levels, self.treated = levels, treated
        self.plan = Plan(folder, root)
        self.prepared = prepared
        self.made_of = claimed(self.plan) if prepared else self.plan.digest
        recipe = recipe or Recipe()
        self.teacher = Teacher(self.plan.rate, alignment=recipe.alignment, reference=recipe.reference)
        self.batch = batch
        self.seconds = seconds
        self.augment = augment
        self.workers = workers
        self.seed = seed
        self.loader: TimedLoader | None = None
        self.given: int | None = None

    def state_dict(self) -> dict[str, Any]:
        return {"given": self.loader.given if self.loader is not None else self.given}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.loader = None
        self.given = state_dict.get("given")

    def train_dataloader(self) -> DataLoader[Any]:
        if self.loader is not None:
            self.given = self.loader.given
        elif self.given is None:  # states of old have no count
            self.given = self.trainer.global_step if self.trainer is not None else 0
        processes = self.trainer.world_size if self.trainer is not None else 1
        rank = self.trainer.global_rank if self.trainer is not None else 0
        items = TrainingItems(
            PlanItems(self.plan, "train", prepared=self.prepared),
            seconds=self.seconds,
            augment=self.augment,
            seed=self.seed,
            start=rank,
            stride=processes,
            length=_ENDLESS * self.batch,
            levels=self.levels,
            treated=self.treated,
        )
        self.loader = self._loader(items)
        self.loader.given = self.given
        return self.loader

    def val_dataloader(self) -> DataLoader[Any]:
        """The validation split, or where there is none the test split."""
        try:
            return self._loader(PlanItems(self.plan, "valid", prepared=self.prepared))
        except ValueError:
            return self.test_dataloader()

    def test_dataloader(self) -> DataLoader[Any]:
        return self._loader(PlanItems(self.plan, "test", prepared=self.prepared))

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Let the teacher say what is heard, on the device that the batch has come to."""
        if isinstance(batch, dict) and "impaired" not in batch:
            clips = self.trainer is not None and self.trainer.training
            batch["impaired"] = self.teacher(batch["signal"], batch["thresholds"], blocks=not clips)
        return batch

    def _loader(self, items: Dataset[Instance]) -> TimedLoader:
        return TimedLoader(
            items,
            batch_size=self.batch,
            num_workers=self.workers,
            collate_fn=collate,
            prefetch_factor=4 if self.workers else None,
        )


class TimedLoader(DataLoader[Any]):
    """A loader that knows how long it was waited for, ``waited`` in seconds, and how many batches it has ``given``.

    An iteration over ``TrainingItems``, which are endless, begins after the batches given.
    """

    waited = 0.0
    given = 0

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        if isinstance(self.dataset, TrainingItems):
            self.dataset.skip = self.given * (self.batch_size or 1)  # before workers take their copies
        batches = super().__iter__()
        while True:
            began = time.perf_counter()
            try:
                batch = next(batches)
            except StopIteration:
                return
            except ValueError as error:  # a worker's has its traceback in its message
                raise ValueError(str(error).rpartition("ValueError: ")[2].strip()) from error
            self.waited += time.perf_counter() - began
            self.given += 1
            yield batch


def collate(instances: list[Instance]) -> Batch:
    """A batch, shorter items followed by silence."""
    lengths = [instance.signal.shape[-1] for instance in instances]
    batch = {"lengths": torch.tensor(lengths)}
    for name in ("clean", "signal", "impaired", "thresholds"):
        values = [getattr(instance, name) for instance in instances]
        if all(value is not None for value in values):
            longest = max(value.shape[-1] for value in values)
            batch[name] = torch.stack([functional.pad(x, (0, longest - x.shape[-1])) for x in values])
    return batch
