"""HASPI and HASQI as metrics of torchmetrics, for validation loops. Needs the extra ``train`` (torchmetrics)."""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL, Audiogram
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds, has_listeners
from hlsim.calibration import check_full_scale, level_spl
from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform
from hlsim.extras import require
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import check_pair, check_seed
from hlsim.parallel import check_jobs, one_thread, run_parallel

_Metric: Any = require("torchmetrics", "train").Metric


class _MeanScore(_Metric):
    """What ``HASPI`` and ``HASQI`` share; ``score`` is the function that each is the mean of."""

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    plot_lower_bound = 0.0
    plot_upper_bound = 1.0

    score: ClassVar[Callable[..., Tensor]]

    total: Tensor
    total_level: Tensor
    total_ears: Tensor
    count: Tensor
    count_ears: Tensor
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
        if limit is not None and (type(limit) is not int or limit < 1):
            raise ValueError(f"limit is {limit!r}; allowed: a whole number of 1 or more, or None")
        check_jobs(jobs)
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.seed, self.limit, self.jobs = check_seed(seed), limit, jobs
        for name in ("total", "total_level"):
            self.add_state(name, torch.tensor(0.0), dist_reduce_fx="sum")
        for name in ("count", "seen", "failed"):
            self.add_state(name, torch.tensor(0), dist_reduce_fx="sum")
        for name in ("total_ears", "count_ears"):
            self.add_state(name, torch.zeros(2), dist_reduce_fx="sum")
        # a MetricCollection merges metrics whose states are equal, as after a batch of which none has a score
        made_as = repr((type(self), self.sample_rate, self.full_scale_spl, self.seed, self.limit))
        self.add_state("made_as", torch.tensor(zlib.crc32(made_as.encode())), dist_reduce_fx="max")

    def forward(self, *args: Any, **kwargs: Any) -> Tensor:
        """``update``, and the mean score of this batch alone, in this process.

        torchmetrics' own resets before each: ``limit`` and ``seed`` would begin anew.
        """
        total, count = self.total.clone(), self.count.clone()
        self.update(*args, **kwargs)
        self._forward_cache: Tensor = (self.total - total) / (self.count - count)
        return self._forward_cache

    def update(
        self,
        processed: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike,
        lengths: Lengths | None = None,
    ) -> None:
        """Score a batch.

        An item of which there is no score (its clean speech silent or soft, NaN, less than 0.7 s) is left out, counted in
        ``failed``, and said; silence in place of speech is scored, as ``haspi`` scores it. Of two channels, left and
        right, the better ear's score and level count, and ``ears`` tells each ear's.

        Args:
            audiogram: one ear for all, one an item, or (batch, 8) dB HL; of two channels a ``Listener`` or one an item,
                whose missing ear is left out, a pair of left and right, (2, 8) or (batch, 2, 8) dB HL.
            lengths: samples of each item, or shares of the time above 0 to 1, where the batch is padded.

        Shape: (batch, time) or (time,), or (batch, 2, time), the same for both; ``lengths`` (batch,). ValueError for
        others, for signals that ``haspi`` does not take, for audiograms that are none, or not one or one an item, and for
        lengths beyond the signals.
        """
        check_waveform(processed, "processed")
        check_waveform(clean, "clean")
        shape = processed.shape
        if (
            shape != clean.shape
            or len(shape) not in (1, 2, 3)
            or (len(shape) == 3 and shape[1] != 2)
        ):
            raise ValueError(
                f"processed {tuple(shape)} and clean {tuple(clean.shape)}; allowed: (batch, time), (time,) or (batch, 2, "
                "time), the same for both"
            )
        sides = 2 if len(shape) == 3 else 1
        heard, reference = (
            torch.atleast_2d(signal.detach())
            .to(processed.device, torch.float64)
            .reshape(-1, sides, shape[-1])
            for signal in (processed, clean)
        )
        ears = _ears(audiogram, len(heard), sides)
        items_and_time = torch.Size((len(heard), shape[-1]))
        ends = (
            [shape[-1]] * len(heard)
            if lengths is None
            else check_lengths(lengths, items_and_time).tolist()
        )
        items: list[_Item] = []
        pairs = zip(heard, reference, ears, ends, strict=True)
        for number, (signals, targets, own, end) in enumerate(pairs, start=int(self.seen)):
            if self.limit is not None and number >= self.limit:
                break
            reasons = []
            for side, ear in own.items():
                item = _Item(
                    number,
                    side,
                    signals[side, :end],
                    targets[side, :end],
                    ear,
                    (self.seed + number) % 2**32,
                )
                try:
                    check_pair(item.clean, item.processed, self.sample_rate, self.full_scale_spl)
                    items.append(item)
                except ValueError as error:
                    reasons.append(error)
            if len(reasons) == len(own):
                self.failed += 1
                name = self.score.__name__.upper()
                warnings.warn(f"{name} leaves out item {number}: {reasons[0]}", stacklevel=2)
        self.seen += len(heard)
        best: dict[int, tuple[float, _Item]] = {}
        for item, score in zip(items, self._scores(items), strict=True):
            if sides == 2:
                self.total_ears[item.side] += score
                self.count_ears[item.side] += 1
            if item.number not in best or score > best[item.number][0]:
                best[item.number] = score, item
        self.count += len(best)
        self.total += sum(score for score, _ in best.values())
        self.total_level += sum(
            float(level_spl(item.processed, self.full_scale_spl)) for _, item in best.values()
        )

    def compute(self) -> Tensor:
        """Mean score, float32; NaN where nothing was scored."""
        return self.total / self.count

    @property
    def ears(self) -> Tensor:
        """Mean score of the left and of the right ear, of this process; NaN without two channels. Shape: (2,)."""
        return self.total_ears / self.count_ears

    @property
    def level(self) -> Tensor:
        """Mean level in dB SPL of what was scored, of this process; NaN where nothing was."""
        return self.total_level / self.count

    def _scores(self, items: list[_Item]) -> list[float]:
        """In the items' order: a CPU scores one by one anyway, a GPU all at once."""
        together = 1 if items and items[0].clean.device.type == "cpu" else max(1, len(items))
        batches = [items[start : start + together] for start in range(0, len(items), together)]
        tasks = [
            _Task(number, self.score, batch, self.sample_rate, self.full_scale_spl)
            for number, batch in enumerate(batches)
        ]
        made: dict[int, list[float]] = {}
        for task, scores in run_parallel(_score, tasks, jobs=1 if len(tasks) < 2 else self.jobs):
            if scores is None:
                raise ValueError(
                    f"item {task.number} of the batch: the process that scored it died"
                )
            made[task.number] = scores
        return [score for number in range(len(tasks)) for score in made[number]]


