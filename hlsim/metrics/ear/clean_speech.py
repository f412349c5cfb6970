"""A batch of clean speech, checked and brought to Kates' ear, and processed speech that is made to match it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from hlsim.audiogram import HIGHEST_LEVEL
from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import check_full_scale
from hlsim.checks import Lengths, broadcast_shape, check_lengths, check_rate, check_waveform
from hlsim.metrics.ear import input as ear_input
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.model import CHANNELS, Extent
from hlsim.metrics.ear.recursions import RATE, middle_ear
from hlsim.metrics.pair import LOWEST_REFERENCE_SPL, SHORTEST_SECONDS

_LEAST = 384  # samples at 24 kHz: HASQI's segment

_TOGETHER = 2**27  # samples of all channels that a GPU works on at once


class UnscorableError(ValueError):
    """A clean signal of which no score means anything, for nobody hears enough of it."""


@dataclass(frozen=True)
class CleanItem:
    """One clean signal, prepared.

    Attributes:
        index: among the items of the batch, flattened.
        length: in samples at the rate that it was given at.
        part: of the signal at 24 kHz that is not silent.
        spectrum: for the bulk alignment.
        heard: that part in multiples of 20 uPa, at 24 kHz.
    """

    index: int
    length: int
    part: slice
    spectrum: Tensor
    heard: Tensor


class CleanSpeech:
    """A batch of clean signals, checked, at 24 kHz and freed of silent ends; and processed ones made to match."""

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
        rate = check_rate(sample_rate)
        full_scale = check_full_scale(full_scale_spl)
        check_waveform(clean, "clean")
        self.shape, self.time = clean.shape[:-1], clean.shape[-1]
        self.dtype, self.device = torch.promote_types(clean.dtype, torch.float32), clean.device
        ends = [self.time] * self.shape.numel()
        if lengths is not None:
            ends = check_lengths(lengths, clean.shape).flatten().tolist()
        self._rate = 1000 * round(rate / 1000) if whole_khz else rate
        self._gain = 10.0 ** (full_scale / 20.0)
        with torch.no_grad():
            # in double precision, for a sample more or less at an end would move all frames
            rows = clean.detach().double().reshape(-1, self.time)
            self.items = [
                self._item(i, rows[i, :end], end, full_scale, rate) for i, end in enumerate(ends)
            ]

    def _item(
        self, index: int, signal: Tensor, length: int, full_scale: float, rate: int
    ) -> CleanItem:
        name = "clean" if self.shape.numel() == 1 else f"clean, item {index}"
        if length < SHORTEST_SECONDS * rate:
            raise ValueError(
                f"{name} lasts {length / rate:.2g} s; {self._name} needs {SHORTEST_SECONDS} s or more to mean anything"
            )
        if not bool(signal.isfinite().all()):
            raise ValueError(f"{name} holds samples that are NaN or infinite")
        if not bool(signal.any()):
            raise UnscorableError(f"{name} is silent, every sample is zero")
        level = 10.0 * math.log10(max(float(signal.var(correction=0)), 1e-30)) + full_scale
        if level < LOWEST_REFERENCE_SPL:
            raise UnscorableError(
                f"{name} is at {level:.1f} dB SPL with full_scale_spl {full_scale:g}; {self._name} needs "
                f"{LOWEST_REFERENCE_SPL:g} or more to mean anything"
            )
        at_ear = ear_input.to_ear_rate(signal, self._rate) * self._gain
        part = ear_input.audible_part(at_ear)
        if (lasts := part.stop - part.start) < _LEAST:
            raise UnscorableError(
                f"{name} sounds for {1000.0 * lasts / RATE:.2g} ms alone; {self._name} needs "
                f"{1000.0 * _LEAST / RATE:g} ms or more to be defined"
            )
        return CleanItem(
            index,
            length,
            part,
            ear_input.spectrum_for_alignment(at_ear.to(self.dtype)),
            at_ear[part],
        )

    def groups(self) -> list[list[CleanItem]]:
        """Items to be worked on together: one by one on a CPU, many on a GPU."""
        if self.device.type == "cpu":
            return [[item] for item in self.items]
        longest = max(len(item.heard) for item in self.items)
        step = max(1, _TOGETHER // (CHANNELS * longest))
        return [self.items[start : start + step] for start in range(0, len(self.items), step)]

    def check(self, processed: Tensor) -> Tensor:
        """Processed signals as rows. Shape: (..., time) -> (items, time)."""
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

    def thresholds(self, audiogram: AudiogramLike) -> Tensor:
        """Of each item. Returns (items, 8) dB HL."""
        probe = torch.empty((*self.shape, 1), device=self.device)
        ears = resolve_thresholds(None, audiogram, probe, highest=HIGHEST_LEVEL, taker=self._name)
        if broadcast_shape(self.shape, ears.shape[:-1]) != self.shape:
            raise ValueError(
                f"audiograms of shape {tuple(ears.shape)} for signals of {(*self.shape, self.time)}; allowed: one, or "
                "leading dimensions that broadcast"
            )
        return ears.expand(*self.shape, 8).reshape(-1, 8)

    def matched(self, processed: Tensor, item: CleanItem) -> Tensor:
        """The part of a processed signal that the clean one's is compared with, at 24 kHz. Shape: (time,) -> (part,)."""
        at_ear = ear_input.to_ear_rate(processed[: item.length].double(), self._rate) * self._gain
        delay = ear_input.bulk_delay(item.spectrum, at_ear.detach().to(self.dtype))
        return ear_input.moved(at_ear, delay, item.part)

    def through_middle_ear(self, signals: Sequence[Tensor], extent: Extent) -> Tensor:
        """Shape: (time,) each -> (items, padded)."""
        rows = ear_input.stacked(signals, extent.padded).to(self.dtype)
        return middle_ear(self.device, self.dtype)(rows).flatten(-2)


Channels = TypeVar("Channels")
"""What an ear makes of the clean speech in some channels."""


class ItemGroup(Generic[Channels]):
    """Items that are worked on together, some channels at a time."""

    def __init__(self, signals: CleanSpeech, items: list[CleanItem]) -> None:
        self._signals, self._items = signals, items
        self._extent = Extent(tuple(len(item.heard) for item in items))
        self._kept: list[Channels] | None = None

    def keep(self) -> None:
        """Compute all channels now."""
        self._kept = list(self._channels())

    def _channels(self) -> Iterator[Channels]:
        if self._kept is not None:
            yield from self._kept
            return
        for chosen in ear_model.channel_chunks(
            len(self._items), self._extent.padded, self._signals.device
        ):
            yield self._hear(chosen)

    def _hear(self, chosen: slice) -> Channels:
        raise NotImplementedError
