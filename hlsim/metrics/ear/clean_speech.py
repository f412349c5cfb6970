"""Batches of clean speech, prepared for Kates' ear, and the alignment of processed speech."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from hlsim.audiogram import HIGHEST_LEVEL
from hlsim.audiogram.devices import on_host
from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import check_full_scale
from hlsim.checks import Lengths, broadcast_shape, check_lengths, check_rate, check_waveform
from hlsim.metrics.ear import input as ear_input
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.model import Extent, integers
from hlsim.metrics.ear.recursions import RATE, middle_ear
from hlsim.metrics.pair import LOWEST_REFERENCE_SPL, SHORTEST_SECONDS, cut_to_common_length

MIN_AUDIBLE_SAMPLES = 384
"""Smallest number of samples at 24 kHz between silent ends, a segment of HASQI."""


class UnscorableError(ValueError):
    """Error for a clean signal that is too soft or too short for a meaningful score.

    >>> issubclass(UnscorableError, ValueError)
    True
    """


@dataclass(frozen=True)
class CleanBatch:
    """Clean signals that are processed together.

    Attributes:
        items: Indices of the signals among all items.
        extent: Lengths at the rate of the input.
        resampled: Lengths at 24 kHz.
        starts: First samples at 24 kHz that are not silence.
        audible: Lengths at 24 kHz from there to the last sample that is not silence.
        spectrum: Spectra for the bulk alignment.
        signals: Audible parts in multiples of 20 uPa, float64. Shape: (items, padded).

    >>> speech = CleanSpeech(torch.randn(2, 16000), None, 16000, 94.0, False, "HASPI")
    >>> speech.batches[0].signals.shape
    torch.Size([1, 24000])
    """

    items: slice
    extent: Extent
    resampled: Extent
    starts: tuple[int, ...]
    audible: Extent
    spectrum: Tensor
    signals: Tensor


class CleanSpeech:
    """Clean signals at 24 kHz without silent ends, and the alignment of processed signals.

    On a CPU each item is a batch, because its caches hold no more. On a GPU a batch has as many
    items as fit into memory with all their channels.

    Args:
        clean: Clean signals. Shape: (..., time).
        lengths: Number of samples of each item in a padded batch.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        whole_khz: Round the rate to whole kHz.
        name: Name of the score, for messages.

    Raises:
        ValueError: The signals are too short or not finite, or a rate, level or length is out of
            range.
        UnscorableError: The signals are silent, too soft or too short to be scored.

    >>> CleanSpeech(torch.randn(2, 16000), None, 16000, 94.0, False, "HASPI").shape
    torch.Size([2])
    """

    def __init__(
        self,
        clean: Tensor,
        lengths: Lengths | None,
        sample_rate: int,
        full_scale_spl: float,
        whole_khz: bool,
        name: str,
    ) -> None:
        self._name = name
        self._input_rate = check_rate(sample_rate)
        self.full_scale = check_full_scale(full_scale_spl)
        check_waveform(clean, "clean", full_scale_spl=self.full_scale)
        self.shape, self.time = clean.shape[:-1], clean.shape[-1]
        self.dtype, self.device = torch.promote_types(clean.dtype, torch.float32), clean.device
        ends = [self.time] * self.shape.numel()
        if lengths is not None:
            ends = check_lengths(lengths, clean.shape).flatten().tolist()
        self._rate = self._input_rate
        if whole_khz:
            self._rate = 1000 * round(self._input_rate / 1000)
        self._settings = sample_rate, full_scale_spl, whole_khz, name
        self.clean, self._ends = clean.detach(), ends
        self._gain = 10.0 ** (self.full_scale / 20.0)
        with torch.no_grad():
            # Double precision, because one sample more at an end would shift all frames.
            rows = clean.detach().double().reshape(-1, self.time)
            self.batches = [
                self._batch(rows[items], items, Extent(tuple(ends[items])))
                for items in self._batch_slices(len(rows))
            ]

    def _batch_slices(self, items: int) -> list[slice]:
        size = 1
        if self.device.type != "cpu":
            samples = self.time * RATE // self._rate
            size = max(1, ear_model.GPU_CHUNK // (ear_model.CHANNELS * samples))
        return [slice(start, min(start + size, items)) for start in range(0, items, size)]

    def _batch(self, signals: Tensor, items: slice, extent: Extent) -> CleanBatch:
        """Validate and prepare signals. The host waits for the device once."""
        for index, end in enumerate(extent.ends, start=items.start):
            if end < SHORTEST_SECONDS * self._input_rate:
                raise ValueError(
                    f"{self._label(index)} lasts {end / self._input_rate:.2g} s; expected "
                    f"{SHORTEST_SECONDS} s or more, because {self._name} means nothing below"
                )
        signals = extent.cut(signals)
        variance = extent.mean(extent.centred(signals).square())
        at_ear = ear_input.to_ear_rate(signals, self._rate, extent) * self._gain
        first, last = ear_input.audible_ends(at_ear)
        finite, sounding = signals.isfinite().all(-1), signals.any(-1)
        values = (finite, sounding, variance, first, last)
        summary = torch.stack([value.double() for value in values])
        starts, ends = [], []
        for index, row in enumerate(summary.mT.tolist(), start=items.start):
            self._validate(index, *row)
            starts.append(int(row[3]))
            ends.append(int(row[4]) + 1)
        resampled = ear_input.at_ear_rate(extent, self._rate)
        audible = Extent(tuple(end - start for start, end in zip(starts, ends, strict=True)))
        spectrum = ear_input.spectrum_for_alignment(at_ear.to(self.dtype), resampled)
        delays = -integers(tuple(starts), self.device)[:, None]
        parts = ear_model.shift(
            at_ear[:, None], delays, resampled.ends, audible.ends, audible.padded
        )
        return CleanBatch(
            items, extent, resampled, tuple(starts), audible, spectrum, parts.squeeze(1)
        )

    def _label(self, index: int) -> str:
        return "clean" if self.shape.numel() == 1 else f"clean, item {index}"

    def _validate(
        self, index: int, finite: float, sounding: float, variance: float, first: float, last: float
    ) -> None:
        """Raise an error unless the score of a signal is meaningful."""
        label = self._label(index)
        if not finite:
            raise ValueError(f"{label} holds samples that are NaN or infinite")
        if not sounding:
            raise UnscorableError(f"{label} is silent, every sample is zero")
        level = 10.0 * math.log10(max(variance, 1e-30)) + self.full_scale
        if level < LOWEST_REFERENCE_SPL:
            raise UnscorableError(
                f"{label} is at {level:.1f} dB SPL with full_scale_spl {self.full_scale:g}; "
                f"expected {LOWEST_REFERENCE_SPL:g} dB SPL or more, because "
                f"{self._name} means nothing below"
            )
        length = last - first + 1
        if length < MIN_AUDIBLE_SAMPLES:
            raise UnscorableError(
                f"{label} has sound for only {1000.0 * length / RATE:.2g} ms; expected "
                f"{1000.0 * MIN_AUDIBLE_SAMPLES / RATE:g} ms or more, as {self._name} requires"
            )

    def cut(self, processed: Tensor) -> tuple[Tensor, CleanSpeech]:
        """Cut signals to their common length, with a warning, if it differs by 0.1 s at most.

        Args:
            processed: Signals of the same rate. Shape: (..., time).

        Returns:
            Both signals. The clean ones are prepared again if they are longer.

        Raises:
            ValueError: The lengths differ by more than 0.1 s.
        """
        ends = torch.tensor(self._ends).reshape(self.shape)
        processed, clean, lengths = cut_to_common_length(
            processed, self.clean, self._input_rate, ends
        )
        if clean.shape == self.clean.shape:
            return processed, self
        return processed, CleanSpeech(clean, lengths, *self._settings)

    def check(self, processed: Tensor) -> Tensor:
        """Validate processed signals, and return them as rows.

        Shape: (..., time) -> (items, time).
        """
        check_waveform(processed, "processed", full_scale_spl=self.full_scale)
        if processed.shape != (*self.shape, self.time):
            raise ValueError(
                f"expected processed of the shape of clean, {(*self.shape, self.time)}, "
                f"got {tuple(processed.shape)}"
            )
        if processed.device != self.device:
            raise ValueError(
                f"processed is on {processed.device} and clean on {self.device}; "
                "move both to one device"
            )
        if not bool(processed.detach().isfinite().all()):
            raise ValueError("processed holds samples that are NaN or infinite")
        return processed.reshape(-1, self.time)

    def thresholds(self, audiogram: AudiogramLike, *, host: bool = False) -> Tensor:
        """Return the ear of each item.

        Args:
            audiogram: One ear, or one for each item.
            host: Return them on the CPU. The host waits for ears that lie on a GPU.

        Returns:
            Thresholds. Shape: (items, 8) dB HL.
        """
        probe = torch.empty((*self.shape, 1), device=self.device)
        ears = resolve_thresholds(
            None, audiogram, probe, highest=HIGHEST_LEVEL, consumer=self._name
        )
        if broadcast_shape(self.shape, ears.shape[:-1]) != self.shape:
            raise ValueError(
                f"expected one audiogram or one for each item, got shape {tuple(ears.shape)} "
                f"for signals of shape {(*self.shape, self.time)}"
            )
        ears = on_host(ears) if host else ears
        return ears.expand(*self.shape, 8).reshape(-1, 8)

    def align(self, processed: Tensor, batch: CleanBatch) -> Tensor:
        """Return the parts of processed signals that match the audible parts of the clean ones.

        Args:
            processed: All processed signals. Shape: (items, time).
            batch: Batch whose items are returned.

        Returns:
            Aligned parts in multiples of 20 uPa. Shape: (items of the batch, padded).
        """
        signals = batch.extent.cut(processed[batch.items].double())
        at_ear = ear_input.to_ear_rate(signals, self._rate, batch.extent) * self._gain
        delays = ear_input.bulk_delays(
            batch.spectrum, at_ear.detach().to(self.dtype), batch.resampled
        )
        delays = (delays - integers(batch.starts, self.device))[:, None]
        ends, stops = batch.resampled.ends, batch.audible.ends
        parts = ear_model.shift(at_ear[:, None], delays, ends, stops, batch.audible.padded)
        return parts.squeeze(1)

    def through_middle_ear(self, signals: Tensor, extent: Extent) -> Tensor:
        """Filter signals by the middle ear. Shape: (items, padded or more) -> (items, padded)."""
        rows = signals[:, : extent.padded].to(self.dtype)
        return middle_ear(self.device, self.dtype)(rows).flatten(-2)