class HASPI(_MeanScore):
    """Mean HASPI v2 of processed speech over all items since the last ``reset``.

    It rewards any gain: log ``level``, the mean level in dB SPL, beside it. The figures are pyclarity's, which takes
    44.1 kHz for 44: its noise is drawn, and the precision is double. On a CPU a second of audio
    takes about 0.12 s, on one core; ``limit`` bounds what a validation epoch costs.

    In a LightningModule ``self.haspi = HASPI(sample_rate=16000)``, in ``validation_step``
    ``self.haspi.update(aided, clean, audiogram); self.log("haspi", self.haspi)``.

    Args:
        sample_rate, full_scale_spl: as ``haspi``.
        seed: item i since the last reset takes ``seed`` + i, so that epochs can be compared.
        limit: items scored since the last reset, in each process; the others are passed over. None scores all.
        jobs: processes, where the signals are on a CPU; None takes all cores. More than one need joblib (extra ``eval``).
        options: of ``torchmetrics.Metric``.
    """

    score = staticmethod(haspi)


class HASQI(_MeanScore):
    """Mean HASQI v2 of processed speech over all items since the last ``reset``; all else as ``HASPI``.

    Its reference is the clean speech with NAL-R, and whether enough is heard does not count. About 0.2 s for a second of
    audio.
    """

    score = staticmethod(hasqi)


class _Item(NamedTuple):
    """One ear of an item, (time,) each; ``side`` is 0 or, of a right ear, 1."""

    number: int
    side: int
    processed: Tensor
    clean: Tensor
    ear: Audiogram
    seed: int


class _Task(NamedTuple):
    """Items that are scored together."""

    number: int
    score: Callable[..., Tensor]
    items: list[_Item]
    sample_rate: int
    full_scale_spl: float


@one_thread()
@torch.no_grad()
def _score(task: _Task) -> list[float]:
    _, _, processed, clean, ears, seeds = zip(*task.items, strict=True)
    pad = torch.nn.utils.rnn.pad_sequence
    scores = task.score(
        pad(list(processed), batch_first=True),
        pad(list(clean), batch_first=True),
        list(ears),
        sample_rate=task.sample_rate,
        full_scale_spl=task.full_scale_spl,
        lengths=[len(signal) for signal in clean],
        noise="seeded",
        seed=list(seeds),
        whole_khz=True,
    )
    return [float(score) for score in scores]


def _ears(audiogram: AudiogramLike, batch: int, sides: int) -> list[dict[int, Audiogram]]:
    """Each item's ears by channel, without those that are missing."""
    shapes = [(*lead, *((2,) if sides == 2 else ()), len(FREQUENCIES)) for lead in ((), (batch,))]
    levels = as_thresholds(
        audiogram, highest=HIGHEST_LEVEL, consumer="a score", allow_missing=sides == 2
    ).detach()
    if levels.shape not in shapes or (sides == 1 and has_listeners(audiogram)):
        found, (alone, each) = tuple(levels.shape), shapes
        raise ValueError(f"audiogram of shape {found}; allowed: {alone} or {each} dB HL")
    rows = levels.expand(shapes[1]).reshape(batch, sides, -1).double().tolist()
    return [
        {side: Audiogram(row) for side, row in enumerate(own) if row[0] == row[0]} for own in rows
    ]
