"""HASPI as a metric of torchmetrics, for validation loops. Needs the extras ``train`` (torchmetrics) and ``eval``."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, Audiogram, AudiogramLike
from hlsim.calibration import check_full_scale, level_spl
from hlsim.checks import check_rate
from hlsim.extras import require
from hlsim.metrics.pyclarity import check_pair, check_seed, pyclarity_score
from hlsim.parallel import check_parallel, run_parallel

_Metric: Any = require("torchmetrics", "train").Metric


class HASPI(_Metric):
    """Mean HASPI v2 of processed speech over all items since the last ``reset``.

    HASPI takes about half a second for a second of audio and is computed on the CPU, so ``limit`` bounds what a
    validation epoch costs. It rewards any gain: log ``level``, the mean level in dB SPL, beside it.

    In a LightningModule ``self.haspi = HASPI(sample_rate=16000)``, in ``validation_step``
    ``self.haspi.update(aided, clean, audiogram); self.log("haspi", self.haspi)``.

    Args:
        sample_rate, full_scale_spl: as ``haspi``.
        seed: item i since the last reset takes ``seed`` + i, so that epochs can be compared.
        limit: items scored since the last reset, in each process; the others are passed over. None scores all.
        jobs: processes; None takes all cores.
        options: of ``torchmetrics.Metric``.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    plot_lower_bound = 0.0
    plot_upper_bound = 1.0

    total: Tensor
    total_level: Tensor
    count: Tensor
    seen: Tensor
    failed: Tensor

    def __init__(
        self,
        sample_rate: int = 16000,
        *,
        full_scale_spl: float = 94.0,
        seed: int = 0,
        limit: int | None = None,
        jobs: int | None = 1,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        require("clarity", "eval")
        if limit is not None and limit < 1:
            raise ValueError(f"limit is {limit}; allowed: 1 or more, or None")
        check_parallel(jobs, "loky", None)
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.seed, self.limit, self.jobs = check_seed(seed), limit, jobs
        for name in ("total", "total_level"):
            self.add_state(name, torch.tensor(0.0), dist_reduce_fx="sum")
        for name in ("count", "seen", "failed"):
            self.add_state(name, torch.tensor(0), dist_reduce_fx="sum")

    def update(
        self, processed: Tensor, clean: Tensor, audiogram: AudiogramLike, lengths: Tensor | None = None
    ) -> None:
        """Score a batch.

        An item of which there is no score (silence, NaN, less than 0.7 s) is left out, counted in ``failed``, and said.

        Args:
            audiogram: one ear for all, one an item, or (batch, 8) dB HL.
            lengths: samples of each item, where the batch is padded.

        Shape: (batch, time) or (time,), the same for both; ``lengths`` (batch,). ValueError for others, for audiograms
        that are none, or not one or one an item, and for lengths beyond the signals.
        """
        if processed.shape != clean.shape or processed.ndim not in (1, 2):
            raise ValueError(
                f"processed {tuple(processed.shape)} and clean {tuple(clean.shape)}; allowed: (batch, time) or (time,), "
                "the same for both"
            )
        heard, reference = (
            torch.atleast_2d(signal.detach()).to("cpu", torch.float64) for signal in (processed, clean)
        )
        ears = _ears(audiogram, len(heard))
        ends = _ends(lengths, *heard.shape)
        tasks, levels = [], []
        items = zip(heard, reference, ears, ends, strict=True)
        for number, (signal, target, ear, end) in enumerate(items, start=int(self.seen)):
            if self.limit is not None and number >= self.limit:
                break
            try:
                pair = check_pair(target[:end], signal[:end], self.sample_rate, self.full_scale_spl)
            except ValueError as error:
                self.failed += 1
                warnings.warn(f"HASPI leaves out item {number}: {error}", stacklevel=2)
                continue
            seed = (self.seed + number) % 2**32
            tasks.append((number, (*pair, ear, self.sample_rate, self.full_scale_spl, seed)))
            levels.append(float(level_spl(signal[:end], self.full_scale_spl)))
        scores = {}
        for (number, _), score in run_parallel(_score, tasks, jobs=1 if len(tasks) < 2 else self.jobs):
            if score is None:
                raise ValueError(f"item {number}: the process that scored it died")
            scores[number] = score
        self.seen += len(heard)
        self.count += len(scores)
        self.total += sum(scores[number] for number, _ in tasks)  # in one order
        self.total_level += sum(levels)

    def compute(self) -> Tensor:
        """Mean score, float32; NaN where nothing was scored."""
        return self.total / self.count

    @property
    def level(self) -> Tensor:
        """Mean level in dB SPL of what was scored, of this process; NaN where nothing was."""
        return self.total_level / self.count


def _score(task: tuple[int, tuple[Any, ...]]) -> float:
    return pyclarity_score("haspi", *task[1])


def _ends(lengths: Tensor | None, batch: int, time: int) -> list[int]:
    if lengths is None:
        return [time] * batch
    ends = [int(n) for n in lengths]
    if len(ends) != batch:
        raise ValueError(f"{len(ends)} lengths of {batch} items; allowed: one an item")
    if wrong := [end for end in ends if not 0 <= end <= time]:
        raise ValueError(f"a length is {wrong[0]}; allowed: 0 to {time} samples")
    return ends


def _ears(audiogram: AudiogramLike, batch: int) -> list[Audiogram]:
    if isinstance(audiogram, Audiogram):
        return [audiogram] * batch
    if isinstance(audiogram, Tensor):
        if audiogram.shape not in ((len(FREQUENCIES),), (batch, len(FREQUENCIES))):
            raise ValueError(
                f"audiogram of shape {tuple(audiogram.shape)}; allowed: (8,) or ({batch}, 8) dB HL"
            )
        rows = audiogram.detach().expand(batch, -1).double().tolist()
        return [Audiogram(tuple(row)) for row in rows]
    if not isinstance(audiogram, Sequence) or not all(isinstance(ear, Audiogram) for ear in audiogram):
        found, tensor = type(audiogram).__name__, f"an (8,) or ({batch}, 8) tensor"
        raise ValueError(f"audiogram is {found}; allowed: an Audiogram, one an item, or {tensor}")
    if len(audiogram) != batch:
        raise ValueError(
            f"{len(audiogram)} audiograms of {batch} items; allowed: one for all, or one an item"
        )
    return list(audiogram)
