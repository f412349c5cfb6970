"""HASPI, HASQI and HAAQI as metrics of torchmetrics, for validation loops.

A metric collects the mean score over batches. The classes need the extra ``train``.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.thresholds import AudiogramLike, as_thresholds, has_listeners
from hlsim.calibration import PASCAL_SPL, check_full_scale, level_spl
from hlsim.checks import (
    Lengths,
    check_choice,
    check_lengths,
    check_number,
    check_rate,
    check_waveform,
    silence_after,
)
from hlsim.extras import require
from hlsim.metrics.haaqi_score import haaqi
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import Noise, check_seed

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
        full_scale_spl: float = PASCAL_SPL,
        noise: Noise = "expected",
        seed: int = 0,
        whole_khz: bool = False,
        limit: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        if self.dist_sync_on_step:
            raise ValueError(
                "dist_sync_on_step=True is not supported, because a call returns the mean of this "
                "process's batch; call compute() for the mean over all processes"
            )
        if limit is not None:
            check_number("limit", limit, 1, whole=True)
        check_choice("noise", noise, Noise)
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.noise: Noise = noise
        self.seed = check_seed(seed)
        self.whole_khz = whole_khz
        self.limit = limit
        for name in ("total", "total_level"):
            self.add_state(name, torch.tensor(0.0), dist_reduce_fx="sum")
        for name in ("count", "seen", "failed"):
            self.add_state(name, torch.tensor(0), dist_reduce_fx="sum")
        for name in ("total_ears", "count_ears"):
            self.add_state(name, torch.zeros(2), dist_reduce_fx="sum")
        # A MetricCollection merges metrics with equal states, such as those of a batch without any
        # score. This state keeps metrics with different settings apart.
        settings = type(self), self.sample_rate, self.full_scale_spl, noise, seed, whole_khz, limit
        signature = torch.tensor(zlib.crc32(repr(settings).encode()))
        self.add_state("signature", signature, dist_reduce_fx="max")

    def forward(self, *args: Any, **kwargs: Any) -> Tensor:
        """Update the metric by a batch, and return the mean score of this batch in this process.

        The arguments are those of ``update``. (The method of torchmetrics resets the metric before
        each batch, so that ``limit`` and ``seed`` would begin again.)
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
        """Score a batch, and add the scores to the mean.

        An item that cannot be scored (clean speech that is silent or soft, NaN, less than 0.7 s) is
        left out with a warning and counted in ``failed``. Silence in place of processed speech is
        scored. With two channels, left and right, the score and the level of the better ear count,
        and ``ears`` has the mean of each ear.

        Args:
            processed: Outputs of the compensator. Shape: (time,), (batch, time) or, for two ears,
                (batch, 2, time).
            clean: Clean speech of the same shape.
            audiogram: One ear, or one per item. For two channels a ``Listener``, whose missing ear
                is left out, a pair of left and right ear, or one of these per item.
            lengths: Number of samples of each item, or its share of the time, for a padded batch.
                Shape: (batch,).

        Raises:
            ValueError: The shapes do not fit, the signals are not what ``haspi`` accepts, or
                ``audiogram`` or ``lengths`` are not as described.
        """
        check_waveform(processed, "processed")
        check_waveform(clean, "clean")
        shape = processed.shape
        two_ears = len(shape) == 3 and shape[1] == 2
        if shape != clean.shape or not (two_ears or len(shape) in (1, 2)):
            raise ValueError(
                "expected processed and clean of the same shape, (time,), (batch, time) or "
                f"(batch, 2, time), got {tuple(shape)} and {tuple(clean.shape)}"
            )
        items = 1 if len(shape) == 1 else shape[0]
        time = shape[-1]
        sides = 2 if two_ears else 1
        thresholds = _thresholds(audiogram, items, sides)
        ends = torch.full((items,), time)
        if lengths is not None:
            ends = check_lengths(lengths, torch.Size((items, time)))

        first = int(self.seen)
        self.seen += items
        if self.limit is not None:
            items = max(0, min(items, self.limit - first))
        processed, clean = (
            silence_after(
                signal.detach().to(processed.device, torch.float64).reshape(-1, sides, time),
                ends[:, None].expand(-1, sides),
            )
            for signal in (processed, clean)
        )
        scores = torch.full((items, sides), math.nan, dtype=torch.float64)
        reasons: dict[int, str] = {}
        pairs = thresholds[:items].isfinite().all(-1).nonzero().tolist()
        results = self._score(pairs, first, processed, clean, thresholds, ends)
        for (item, side), result in zip(pairs, results, strict=True):
            if isinstance(result, str):
                reasons.setdefault(item, result)
            else:
                scores[item, side] = result
        is_scored = ~scores.isnan()
        for item in range(items):
            if not is_scored[item].any():
                self.failed += 1
                message = f"{type(self).__name__} leaves out item {first + item}: {reasons[item]}"
                warnings.warn(message, stacklevel=2)
                continue
            score, side = scores[item].nan_to_num(-math.inf).max(-1)
            samples = processed[item, int(side), : int(ends[item])]
            self.total += float(score)
            self.total_level += float(level_spl(samples, self.full_scale_spl))
            self.count += 1
        if two_ears:
            self.total_ears += scores.nan_to_num(0.0).sum(0).to(self.total_ears)
            self.count_ears += is_scored.sum(0).to(self.count_ears)

    def compute(self) -> Tensor:
        """Return the mean score of all items since the last reset, NaN if none was scored.

        Shape: (), float32.
        """
        return self.total / self.count

    def merge_state(self, incoming_state: Any) -> None:
        """Add the items that another metric has scored to the mean.

        Args:
            incoming_state: The other metric, or its ``metric_state``.

        Raises:
            ValueError: The other metric has other settings, such as another sample rate.
        """
        state = incoming_state
        if isinstance(incoming_state, _Metric):
            state = incoming_state.metric_state
        signature = state.get("signature", self.signature) if isinstance(state, dict) else None
        if signature is not None and int(signature) != int(self.signature):
            raise ValueError(
                f"cannot merge two {type(self).__name__} metrics with different settings; "
                "construct both with the same sample_rate, full_scale_spl, noise, seed, "
                "whole_khz and limit"
            )
        super().merge_state(incoming_state)

    def plot(self, val: Any = None, ax: Any = None) -> Any:
        """Plot one or several values of the metric by matplotlib.

        Args:
            val: Value, or list of values, that a call or ``compute`` has returned; by default that
                of ``compute`` now.
            ax: Axes of matplotlib to draw into; by default those of a new figure.

        Returns:
            Figure and axes.
        """
        return self._plot(val, ax)

    @property
    def ears(self) -> Tensor:
        """Mean score of the left and of the right ear since the last reset, in this process.

        Both are NaN if the signals had one channel.

        Shape: (2,).
        """
        return self.total_ears / self.count_ears

    @property
    def level(self) -> Tensor:
        """Mean level in dB SPL of the scored signals in this process, NaN if nothing was scored."""
        return self.total_level / self.count

    @torch.no_grad()
    def _score(
        self,
        pairs: list[list[int]],
        first: int,
        processed: Tensor,
        clean: Tensor,
        thresholds: Tensor,
        ends: Tensor,
    ) -> list[float | str]:
        """Return the score of each pair of item and ear, or the reason why there is none.

        Args:
            pairs: Indices of item and ear (0 for left or only, 1 for right).
            first: Number of items that were seen in earlier batches, for the seeds.
            processed, clean: Signals. Shape: (items, ears, time).
            thresholds: Ears in dB HL. Shape: (items, ears, 8).
            ends: Number of samples of each item before padding. Shape: (items,).
        """
        if not pairs:
            return []
        items, sides = torch.tensor(pairs).unbind(-1)
        try:
            scores = type(self).score(
                *(values[items, sides] for values in (processed, clean, thresholds)),
                sample_rate=self.sample_rate,
                full_scale_spl=self.full_scale_spl,
                lengths=ends[items],
                noise=self.noise,
                seed=((self.seed + first + items) % 2**32).tolist(),
                whole_khz=self.whole_khz,
            )
        except ValueError as error:
            if len(pairs) == 1:
                return [str(error)]
            # One pair without a score stops them all, so they are scored one by one.
            batch = processed, clean, thresholds, ends
            return [self._score([pair], first, *batch)[0] for pair in pairs]
        results: list[float | str] = scores.tolist()
        return results


