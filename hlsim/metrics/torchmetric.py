"""HASPI, HASQI, HAAQI and MBSTOI as metrics of torchmetrics, for validation loops.

A metric collects the mean score over batches. The classes need the extra ``train``.

This module does without ``from __future__ import annotations``, because ``torch.jit.script`` does
not understand annotations that are strings in a class.
"""

import warnings
import zlib
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.thresholds import (
    AudiogramLike,
    as_thresholds,
    check_two_channels,
    has_listeners,
)
from hlsim.calibration import PASCAL_SPL, check_full_scale, level_spl
from hlsim.checks import Lengths, check_lengths, check_number, check_rate
from hlsim.extras import require
from hlsim.metrics.haaqi_score import haaqi
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.mbstoi_score import mbstoi
from hlsim.metrics.pair import match_pair, scores_or_errors

_Metric: Any = require("torchmetrics", "train").Metric


class _MeanScore(_Metric):
    """Mean of a score over the items that were scored since the last ``reset``.

    Items that cannot be scored do not count, and neither do those beyond ``limit``. This is the
    base class of the metrics, whose arguments ``HASPI`` describes.

    Subclasses set ``score`` to the function that computes scores, and ``ears_per_score`` to 2 if
    both ears of a listener have one score in common.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    plot_lower_bound = 0.0
    plot_upper_bound = 1.0
    plot = _Metric._plot

    score: ClassVar[Callable[..., Tensor]]
    ears_per_score: ClassVar[int] = 1

    total: Tensor
    total_level: Tensor
    count: Tensor
    seen: Tensor
    failed: Tensor

    def __init__(
        self,
        sample_rate: int = 16000,
        *,
        audiogram: AudiogramLike | None = None,
        full_scale_spl: float = PASCAL_SPL,
        limit: int | None = None,
        **options: Any,
    ) -> None:
        if options.get("dist_sync_on_step"):
            raise ValueError(
                "dist_sync_on_step=True is not supported, because the value of a step is that of "
                "one process; leave it out, and call compute() for the mean over all processes"
            )
        super().__init__(**options)
        if limit is not None:
            check_number("limit", limit, 1, whole=True)
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.limit = limit
        self.audiogram = audiogram
        for name in ("total", "total_level"):
            # Whatever torch's default type is: sums in half precision soon stop to grow.
            zero = torch.tensor(0.0, dtype=torch.float32)
            self.add_state(name, zero, dist_reduce_fx="sum")
        for name in ("count", "seen", "failed"):
            self.add_state(name, torch.tensor(0), dist_reduce_fx="sum")
        # A MetricCollection merges metrics with equal states, such as those of a batch without any
        # score. This state keeps metrics with different settings apart.
        levels = None
        if audiogram is not None:
            levels = as_thresholds(audiogram, highest=HIGHEST_LEVEL).tolist()
        settings = repr((type(self), self.sample_rate, levels, self.full_scale_spl, limit))
        signature = torch.tensor(zlib.crc32(settings.encode()))
        self.add_state("signature", signature, dist_reduce_fx="max")

    @torch.jit.unused
    def forward(self, *args: Any, **kwargs: Any) -> Tensor:
        """Update the metric by a batch, and return the mean score of this batch in this process.

        The arguments are those of ``update``. The result is NaN if no item of the batch was scored.
        This method replaces that of torchmetrics, which resets the metric before each batch, so
        that ``limit`` would begin again.
        """
        total, count = self.total.clone(), self.count.clone()
        self.update(*args, **kwargs)
        self._forward_cache: Tensor = (self.total - total) / (self.count - count)
        return self._forward_cache

    def merge_state(self, incoming_state: "dict[str, Any] | _MeanScore") -> None:
        """Add the scores of another metric with the same settings.

        Args:
            incoming_state: The other metric, or its ``metric_state``.

        Raises:
            ValueError: The settings differ: sample rate, full scale, limit, audiogram or class.
        """
        state = incoming_state
        if isinstance(state, _MeanScore):
            state = state.metric_state
        self._check_signature(state.get("signature", -1))
        super().merge_state(state)

    def _check_signature(self, signature: Any) -> None:
        """Raise ValueError unless a state has the signature, a hash, of this metric's settings."""
        if int(signature) != int(self.signature):
            raise ValueError(
                f"expected the state of {type(self).__name__} with the settings of this metric; "
                "create both with the same sample_rate, audiogram, full_scale_spl and limit"
            )

    def _load_from_state_dict(
        self, state_dict: "dict[str, Any]", prefix: str, *arguments: Any, **settings: Any
    ) -> None:
        """Load the metric's part of a state dict, or raise ValueError if the settings differ."""
        self._check_signature(state_dict.get(f"{prefix}signature", self.signature))
        super()._load_from_state_dict(state_dict, prefix, *arguments, **settings)

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = ()) -> Any:
        """Apply ``fn``, such as that of ``.to()``, to the state.

        Only ``set_dtype`` changes the type of the sums, which need the precision of float32.
        """

        def move(tensor: Tensor) -> Tensor:
            return fn(tensor).to(tensor.dtype)

        return super()._apply(fn if self._dtype_convert else move, exclude_state)

    @torch.no_grad()
    def update(
        self,
        output: Tensor,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        lengths: Lengths | None = None,
    ) -> None:
        """Score a batch, and add the scores to the mean.

        An item that cannot be scored (clean speech that is silent or soft, NaN, infinity, less than
        0.7 s) is left out with a warning and counted in ``failed``. A silent output is scored. With
        two channels, left and right, the score and the level of the better ear count, and an item
        is left out if one of its ears cannot be scored.

        Args:
            output: Outputs of the compensator. Shape: (time,), (batch, time), (batch, 1, time) or,
                for two ears, (batch, 2, time).
            clean: Clean speech of the same shape. The longer of both is cut with a warning if they
                differ by up to 0.1 s.
            audiogram: One ear, or one per item; for a tensor (8,) or (batch, 8). For two channels a
                ``Listener``, a pair of left and right ear, or one of these per item; for a tensor
                (2, 8) or (batch, 2, 8). None takes that of the constructor.
            lengths: Number of samples of each item of a padded batch. Shape: (batch,).

        Raises:
            ValueError: The shapes do not fit, a signal is not a floating-point tensor with time
                last or has a sample above 1e9, there is no audiogram, or ``audiogram`` or
                ``lengths`` are not as described.
        """
        pair = match_pair(output, clean, self.sample_rate)
        longest = max(output.shape[-1], clean.shape[-1])
        output, clean, _ = pair
        if output.ndim > 3 or (output.ndim == 3 and output.shape[1] > 2):
            raise ValueError(
                "expected output and clean of shape (time,), (batch, time), (batch, 1, time) or "
                f"(batch, 2, time), got {tuple(output.shape)}"
            )
        sides = output.shape[1] if output.ndim == 3 else 1
        scores_per_item = sides // self.ears_per_score
        time = output.shape[-1]
        items = output.numel() // (sides * time)
        audiogram = self.audiogram if audiogram is None else audiogram
        ears = _thresholds(audiogram, items, sides)
        ends = torch.full((items,), time)
        if lengths is not None:
            ends = check_lengths(lengths, torch.Size((items, longest))).clamp_max(time)

        first = int(self.seen)
        self.seen += items
        if self.limit is not None:
            items = min(items, self.limit - first)
            if items <= 0:
                return
        count = items * scores_per_item
        outputs, references, ears = (
            values.reshape(-1, self.ears_per_score, values.shape[-1])[:count]
            for values in (output.double(), clean.double(), ears)
        )
        scores = scores_or_errors(
            type(self).score,
            outputs,
            references,
            ears,
            ends[:items].repeat_interleave(scores_per_item).tolist(),
            sample_rate=self.sample_rate,
            full_scale_spl=self.full_scale_spl,
        )
        for item in range(items):
            start = item * scores_per_item
            of_ears = scores[start : start + scores_per_item]
            values = [float(score) for score in of_ears if isinstance(score, Tensor)]
            if len(values) < scores_per_item:
                self.failed += 1
                reason = next(score for score in of_ears if isinstance(score, ValueError))
                message = f"{type(self).__name__} leaves out item {first + item}: {reason}"
                warnings.warn(message, stacklevel=2)
                continue
            best = max(values)
            samples = outputs[start + values.index(best), :, : ends[item]].flatten()
            self.total += best
            self.total_level += float(level_spl(samples, self.full_scale_spl))
            self.count += 1

    def compute(self) -> Tensor:
        """Return the mean score of the items that were scored since the last reset, NaN if none.

        Shape: (), float32.
        """
        return self.total / self.count

    @property
    def level(self) -> Tensor:
        """Mean level in dB SPL of the outputs that were scored in this process; NaN if none was."""
        return self.total_level / self.count


