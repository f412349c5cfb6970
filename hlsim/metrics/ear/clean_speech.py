"""Clean speech or music as the reference of scores, and the alignment of outputs with it.

Everything in a score that depends on the clean signal alone is computed here once: it is validated,
resampled to the ear's rate of 24 kHz, and cut to its audible part. The output of an aid is then
brought to the same rate and cut to the same part, behind a delay that makes both match.
"""

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
from hlsim.metrics.ear.extent import Extent, integers
from hlsim.metrics.ear.model import shift
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
    """Clean signals of a batch, cut to their audible parts: one on a CPU, all of them on a GPU.

    Attributes:
        items: Indices of the signals among all items.
        extent: Number of samples of each item at the input's rate.
        resampled: Number of samples of each item at 24 kHz.
        starts: For each item, the first sample at 24 kHz that is not silent.
        audible: Number of samples at 24 kHz from the first to the last one that is not silent.
        spectrum: Spectra from which the delays of outputs are computed.
        signals: Audible parts in multiples of 20 uPa, float64. Shape: (items, padded).

    >>> speech = CleanSpeech(torch.randn(2, 16000), 16000, 94.0, None, False, "HASPI")
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
    """Validated clean signals in batches, with which outputs of aids are aligned.

    On a CPU each item is a batch of its own, because caches hold no more. On a GPU all items are
    one batch.

    Args:
        clean: Clean signals. Shape: (..., time).
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        score_name: Name of the score, for messages.

    Attributes:
        shape: Shape of ``clean`` without time.
        batches: Clean signals in groups that are computed together.
        dtype: Precision of the scores, float32 or float64.
        device: Device of the clean signals and of the scores.

    Raises:
        ValueError: The signals are too short or not finite, or a rate, level or length is out of
            range.
        UnscorableError: The signals are silent, too soft or too short to be scored.

    >>> CleanSpeech(torch.randn(2, 16000), 16000, 94.0, None, False, "HASPI").shape
    torch.Size([2])
    """

    def __init__(
        self,
        clean: Tensor,
        sample_rate: int,
        full_scale_spl: float,
        lengths: Lengths | None,
        whole_khz: bool,
        score_name: str,
    ) -> None:
        self._settings = sample_rate, full_scale_spl
        self._whole_khz, self._score_name = whole_khz, score_name
        self._input_rate = check_rate(sample_rate)
        self.full_scale = check_full_scale(full_scale_spl)
        check_waveform(clean, "clean", full_scale_spl=self.full_scale)
        self.clean, self.shape = clean.detach(), clean.shape[:-1]
        self.dtype, self.device = torch.promote_types(clean.dtype, torch.float32), clean.device
        time = clean.shape[-1]
        self._ends = [time] * self.shape.numel()
        if lengths is not None:
            self._ends = check_lengths(lengths, clean.shape).flatten().tolist()
        self._rate = 1000 * round(self._input_rate / 1000) if whole_khz else self._input_rate
        self._gain = 10.0 ** (self.full_scale / 20.0)
        with torch.no_grad():
            # Double precision, because one sample more at an end would shift all frames.
            rows = self.clean.double().reshape(-1, time)
            self.batches = [self._prepare(rows, items) for items in self._batch_slices(len(rows))]

    def _batch_slices(self, items: int) -> list[slice]:
        """Return the indices of the items of each batch."""
        if self.device.type != "cpu":
            return [slice(0, items)]
        return [slice(item, item + 1) for item in range(items)]

    def _prepare(self, rows: Tensor, items: slice) -> CleanBatch:
        """Validate and prepare some of the items. The host waits for the device once."""
        extent = Extent(tuple(self._ends[items]))
        signals = extent.cut(rows[items])
        variance = extent.mean(extent.centred(signals).square())
        at_ear = ear_input.to_ear_rate(signals, self._rate, extent) * self._gain
        first, last = ear_input.audible_ends(at_ear)
        is_finite, is_sounding = signals.isfinite().all(-1), signals.any(-1)
        values = (is_finite, is_sounding, variance, first, last)
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
        parts = shift(at_ear[:, None], delays, resampled.ends, audible.ends, audible.padded)
        return CleanBatch(
            items, extent, resampled, tuple(starts), audible, spectrum, parts.squeeze(1)
        )

    def _validate(
        self,
        index: int,
        is_finite: float,
        is_sounding: float,
        variance: float,
        first: float,
        last: float,
    ) -> None:
        """Raise an error unless the score of a signal is meaningful."""
        label = "clean" if self.shape.numel() == 1 else f"clean, item {index}"
        seconds = self._ends[index] / self._input_rate
        if seconds < SHORTEST_SECONDS:
            raise ValueError(
                f"{label} lasts {seconds:.2g} s; expected {SHORTEST_SECONDS} s or more, because "
                f"{self._score_name} means nothing below; pass longer signals"
            )
        if not is_finite:
            raise ValueError(
                f"{label} holds samples that are NaN or infinite; leave this signal out"
            )
        level = 10.0 * math.log10(max(variance, 1e-30)) + self.full_scale
        length = last - first + 1
        reason = ""
        if not is_sounding:
            reason = "is silent, every sample is zero; leave this signal out"
        elif level < LOWEST_REFERENCE_SPL:
            reason = (
                f"is at {level:.1f} dB SPL with full_scale_spl {self.full_scale:g}; expected "
                f"{LOWEST_REFERENCE_SPL:g} dB SPL or more, because {self._score_name} means "
                "nothing below; calibrate the signal, for example with hlsim.load_audio"
            )
        elif length < MIN_AUDIBLE_SAMPLES:
            reason = (
                f"has sound for only {1000.0 * length / RATE:.2g} ms; expected "
                f"{1000.0 * MIN_AUDIBLE_SAMPLES / RATE:g} ms or more, as {self._score_name} "
                "requires; leave this signal out"
            )
        if reason:
            raise UnscorableError(f"{label} {reason}")

    def match(self, processed: Tensor) -> tuple[Tensor, CleanSpeech]:
        """Validate outputs of aids, and match their length and that of the clean signals.

        Args:
            processed: Outputs at the rate of the clean signals. Shape: (..., time), where ``time``
                may differ by 0.1 s, which causes a warning.

        Returns:
            Outputs, (items, time), and the clean signals, which are prepared again if they were
            longer.

        Raises:
            ValueError: The outputs are not finite, are on another device, or have another shape.
        """
        check_waveform(processed, "processed", full_scale_spl=self.full_scale)
        processed, clean = cut_to_common_length(processed, self.clean, self._input_rate)
        is_finite = processed.detach().isfinite().all(-1).flatten()
        if not bool(is_finite.all()):
            item = f", item {int(is_finite.int().argmin())}," if len(is_finite) > 1 else ""
            raise ValueError(
                f"processed{item} holds samples that are NaN or infinite; leave this signal out"
            )
        time, signals = clean.shape[-1], self
        if time < self.clean.shape[-1]:
            ends = torch.tensor(self._ends).clamp_max(time).reshape(self.shape)
            signals = CleanSpeech(clean, *self._settings, ends, self._whole_khz, self._score_name)
        return processed.reshape(-1, time), signals

    def thresholds(self, audiogram: AudiogramLike | None, *, host: bool = False) -> Tensor:
        """Return the thresholds of the ear of each item.

        Args:
            audiogram: One ear, or one for each item; None raises ValueError.
            host: Return the thresholds on the CPU, even if this must wait for a GPU.

        Returns:
            Thresholds. Shape: (items, 8) dB HL.
        """
        probe = torch.empty((*self.shape, 1), device=self.device)
        ears = resolve_thresholds(None, audiogram, probe, highest=HIGHEST_LEVEL)
        if broadcast_shape(self.shape, ears.shape[:-1]) != self.shape:
            raise ValueError(
                f"expected one audiogram or one for each item, got shape {tuple(ears.shape)} "
                f"for signals of shape {tuple(self.clean.shape)}"
            )
        ears = on_host(ears) if host else ears
        return ears.expand(*self.shape, 8).reshape(-1, 8)

    def align(self, processed: Tensor, batch: CleanBatch) -> Tensor:
        """Return the parts of outputs that match the audible parts of the clean signals.

        Args:
            processed: Outputs for all items. Shape: (items, time).
            batch: Batch whose items are returned.

        Returns:
            Aligned parts behind the middle ear, in multiples of 20 uPa. Shape: (items of the batch,
            padded).
        """
        signals = batch.extent.cut(processed[batch.items].double())
        at_ear = ear_input.to_ear_rate(signals, self._rate, batch.extent) * self._gain
        delays = ear_input.bulk_delays(
            batch.spectrum, at_ear.detach().to(self.dtype), batch.resampled
        )
        delays = (delays - integers(batch.starts, self.device))[:, None]
        ends, stops = batch.resampled.ends, batch.audible.ends
        parts = shift(at_ear[:, None], delays, ends, stops, batch.audible.padded)
        return self.through_middle_ear(parts.squeeze(1))

    def through_middle_ear(self, signals: Tensor) -> Tensor:
        """Filter signals by the middle ear, in the precision of the scores.

        Shape: (items, padded) -> (items, padded).
        """
        return middle_ear(self.device, self.dtype)(signals.to(self.dtype)).flatten(-2)