class HASPI(_MeanScore):
    """Mean HASPI v2, the intelligibility of processed speech, over all items since ``reset``.

    HASPI rewards any gain, so log the mean level of the outputs, the attribute ``level``, as well.
    The score of an item is that of ``haspi`` with the same settings, in double precision. On a CPU
    one second of audio takes about 0.12 s on one core; ``limit`` bounds the cost of a validation
    epoch.

    In a LightningModule, write ``self.haspi = HASPI(sample_rate=16000)`` in the constructor, and
    ``self.haspi.update(output, clean, audiogram); self.log("haspi", self.haspi)`` in
    ``validation_step``. The level of the outputs is then ``self.haspi.level``.

    Attributes:
        level: Mean level in dB SPL of the outputs that were scored in this process.
        ears: Mean score of the left and of the right ear in this process, with shape (2,); NaN if
            the signals had one channel.
        count: Number of items that were scored.
        failed: Number of items that could not be scored.
        seen: Number of all items, with those beyond ``limit``.

    Args:
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        noise: Internal noise of the ear: ``"expected"``, its mean effect (for HASQI and HAAQI a
            noise that is always the same); ``"seeded"``, that of pyclarity; or ``"none"``.
        seed: Seed of the first item since the last reset, for ``noise="seeded"``. The seed rises by
            1 with each item, so that epochs can be compared.
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        limit: Number of items that are scored from one reset to the next in each process; the
            others are passed over. None scores all.
        options: Keyword arguments of ``torchmetrics.Metric``.

    Raises:
        ValueError: A value out of range, or ``dist_sync_on_step=True``.

    >>> from hlsim import example_speech
    >>> speech, metric = example_speech()[:16000], HASPI()
    >>> metric.update(speech, speech, "NH")
    >>> bool(metric.compute() > 0.9), int(metric.count)
    (True, 1)
    """

    score = staticmethod(haspi)


