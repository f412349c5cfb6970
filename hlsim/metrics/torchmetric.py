"""HASPI, HASQI and HAAQI as metrics of torchmetrics, for validation loops.

A metric collects the mean score over batches. The classes need the extra ``train``.
"""

from __future__ import annotations

import warnings
import zlib
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds, has_listeners
from hlsim.calibration import PASCAL_SPL, check_full_scale, level_spl
from hlsim.checks import Lengths, check_lengths, check_number, check_rate, check_waveform
from hlsim.extras import require
from hlsim.metrics.haaqi_score import haaqi
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import check_pair, scores_or_errors

_Metric: Any = require("torchmetrics", "train").Metric


class _MeanScore(_Metric):
    """Mean of a score over all items since the last ``reset``.

    Subclasses set ``score`` to the function that computes the score of each item.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    plot_lower_bound = 0.0
    plot_upper_bound = 1.0
    plot = _Metric._plot

    score: ClassVar[Callable[..., Tensor]]

    total: Tensor
    total_level: Tensor
    count: Tensor
    seen: Tensor
    failed: Tensor

    def __init__(
        self,
        sample_rate: int = 16000,
        *,
        full_scale_spl: float = PASCAL_SPL,
        limit: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        if limit is not None:
            check_number("limit", limit, 1, whole=True)
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.limit = limit
        for name in ("total", "total_level"):
            self.add_state(name, torch.tensor(0.0), dist_reduce_fx="sum")
        for name in ("count", "seen", "failed"):
            self.add_state(name, torch.tensor(0), dist_reduce_fx="sum")
        # A MetricCollection merges metrics with equal states, such as those of a batch without any
        # score. This state keeps metrics with different settings apart.
        settings = repr((type(self), self.sample_rate, self.full_scale_spl, limit))
        signature = torch.tensor(zlib.crc32(settings.encode()))
        self.add_state("signature", signature, dist_reduce_fx="max")

    def forward(self, *args: Any, **kwargs: Any) -> Tensor:
        """Update the metric by a batch, and return the mean score of this batch in this process.

        The arguments are those of ``update``. (The method of torchmetrics resets the metric before
        each batch, so that ``limit`` would begin again.)
        """
        total, count = self.total.clone(), self.count.clone()
        self.update(*args, **kwargs)
        self._forward_cache: Tensor = (self.total - total) / (self.count - count)
        return self._forward_cache

    @torch.no_grad()
    def update(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike,
        lengths: Lengths | None = None,
    ) -> None:
        """Score a batch, and add the scores to the mean.

        An item that cannot be scored (clean speech that is silent or soft, NaN, less than 0.7 s) is
        left out with a warning and counted in ``failed``. A silent output is
        scored. With two channels, left and right, the score and the level of the better ear count.

        Args:
            output: Outputs of the compensator. Shape: (time,), (batch, time) or, for two ears,
                (batch, 2, time).
            clean: Clean speech of the same shape.
            audiogram: One ear, or one per item. For two channels a ``Listener``, a pair of left
                and right ear, or one of these per item.
            lengths: Number of samples of each item of a padded batch.
                Shape: (batch,).

        Raises:
            ValueError: The shapes do not fit, the signals are not what ``haspi`` accepts, or
                ``audiogram`` or ``lengths`` are not as described.
        """
        check_waveform(output, "output")
        check_waveform(clean, "clean")
        check_pair(output, clean)
        two_ears = output.ndim == 3 and output.shape[1] == 2
        if output.ndim > 2 and not two_ears:
            raise ValueError(
                "expected output and clean of shape (time,), (batch, time) or (batch, 2, time), "
                f"got {tuple(output.shape)}"
            )
        sides, time = 2 if two_ears else 1, output.shape[-1]
        outputs, references = (
            signal.double().reshape(-1, sides, time) for signal in (output, clean)
        )
        items = len(outputs)
        ears = _thresholds(audiogram, items, sides)
        ends = torch.full((items,), time)
        if lengths is not None:
            ends = check_lengths(lengths, torch.Size((items, time)))

        first = int(self.seen)
        self.seen += items
        if self.limit is not None:
            items = min(items, self.limit - first)
            if items <= 0:
                return
        rows, sides_of_rows = ears[:items].isfinite().all(-1).nonzero(as_tuple=True)
        scores = scores_or_errors(
            type(self).score,
            outputs[rows, sides_of_rows],
            references[rows, sides_of_rows],
            ears[rows, sides_of_rows],
            ends[rows].tolist(),
            sample_rate=self.sample_rate,
            full_scale_spl=self.full_scale_spl,
        )
        for item in range(items):
            of_item = (rows == item).nonzero().flatten().tolist()
            scored = [
                (float(scores[row]), row) for row in of_item if isinstance(scores[row], Tensor)
            ]
            if not scored:
                self.failed += 1
                reason = scores[of_item[0]]
                message = f"{type(self).__name__} leaves out item {first + item}: {reason}"
                warnings.warn(message, stacklevel=2)
                continue
            score, row = max(scored)
            samples = outputs[item, sides_of_rows[row], : ends[item]]
            self.total += score
            self.total_level += float(level_spl(samples, self.full_scale_spl))
            self.count += 1

    def compute(self) -> Tensor:
        """Return the mean score of all items since the last reset, NaN if none was scored.

        Shape: (), float32.
        """
        return self.total / self.count

    @property
    def level(self) -> Tensor:
        """Mean level in dB SPL of the scored signals in this process, NaN if nothing was scored."""
        return self.total_level / self.count


class HASPI(_MeanScore):
    """Mean HASPI v2, the intelligibility of outputs, over all items since ``reset``.

    HASPI rewards any gain, so log the mean level of the outputs, the attribute ``level``, as well.
    The score of an item is that of ``haspi`` with the same settings, in double precision. On a CPU
    one second of audio takes about 0.12 s on one core; ``limit`` bounds the cost of a validation
    epoch.

    In a LightningModule, write ``self.haspi = HASPI(sample_rate=16000)`` in the constructor, and
    ``self.haspi.update(output, clean, audiogram); self.log("haspi", self.haspi)`` in
    ``validation_step``. The level of the outputs is then ``self.haspi.level``.

    Attributes:
        level: Mean level in dB SPL of the outputs that were scored in this process.
        count: Number of items that were scored.
        failed: Number of items that could not be scored.
        seen: Number of all items, with those beyond ``limit``.

    Args:
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        limit: Number of items that are scored from one reset to the next in each process; the
            others are passed over. None scores all.
        options: Keyword arguments of ``torchmetrics.Metric``.

    Raises:
        ValueError: A value is out of range.

    >>> from hlsim import example_speech
    >>> speech, metric = example_speech()[:16000], HASPI()
    >>> metric.update(speech, speech, "NH")
    >>> bool(metric.compute() > 0.9), int(metric.count)
    (True, 1)
    """

    score = staticmethod(haspi)


class HASQI(_MeanScore):
    """Mean HASQI v2, the quality of outputs, over all items since the last ``reset``.

    The arguments and attributes are those of ``HASPI``. Outputs are compared with clean speech that
    NAL-R has amplified, and every difference lowers the score. On a CPU one second of audio takes
    about 0.2 s.

    >>> from hlsim import example_speech
    >>> speech, metric = example_speech()[:16000], HASQI()
    >>> round(float(metric(speech, speech, "NH")), 2)
    0.99
    """

    score = staticmethod(hasqi)


class HAAQI(_MeanScore):
    """Mean HAAQI v1, the quality of music, over all items since the last ``reset``.

    The arguments and attributes are those of ``HASPI``. Outputs are compared with clean music that
    NAL-R has amplified. With stereo music the better ear counts.

    >>> seconds = torch.arange(24000) / 24000
    >>> music = 0.02 * torch.sin(2 * torch.pi * 220.0 * seconds) * torch.exp(-3 * seconds)
    >>> metric = HAAQI(sample_rate=24000)
    >>> metric.update(torch.stack([music, 0.1 * music])[None], music.expand(1, 2, -1), ["NH", "NH"])
    >>> int(metric.count)
    1
    """

    score = staticmethod(haaqi)


def _thresholds(audiogram: AudiogramLike, items: int, sides: int) -> Tensor:
    """Return the thresholds of each item's ears on the CPU.

    Shape: (items, sides, 8) dB HL.
    """
    levels = as_thresholds(audiogram, highest=HIGHEST_LEVEL)
    one_for_all = (2, len(FREQUENCIES)) if sides == 2 else (len(FREQUENCIES),)
    fits = levels.shape in (one_for_all, (items, *one_for_all))
    if not fits or (sides == 1 and has_listeners(audiogram)):
        raise ValueError(
            f"expected an audiogram of shape {one_for_all} or {(items, *one_for_all)}, "
            f"got {tuple(levels.shape)}"
        )
    levels = levels.detach().cpu().expand(items, *one_for_all)
    return levels.reshape(items, sides, len(FREQUENCIES))
