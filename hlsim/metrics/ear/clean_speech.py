"""Clean speech or music as the reference of scores, and the alignment of outputs with it.

A clean signal is validated, resampled to the ear's rate of 24 kHz, and cut to its audible part. The
output of an aid is then resampled to the same rate, shifted in time to match the clean signal, and
cut to the same part.
"""

import torch
from torch import Tensor

from hlsim.metrics.ear import alignment, ear_rate
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.recursions import RATE, apply_filter, middle_ear

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of clean speech or music in dB SPL for which a score can be trusted."""

MIN_AUDIBLE_SAMPLES = 384
"""Smallest number of samples at 24 kHz from the first to the last audible one.

It is the length of a segment of HASQI, 16 ms.
"""


class UnscorableError(ValueError):
    """Error for a clean signal that is too soft or too short for a meaningful score.

    >>> issubclass(UnscorableError, ValueError)
    True
    """


class CleanBatch:
    """Clean signals of a batch, cut to their audible parts, with which outputs are aligned.

    Args:
        clean: Clean signals of all items. Shape: (all items, time).
        ends: Number of samples of each of these items before padding.
        items: Range of the items that belong to the batch: one item on a CPU, because the caches
            have no room for more, and all items on a GPU.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.

    Attributes:
        items: Range of the items that belong to the batch.
        dtype: Precision in which scores are computed, float32 or float64.
        audible: Length of the audible part of each item: number of samples at 24 kHz from the first
            to the last one that is not silent.
        signals: Audible parts in multiples of 20 uPa, float64. Shape: (items, padded).

    Raises:
        UnscorableError: A signal is silent, too soft or too short to be scored.

    >>> speech = torch.randn(2, 16000)
    >>> CleanBatch(speech, [16000, 16000], slice(0, 1), 16000, 94.0).signals.shape
    torch.Size([1, 24000])
    """

    def __init__(
        self,
        clean: Tensor,
        ends: list[int],
        items: slice,
        sample_rate: int,
        full_scale_spl: float,
    ) -> None:
        self.items = items
        self.dtype = torch.promote_types(clean.dtype, torch.float32)
        self._rate, self._gain = sample_rate, 10.0 ** (full_scale_spl / 20.0)
        self._extent = Extent(tuple(ends[items]))
        # Double precision, because one sample more at an end would shift all frames.
        signals = self._extent.cut(clean[items].double())
        variance = self._extent.mean(self._extent.centred(signals).square())
        levels = 10.0 * variance.clamp_min(1e-30).log10() + full_scale_spl
        at_ear = self._to_ear_rate(signals)
        first, last = ear_rate.audible_ends(at_ear)
        lengths = (last - first + 1).tolist()
        for item, level, length in zip(
            range(len(clean))[items], levels.tolist(), lengths, strict=True
        ):
            label = "clean" if len(clean) == 1 else f"clean, item {item},"
            if round(level, 1) < LOWEST_REFERENCE_SPL:
                raise UnscorableError(
                    f"{label} is silent or too soft, at {level:.1f} dB SPL with full_scale_spl "
                    f"{full_scale_spl:g}; expected {LOWEST_REFERENCE_SPL:g} dB SPL or more; "
                    "calibrate the signal (--spl on the command line, hlsim.load_audio in Python), "
                    "or leave it out"
                )
            if length < MIN_AUDIBLE_SAMPLES:
                raise UnscorableError(
                    f"{label} has sound for only {1000.0 * length / RATE:.2g} ms; expected "
                    f"{1000.0 * MIN_AUDIBLE_SAMPLES / RATE:g} ms or more; leave this signal out"
                )
        self._resampled = ear_rate.at_ear_rate(self._extent, sample_rate)
        self._spectrum = alignment.spectrum_for_alignment(at_ear.to(self.dtype), self._resampled)
        self._first = first
        self.audible = Extent(tuple(lengths))
        self.signals = self._cut(at_ear, -first)

    def _to_ear_rate(self, signals: Tensor) -> Tensor:
        """Resample signals to 24 kHz, and convert them to multiples of 20 uPa.

        Shape: (items, longest) -> (items, longest at 24 kHz).
        """
        return ear_rate.to_ear_rate(signals, self._rate, self._extent) * self._gain

    def _cut(self, at_ear: Tensor, delays: Tensor) -> Tensor:
        """Delay signals at 24 kHz, and cut them to the length of the audible parts.

        Args:
            at_ear: Signals. Shape: (items, time).
            delays: Delays in samples; negative ones advance the signal. Shape: (items,).

        Returns:
            Parts of the signals. Shape: (items, padded).
        """
        audible = self.audible
        return alignment.shift(at_ear, delays, self._resampled.ends, audible.ends, audible.padded)

    def align(self, output: Tensor) -> Tensor:
        """Return the parts of outputs that match the audible parts of the clean signals.

        Each output is shifted as a whole to lie 2 ms behind its clean signal, see
        ``alignment.bulk_delays``.

        Args:
            output: Outputs for all items, not only those of this batch. Shape: (all items,
                time).

        Returns:
            Aligned parts behind the middle ear, in multiples of 20 uPa. Shape: (items, padded).
        """
        at_ear = self._to_ear_rate(self._extent.cut(output[self.items].double()))
        waveform = at_ear.detach().to(self.dtype)
        delays = alignment.bulk_delays(self._spectrum, waveform, self._resampled)
        return self.through_middle_ear(self._cut(at_ear, delays - self._first))

    def through_middle_ear(self, signals: Tensor) -> Tensor:
        """Filter signals by the middle ear, in the precision of the scores.

        Shape: (items, padded) -> (items, padded).
        """
        return apply_filter(middle_ear, signals.to(self.dtype))