class HASQI(_MeanScore):
    """Mean HASQI v2, the quality of processed speech, over all items since the last ``reset``.

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
    """Mean HAAQI v1, the quality of processed music, over all items since the last ``reset``.

    The arguments and attributes are those of ``HASPI``. Outputs are compared with clean music that
    NAL-R has amplified. With stereo music the better ear counts, and the attribute ``ears`` has the
    mean of each ear.

    >>> seconds = torch.arange(24000) / 24000
    >>> music = 0.02 * torch.sin(2 * torch.pi * 220.0 * seconds) * torch.exp(-3 * seconds)
    >>> metric = HAAQI(sample_rate=24000)
    >>> metric.update(torch.stack([music, 0.1 * music])[None], music.expand(1, 2, -1), ["NH", "NH"])
    >>> bool(metric.ears[0] > metric.ears[1])
    True
    """

    score = staticmethod(haaqi)


def _thresholds(audiogram: AudiogramLike, items: int, sides: int) -> Tensor:
    """Return the thresholds of each item's ears on the CPU, NaN for missing ears.

    Shape: (items, sides, 8) dB HL.
    """
    levels = as_thresholds(audiogram, highest=HIGHEST_LEVEL, allow_missing=sides == 2)
    one_for_all = (2, len(FREQUENCIES)) if sides == 2 else (len(FREQUENCIES),)
    fits = levels.shape in (one_for_all, (items, *one_for_all))
    if not fits or (sides == 1 and has_listeners(audiogram)):
        raise ValueError(
            f"expected an audiogram of shape {one_for_all} or {(items, *one_for_all)}, "
            f"got {tuple(levels.shape)}"
        )
    levels = levels.detach().cpu().expand(items, *one_for_all)
    return levels.reshape(items, sides, len(FREQUENCIES))
