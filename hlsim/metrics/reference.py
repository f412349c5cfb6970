"""Clean signals that are prepared once for the scores of many processed signals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Generic, TypedDict, TypeVar

import torch
from torch import Tensor

from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import Lengths, check_choice
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech
from hlsim.metrics.pair import Noise, item_seeds

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Channels = TypeVar("Channels")
"""Type of the features of clean signals in some channels."""


class Settings(TypedDict, total=False):
    """Keyword arguments of ``Reference``.

    >>> sorted(Settings.__optional_keys__)
    ['full_scale_spl', 'keep', 'lengths', 'sample_rate', 'whole_khz']
    """

    sample_rate: int
    full_scale_spl: float
    lengths: Lengths | None
    whole_khz: bool
    keep: bool


class PreparedBatch(Generic[Channels]):
    """Clean signals of a batch in their ears, some channels at a time.

    Args:
        signals: All clean signals.
        batch: Those of the batch.
        clean: Clean signals of the batch as the ears receive them. Shape: (items, padded).
        cells: Hair cells of the ears. Shape: (items, 32) or (32,).

    >>> issubclass(PreparedBatch, Generic)
    True
    """

    def __init__(
        self, signals: CleanSpeech, batch: CleanBatch, clean: Tensor, cells: ear_model.HairCells
    ) -> None:
        self._signals, self._batch, self._cells = signals, batch, cells
        self._extent = batch.audible
        self._clean = signals.through_middle_ear(clean, self._extent)
        self._longest_delay = ear_model.longest_group_delay(self._clean, cells, self._extent)
        self._stored: list[Channels] | None = None

    def store(self) -> None:
        """Compute the features of all channels, and store them."""
        self._stored = self._map_channels(lambda features: features, self._clean)

    def _map_channels(self, function: Callable[[Channels], Result], signal: Tensor) -> list[Result]:
        """Call a function with the features of some channels at a time, from low to high.

        Args:
            function: Function to call.
            signal: Tensor on which the function depends.
        """
        if self._stored is not None:
            return map_on_cores(function, self._stored, signal)

        def prepare_and_call(channels: slice) -> Result:
            with torch.no_grad():
                features = self._prepare(channels)
            return function(features)

        return map_on_cores(prepare_and_call, self._channel_chunks(), signal)

    def _channel_chunks(self) -> list[slice]:
        items, padded = self._clean.shape
        return list(ear_model.channel_chunks(items, padded, self._signals.device))

    def _prepare(self, channels: slice) -> Channels:
        raise NotImplementedError

    def _align(self, processed: Tensor) -> Tensor:
        """Align the batch's part of all processed signals, and filter it by the middle ear.

        Shape: (all items, time) -> (items, padded).
        """
        aligned = self._signals.align(processed, self._batch)
        return self._signals.through_middle_ear(aligned, self._extent)

    def compare(
        self, processed: Tensor, noise: Noise, seeds: Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Compare processed signals with the clean ones.

        This object has some of the items. Arguments are for all items, and the result is for its
        own ones.

        Args:
            processed: All processed signals. Shape: (all items, time).
            noise: Kind of the internal noise of the ear.
            seeds: Seeds of all items.
            ears: Hair cells of all items, where they are not those of the clean signals.

        Returns:
            Features of each item of the batch. Shape: (items, features).
        """
        raise NotImplementedError


Batch = TypeVar("Batch", bound=PreparedBatch[Any])


class Reference(Generic[Batch]):
    """Clean signals that are prepared for the scores of many processed signals.

    On a CPU the items, or the channels of one item, are distributed over as many threads as torch
    uses, if no gradient is needed. The scores do not depend on it.

    Args:
        clean: Clean signals, whose dtype and device are those of the scores. Their gradient is not
            computed. Shape: (..., time).
        audiogram: The ear in which they are prepared, or one for each item; None for a normal ear.
        sample_rate, full_scale_spl, lengths, whole_khz: The arguments of ``haspi``.
        keep: Store the clean signals' features; otherwise they are computed for each score, which
            takes less memory.

    Raises:
        ValueError: As for ``haspi``.

    >>> from hlsim.metrics import HaspiReference
    >>> issubclass(HaspiReference, Reference)
    True
    """

    score_name: ClassVar[str]

    @torch.inference_mode(False)  # the features may serve a training later
    def __init__(
        self,
        clean: Tensor,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        lengths: Lengths | None = None,
        whole_khz: bool = False,
        keep: bool = True,
    ) -> None:
        self._audiogram = audiogram
        settings = sample_rate, full_scale_spl, whole_khz, self.score_name
        self._signals = CleanSpeech(clean, lengths, *settings)
        self._batches = self._prepare(self._signals)
        if keep:
            with torch.autocast(clean.device.type, enabled=False):
                map_on_cores(lambda batch: batch.store(), self._batches, self._signals.clean)

    @torch.no_grad()
    def _prepare(self, signals: CleanSpeech) -> list[Batch]:
        with torch.autocast(signals.device.type, enabled=False):
            return self._prepare_batches(signals)

    def _prepare_batches(self, signals: CleanSpeech) -> list[Batch]:
        raise NotImplementedError

    def _compare(
        self,
        processed: Tensor,
        noise: Noise,
        seed: int | Sequence[int],
        *ears: ear_model.HairCells,
    ) -> Tensor:
        """Return the features of each processed signal. Shape: (..., time) -> (..., features)."""
        check_choice("noise", noise, Noise)
        processed, signals = self._signals.cut(processed)
        batches = self._batches if signals is self._signals else self._prepare(signals)
        rows = signals.check(processed)
        seeds = item_seeds(seed, signals.shape)
        with torch.autocast(rows.device.type, enabled=False):
            features = map_on_cores(
                lambda batch: batch.compare(rows, noise, seeds, *ears), batches, rows
            )
        return torch.cat(features).reshape(*signals.shape, -1)


def map_on_cores(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], signal: Tensor
) -> list[Result]:
    """Call a function for each of several arguments, in as many threads as torch uses.

    Each call computes in one thread. This takes less time than calls that are made one after
    another, each in many threads, which wait for each other after every operation.

    Args:
        function: Function to call.
        arguments: Arguments of the calls.
        signal: Tensor on which the function depends. If it is not on a CPU or has a gradient, the
            calls are made in this thread, to which the hooks of autograd belong.

    >>> map_on_cores(abs, [-1, -2], torch.zeros(1))
    [1, 2]
    """
    threads = torch.get_num_threads()
    workers = min(threads, len(arguments))
    is_differentiable = signal.requires_grad and torch.is_grad_enabled()
    if workers == 1 or signal.device.type != "cpu" or is_differentiable:
        return [function(argument) for argument in arguments]
    inference = torch.is_inference_mode_enabled()

    def call(argument: Argument) -> Result:
        with torch.inference_mode(inference), torch.no_grad():
            return function(argument)

    try:
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(call, arguments))
    finally:
        torch.set_num_threads(threads)  # the workers have changed it for threads to come