class HASPI(_MeanScore):
    """Mean HASPI v2, the intelligibility of outputs, over all items since ``reset``.

    HASPI rewards any gain, so log the mean level of the outputs, the attribute ``level``, as well.
    The score of an item is that of ``haspi`` with the same settings, in double precision. With two
    channels, an item has the score of the better ear. Scoring one second of audio takes about
    0.12 s on one core of a CPU; ``limit`` bounds the cost of a validation epoch.

    In a LightningModule, write ``self.haspi = HASPI(sample_rate=16000)`` in the constructor, and
    ``self.haspi.update(output, clean, audiogram); self.log("haspi", self.haspi)`` in
    ``validation_step``. The level of the outputs is then ``self.haspi.level``.

    Attributes:
        level: Mean level in dB SPL of the outputs that were scored in this process.
        count: Number of items that were scored in this process.
        failed: Number of items that could not be scored in this process. The mean is computed
            without them.
        seen: Number of all items in this process, including those beyond ``limit``.

    Args:
        sample_rate: Sample rate in Hz, 16000 to 48000.
        audiogram: Ear for calls of ``update`` without an audiogram, such as those by torchmetrics'
            ``MultitaskWrapper``.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        limit: Largest number of items, 1 or more, that are scored from one reset to the next in
            each process; the others are skipped. None scores all.
        options: Keyword arguments of ``torchmetrics.Metric``, except ``dist_sync_on_step``.

    Raises:
        ValueError: A value is out of range, the audiogram is not valid, or ``dist_sync_on_step`` is
            true.

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
    NAL-R has amplified. Noise, distortion and changes of the spectrum reduce the score; a delay is
    removed before. Scoring one second of audio takes about 0.2 s on a CPU.

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


def _mbstoi(
    output: Tensor,
    clean: Tensor,
    ears: Tensor,
    *,
    lengths: Sequence[int],
    sample_rate: int,
    full_scale_spl: float,
) -> Tensor:
    """Compute MBSTOI item by item. It ignores ``ears`` and ``full_scale_spl``.

    Shape: (items, 2, time) twice -> (items,).
    """
    pairs = zip(output, clean, lengths, strict=True)
    scores = [mbstoi(x[:, :end], y[:, :end], sample_rate=sample_rate) for x, y, end in pairs]
    return torch.stack(scores)


class MBSTOI(_MeanScore):
    """Mean MBSTOI, the intelligibility of outputs at two ears, over all items since ``reset``.

    MBSTOI assumes normal hearing: for a listener with a hearing loss, apply a simulator to the
    outputs first. The arguments and attributes are those of ``HASPI`` without ``audiogram``. The
    attribute ``level`` is that of both ears together.

    Raises:
        ValueError: A value is out of range, an audiogram is passed, or ``dist_sync_on_step`` is
            true.

    >>> from hlsim import example_speech
    >>> speech, metric = example_speech()[:16000].expand(2, -1), MBSTOI()
    >>> round(float(metric(speech, speech)), 2)
    1.0
    """

    score = staticmethod(_mbstoi)
    ears_per_score = 2

    def __init__(self, sample_rate: int = 16000, **options: Any) -> None:
        if "audiogram" in options:
            raise ValueError(
                "MBSTOI takes no audiogram, because it assumes normal hearing; leave it out, and "
                "apply a simulator to the outputs"
            )
        super().__init__(sample_rate, **options)

    def update(  # type: ignore[override]  # there is no audiogram
        self, output: Tensor, clean: Tensor, lengths: Lengths | None = None
    ) -> None:
        """Score a batch, and add the scores to the mean.

        An item that cannot be scored is left out with a warning and counted in ``failed``.

        Args:
            output: Outputs of an aid at the left and the right ear. Shape: (2, time) or (batch, 2,
                time).
            clean: Clean speech of the same shape. The longer of both is cut with a warning if they
                differ by up to 0.1 s.
            lengths: Number of samples of each item of a padded batch. Shape: (batch,).

        Raises:
            ValueError: The shapes do not fit, a signal is not a floating-point tensor with time
                last or has a sample above 1e9, or ``lengths`` are not as described.
        """
        check_two_channels(output)
        if output.ndim == 2:
            output, clean = output[None], clean[None]
        super().update(output, clean, ["NH", "NH"], lengths)


def _thresholds(audiogram: AudiogramLike | None, items: int, sides: int) -> Tensor:
    """Return the thresholds of each item's ears in dB HL on the CPU. Shape: -> (items, sides, 8).

    Args:
        audiogram: Ears of all items or of each item.
        items: Number of items.
        sides: Number of ears per item, 1 or 2.

    Raises:
        ValueError: There is no audiogram, its shape fits neither all items nor each of them, or a
            level is out of range.
    """
    if isinstance(audiogram, Tensor):
        audiogram = audiogram.cpu()  # a level out of range is an error there, and NaN on a GPU
    levels = as_thresholds(audiogram, highest=HIGHEST_LEVEL)
    one_for_all = (2, len(FREQUENCIES)) if sides == 2 else (len(FREQUENCIES),)
    fits = levels.shape in (one_for_all, (items, *one_for_all))
    if sides == 1 and has_listeners(audiogram):
        raise ValueError(
            "expected signals of shape (batch, 2, time) for a Listener, got one channel per item; "
            "stack left and right: torch.stack([left, right], 1)"
        )
    if not fits:
        raise ValueError(
            f"expected an audiogram of shape {one_for_all} or {(items, *one_for_all)}, "
            f"got {tuple(levels.shape)}"
        )
    levels = levels.detach().expand(items, *one_for_all)
    return levels.reshape(items, sides, len(FREQUENCIES))
