"""Batches of clean speech, validated and brought to Kates' ear, and processed speech that is made to match them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

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

_SHORTEST_PART = 384
"""Samples at 24 kHz of a segment of HASQI."""


class UnscorableError(ValueError):
    """A clean signal that is too soft or too short for a score to mean anything."""


@dataclass(frozen=True)
class CleanBatch:
    """Clean signals that are processed together.

    Attributes:
        items: their place among all items.
        extent: lengths at the rate of the input.
        resampled: lengths at 24 kHz.
        starts: first samples at 24 kHz that are not silence.
        audible: lengths at 24 kHz from there to the last sample that is not silence.
        spectrum: spectra for the bulk alignment.
        signals: the audible parts in multiples of 20 uPa, in double precision. Shape: (items, padded).
    """

    items: slice
    extent: Extent
    resampled: Extent
    starts: tuple[int, ...]
    audible: Extent
    spectrum: Tensor
    signals: Tensor


class CleanSpeech:
    """Clean signals at 24 kHz without silence at their ends, and processed signals that are made to match.

    On a CPU each item is a batch of its own, because its caches hold no more. On a GPU all items are one batch.
    """

    def __init__(
        self,
        clean: Tensor,
        sample_rate: int,
        full_scale_spl: float,
        lengths: Lengths | None,
        whole_khz: bool,
        name: str,
    ) -> None:
        self._name = name
        self._given_rate = check_rate(sample_rate)
        self._full_scale = check_full_scale(full_scale_spl)
        check_waveform(clean, "clean")
        self.shape, self.time = clean.shape[:-1], clean.shape[-1]
        self.dtype, self.device = torch.promote_types(clean.dtype, torch.float32), clean.device
        ends = [self.time] * self.shape.numel()
        if lengths is not None:
            ends = check_lengths(lengths, clean.shape).flatten().tolist()
        self._rate = self._given_rate
        if whole_khz:
            self._rate = 1000 * round(self._given_rate / 1000)
        self._settings = {
            "sample_rate": sample_rate,
            "full_scale_spl": full_scale_spl,
            "whole_khz": whole_khz,
        }
        self._clean, self._ends = clean.detach(), ends
        self._gain = 10.0 ** (self._full_scale / 20.0)
        with torch.no_grad():
            # in double precision, for a sample more or less at an end would move all frames
            rows = clean.detach().double().reshape(-1, self.time)
            self.batches = [
                self._batch(rows[items], items, Extent(tuple(ends[items])))
                for items in self._together(len(rows))
            ]

    def _together(self, items: int) -> list[slice]:
        if self.device.type == "cpu":
            return [slice(item, item + 1) for item in range(items)]
        return [slice(0, items)]

    def _batch(self, signals: Tensor, items: slice, extent: Extent) -> CleanBatch:
        """Validate and prepare signals. The host waits for the device once."""
        for index, end in enumerate(extent.ends, start=items.start):
            if end < SHORTEST_SECONDS * self._given_rate:
                raise ValueError(
                    f"{self._label(index)} lasts {end / self._given_rate:.2g} s; {self._name} needs {SHORTEST_SECONDS} s "
                    "or more to mean anything"
                )
        signals = extent.cut(signals)
        variance = extent.mean(extent.centred(signals).square())
        at_ear = ear_input.to_ear_rate(signals, self._rate, extent) * self._gain
        first, last = ear_input.audible_ends(at_ear)
        finite, sounding = signals.isfinite().all(-1), signals.any(-1)
        summary = torch.stack([one.double() for one in (finite, sounding, variance, first, last)])
        starts, lasts = [], []
        for index, values in enumerate(summary.mT.tolist(), start=items.start):
            self._validate(index, *values)
            starts.append(int(values[3]))
            lasts.append(int(values[4]))
        resampled = ear_input.at_ear_rate(extent, self._rate)
        audible = Extent(tuple(b - a + 1 for a, b in zip(starts, lasts, strict=True)))
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
        """Raise an error unless the score of a signal means something."""
        label = self._label(index)
        if not finite:
            raise ValueError(f"{label} holds samples that are NaN or infinite")
        if not sounding:
            raise UnscorableError(f"{label} is silent, every sample is zero")
        level = 10.0 * math.log10(max(variance, 1e-30)) + self._full_scale
        if level < LOWEST_REFERENCE_SPL:
            raise UnscorableError(
                f"{label} is at {level:.1f} dB SPL with full_scale_spl {self._full_scale:g}; {self._name} needs "
                f"{LOWEST_REFERENCE_SPL:g} or more to mean anything"
            )
        if (length := last - first + 1) < _SHORTEST_PART:
            raise UnscorableError(
                f"{label} sounds for {1000.0 * length / RATE:.2g} ms alone; {self._name} needs "
                f"{1000.0 * _SHORTEST_PART / RATE:g} ms or more to be defined"
            )

    def cut(self, processed: Tensor) -> tuple[Tensor, dict[str, Any] | None]:
        """Cut the signals to their common length, with a warning, where it differs by 0.1 s at most.

        Args:
            processed: signals of the same rate. Shape: (..., time).

        Returns:
            The processed signals and, where they are shorter than the clean ones, the arguments
            that prepare clean signals of their length; None otherwise.

        Raises:
            ValueError: the lengths differ by more than 0.1 s.
        """
        ends = torch.tensor(self._ends).reshape(self.shape)
        processed, clean, lengths = cut_to_common_length(
            processed, self._clean, self._given_rate, ends
        )
        if clean.shape == self._clean.shape:
            return processed, None
        return processed, {"clean": clean, "lengths": lengths, **self._settings}

    def check(self, processed: Tensor) -> Tensor:
        """Validate processed signals and return them as rows. Shape: (..., time) -> (items, time)."""
        check_waveform(processed, "processed")
        if processed.shape != (*self.shape, self.time):
            raise ValueError(
                f"processed has shape {tuple(processed.shape)}, clean {(*self.shape, self.time)}; allowed: equal shapes"
            )
        if processed.device != self.device:
            raise ValueError(
                f"processed is on {processed.device}, clean on {self.device}; allowed: one device"
            )
        if not bool(processed.detach().isfinite().all()):
            raise ValueError("processed holds samples that are NaN or infinite")
        return processed.reshape(-1, self.time)

    def thresholds(self, audiogram: AudiogramLike, *, host: bool = False) -> Tensor:
        """Return the ear of each item. Shape: -> (items, 8) dB HL.

        Args:
            host: on the CPU. The host waits for the device where the ears come from there.
        """
        probe = torch.empty((*self.shape, 1), device=self.device)
        ears = resolve_thresholds(
            None, audiogram, probe, highest=HIGHEST_LEVEL, consumer=self._name
        )
        if broadcast_shape(self.shape, ears.shape[:-1]) != self.shape:
            raise ValueError(
                f"audiograms of shape {tuple(ears.shape)} for signals of {(*self.shape, self.time)}; allowed: one, or "
                "leading dimensions that broadcast"
            )
        ears = on_host(ears) if host else ears
        return ears.expand(*self.shape, 8).reshape(-1, 8)

    def matched(self, processed: Tensor, batch: CleanBatch) -> Tensor:
        """Return the parts of processed signals that are compared with the audible parts of the clean ones.

        Shape: (items, time) of the whole input -> (items of the batch, padded), in multiples of 20 uPa.
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

    def groups(self, batch: CleanBatch) -> Iterator[slice]:
        """Items of a batch whose channels are computed together."""
        return ear_model.item_chunks(batch.audible)

    def through_middle_ear(self, signals: Tensor, extent: Extent) -> Tensor:
        """Shape: (items, padded or more) -> (items, padded)."""
        rows = signals[:, : extent.padded].to(self.dtype)
        return middle_ear(self.device, self.dtype)(rows).flatten(-2)


Channels = TypeVar("Channels")
"""What an ear makes of the clean speech in some channels."""


class ItemGroup(Generic[Channels]):
    """Items of a batch whose ears are computed together, some channels at a time.

    Args:
        items: their place in the batch.
    """

    def __init__(self, signals: CleanSpeech, batch: CleanBatch, items: slice) -> None:
        self._signals, self.items = signals, items
        self._extent = batch.audible[items]
        self._kept: list[Channels] | None = None

    def keep(self) -> None:
        """Compute all channels now."""
        self._kept = list(self._channels())

    def _channels(self) -> Iterator[Channels]:
        if self._kept is not None:
            yield from self._kept
            return
        for chosen in ear_model.channel_chunks(
            len(self._extent.ends), self._extent.padded, self._signals.device
        ):
            yield self._hear(chosen)

    def _hear(self, chosen: slice) -> Channels:
        raise NotImplementedError
