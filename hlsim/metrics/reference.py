"""Scores of many outputs against the same clean signals, which are prepared once.

``Reference`` is the base of ``HaspiReference``, ``HasqiReference`` and ``HaaqiReference``. It holds
one ``PreparedBatch`` for each group of items that is computed together: a single item on a CPU, all
items on a GPU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, TypeVar

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


class PreparedBatch(ABC):
    """Clean signals of a batch as an ear receives them, ready to be compared with outputs of aids.

    Subclasses compute the features of a score in a few channels of the ear at a time.

    Args:
        signals: All clean signals.
        batch: The clean signals of this batch.
        clean: Sound that reaches the ear, in multiples of 20 uPa. Shape: (items, padded).
        cells: Hair cells of the ear, or of the ear of each item. Shape: (32,) or (items, 32).
        keep: Store the features of the clean signals instead of computing them for each score.

    >>> from hlsim.metrics import HaspiReference
    >>> reference = HaspiReference(0.02 * torch.randn(2, 16000))
    >>> [isinstance(batch, PreparedBatch) for batch in reference._batches]
    [True, True]
    """

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        clean: Tensor,
        cells: ear_model.HairCells,
        keep: bool,
    ) -> None:
        self._signals, self._batch, self._cells = signals, batch, cells
        self._extent = batch.audible
        self._clean = signals.through_middle_ear(clean)
        self._longest_delay = ear_model.longest_group_delay(self._clean, cells, self._extent)
        self._stored: list[Any] | None = None
        if keep:
            self._stored = list(self._clean_features())

    def _clean_features(self) -> Iterator[Any]:
        """Yield the features of the clean signals in a few channels, from low to high."""
        if self._stored is not None:
            yield from self._stored
            return
        items, padded = self._clean.shape
        for channels in ear_model.channel_chunks(items, padded, self._signals.device):
            with torch.no_grad():
                features = self._prepare(channels)
            yield features

    @abstractmethod
    def _prepare(self, channels: slice) -> Any:
        """Compute the features of the clean signals in some channels."""

    @abstractmethod
    def compare(
        self, processed: Tensor, noise: Noise, seeds: Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Compare outputs of aids with the clean signals of this batch.

        Args:
            processed: Outputs for the items of all batches. Shape: (all items, time).
            noise: Kind of the internal noise of the ear.
            seeds: Seeds of the items of all batches.
            ears: For HASPI one argument, the hair cells of the impaired ears of all items, with
                shape (all items, 32); none for HASQI and HAAQI, where the outputs reach the same
                ears as the clean signals.

        Returns:
            For each item of this batch, the ten features from which ``HaspiReference`` computes
            HASPI, or HASQI or HAAQI with its nonlinear and its linear part. Shape: (items, 10) or
            (items, 3).
        """


class Reference(ABC):
    """Clean signals that are prepared for the scores of many outputs of aids.

    On a CPU the items of a batch are distributed over as many threads as torch uses, unless a
    gradient is needed. The scores do not depend on the number of threads.

    Args:
        clean: Clean signals. The scores have their dtype and their device. Their gradient is not
            computed. Shape: (..., time).
        audiogram: Ear that receives the clean signals, or one for each item; None for a normal ear.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        keep: Store the clean signals' features; otherwise they are computed for each score, which
            takes less memory.

    Raises:
        ValueError: Clean signals that last less than 0.7 s, are not finite, silent or below 20 dB
            SPL; a rate, level, audiogram or length out of range.

    >>> from hlsim.metrics import HaspiReference
    >>> issubclass(HaspiReference, Reference)
    True
    """

    score_name: ClassVar[str]

    @torch.inference_mode(False)  # the features may serve a training later
    def __init__(
        self,
        clean: Tensor,
        audiogram: AudiogramLike | None,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        lengths: Lengths | None = None,
        whole_khz: bool = False,
        keep: bool = True,
    ) -> None:
        self._audiogram = audiogram
        self._signals = CleanSpeech(
            clean, sample_rate, full_scale_spl, lengths, whole_khz, self.score_name
        )
        self._batches = self._prepare(self._signals, keep)

    @torch.no_grad()
    def _prepare(self, signals: CleanSpeech, keep: bool) -> list[PreparedBatch]:
        with torch.autocast(signals.device.type, enabled=False):
            return self._prepare_batches(signals, keep)

    @abstractmethod
    def _prepare_batches(self, signals: CleanSpeech, keep: bool) -> list[PreparedBatch]:
        """Prepare the clean signals of each batch."""

    def _compare(
        self, processed: Tensor, noise: Noise, seed: int | Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Return the features of each output, from which its score follows.

        The arguments are those of ``PreparedBatch.compare``, with one seed or one for each item.

        Shape: (..., time) -> (..., features).
        """
        check_choice("noise", noise, Noise)
        rows, signals = self._signals.match(processed)
        batches = self._batches
        if signals is not self._signals:
            batches = self._prepare(signals, keep=False)
        seeds = item_seeds(seed, len(rows))
        with torch.autocast(rows.device.type, enabled=False):
            features = map_on_cores(
                lambda batch: batch.compare(rows, noise, seeds, *ears), batches, rows
            )
        return torch.cat(features).reshape(*signals.shape, -1)


def map_on_cores(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], signal: Tensor
) -> list[Result]:
    """Call a function for each of several arguments, in as many threads as torch uses.

    Each call computes on one core. Calls one after another, each on all cores, take longer, because
    the cores wait for each other after every operation, and much longer while other programs run.

    Args:
        function: Function to call.
        arguments: Arguments of the calls.
        signal: Tensor on which the function depends. If it is not on a CPU or has a gradient, the
            calls are made in this thread, to which the hooks of autograd belong.

    Returns:
        Results in the order of the arguments.

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
