"""Scores of many outputs against the same clean signals, which are prepared once.

``Reference`` is the base of ``HaspiReference``, ``HasqiReference`` and ``HaaqiReference``. It
computes items in groups: one at a time on a CPU, all at once on a GPU.
"""

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL
from hlsim.audiogram.prescription import nalr_gains_db
from hlsim.audiogram.thresholds import AudiogramLike, resolve_thresholds
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import (
    Lengths,
    check_choice,
    check_finite,
    check_lengths,
    check_number,
    check_rate,
    check_seed,
    check_waveform,
)
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import filters_with_gains
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.model import HairCells
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.pair import SHORTEST_SECONDS, Equalisation, Noise, check_pair
from hlsim.torchtools import Samples, as_samples, broadcast_shape, map_on_cores

NALR_ORDER = 140
"""Order of the filter that amplifies the clean signal."""


class PreparedBatch(NamedTuple):
    """Clean signals of a batch with their features in an ear, to be compared with outputs of aids.

    Attributes:
        clean: Audible parts of the clean signals, to which outputs are aligned.
        cells: Hair cells of the ear of each item that receives the clean signals. Shape: (items,
            32).
        features: Features of the clean signals, one object for each group of ``channel_chunks``.

    >>> PreparedBatch._fields
    ('clean', 'cells', 'features')
    """

    clean: CleanBatch
    cells: HairCells
    features: list[Any]


class Reference(ABC):
    """Clean signals that are prepared for the scores of many outputs of aids.

    On a CPU the items of a batch are distributed over as many threads as torch uses, unless a
    gradient is needed. The scores do not depend on the number of threads.

    Args:
        clean: Clean signals. The scores are on their device, and float64 if they are, otherwise
            float32. Their gradient is not computed. Shape: (..., time).
        audiogram: Ear that receives the clean signals, a normal one for HASPI and the impaired one
            for HASQI and HAAQI; one ear, or one for each item.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity: 1 amplifies the clean signals by NAL-R, 2 takes them as
            they are: for HASPI not amplified, for HASQI and HAAQI amplified already.
        keep: Store the clean signals' features; otherwise they are computed, and the level is
            validated, for each score, which takes less memory.

    Raises:
        ValueError: Clean signals that last less than 0.7 s, have less than 16 ms of sound, are not
            floating-point, not finite, above 1e9, silent or below 20 dB SPL; a rate, level,
            audiogram, length or equalisation out of range.

    >>> from hlsim.metrics import HaspiReference
    >>> issubclass(HaspiReference, Reference)
    True
    """

    def __init__(
        self,
        clean: Samples,
        audiogram: AudiogramLike,
        *,
        sample_rate: int = 16000,
        full_scale_spl: float = PASCAL_SPL,
        lengths: Lengths | None = None,
        whole_khz: bool = False,
        equalisation: Equalisation = 1,
        keep: bool = True,
    ) -> None:
        check_number("equalisation", equalisation, 1, 2, whole=True)
        self._amplifies = equalisation == 1
        self._keeps_features = keep
        rate = check_rate(sample_rate)
        self._rate = 1000 * round(rate / 1000) if whole_khz else rate
        self._full_scale_spl = check_full_scale(full_scale_spl)
        clean = check_waveform(as_samples(clean), "clean", full_scale_spl=full_scale_spl)
        self._clean = clean.detach()
        self._rows = self._clean.reshape(-1, clean.shape[-1])
        items, time = self._rows.shape
        self._ends = [time] * items
        if lengths is not None:
            self._ends = check_lengths(lengths, clean.shape).flatten().tolist()
        seconds = min(self._ends) / rate
        if seconds < SHORTEST_SECONDS:
            raise ValueError(
                f"clean has an item of {seconds:.2g} s; expected {SHORTEST_SECONDS} s or more, "
                "because a score means nothing below; pass longer signals"
            )
        check_finite(self._rows, "clean")
        self._ears = self._thresholds(audiogram)
        items_at_once = 1 if clean.device.type == "cpu" else items
        starts = range(0, items, items_at_once)
        self._groups = [slice(start, start + items_at_once) for start in starts]
        self._batches: list[PreparedBatch] = []
        if keep:
            self._batches = map_on_cores(self._prepare, self._groups, self._clean)

    def _thresholds(self, audiogram: AudiogramLike) -> Tensor:
        """Return the thresholds in dB HL of the ear of each item. Shape: -> (items, 8).

        Args:
            audiogram: Ears that broadcast to the leading dimensions of the clean signals, such as
                one, or one for each item.

        Raises:
            ValueError: The ears do not broadcast to the items, or an ear is not valid.
        """
        shape = self._clean.shape[:-1]
        ears = resolve_thresholds(None, audiogram, self._clean, highest=HIGHEST_LEVEL)
        if broadcast_shape(shape, ears.shape[:-1]) != shape:
            raise ValueError(
                f"expected one audiogram or one for each item, got shape {tuple(ears.shape)} "
                f"for signals of shape {tuple(self._clean.shape)}"
            )
        return ears.expand(*shape, 8).reshape(-1, 8)

    @torch.inference_mode(False)  # the features may serve a training later
    @torch.no_grad()
    def _prepare(self, items: slice) -> PreparedBatch:
        """Validate the clean signals of a range of items, and compute their features.

        Raises:
            UnscorableError: A signal is silent, too soft or too short to be scored.
        """
        with torch.autocast(self._clean.device.type, enabled=False):
            clean = CleanBatch(self._rows, self._ends, items, self._rate, self._full_scale_spl)
            ears, at_ear = self._ears[items], clean.signals
            if self._amplifies:
                at_ear = _amplify(at_ear, ears, clean.audible)
            cells = ear_model.hair_cells(ears)
            sound = clean.through_middle_ear(at_ear)
            longest_delay = ear_model.longest_group_delay(sound, cells, clean.audible)
            features = [
                self._features(sound, cells, channels, longest_delay, clean.audible)
                for channels in ear_model.channel_chunks(sound)
            ]
        return PreparedBatch(clean, cells, features)

    @abstractmethod
    def _features(
        self,
        sound: Tensor,
        cells: HairCells,
        channels: slice,
        longest_delay: Tensor,
        extent: Extent,
    ) -> Any:
        """Compute the features of the clean signals in some channels.

        Args:
            sound: Clean signals behind the middle ear at 24 kHz, in multiples of 20 uPa. Shape:
                (items, padded).
            cells: Hair cells of all channels.
            channels: Range of these channels among the 32 of the ear.
            longest_delay: Group delay in samples that all channels have after alignment. Shape:
                (items, 1).
            extent: Number of samples of each item before padding.

        Returns:
            Features in the form that ``_compare`` of the subclass reads.
        """

    @abstractmethod
    def _compare(
        self, batch: PreparedBatch, output: Tensor, cells: HairCells, noise: Noise, seed: int
    ) -> Tensor:
        """Compare outputs of aids with the clean signals of a batch.

        Args:
            batch: The clean signals.
            output: Aligned outputs behind the middle ear at 24 kHz, in multiples of 20 uPa. Shape:
                (items, padded).
            cells: Hair cells of the ears that the outputs reach. Shape: (items, 32).
            noise: Kind of the internal noise of the ear.
            seed: Seed of the noise.

        Returns:
            For each item ten features of HASPI, or score, nonlinear and linear part of HASQI and
            HAAQI. Shape: (items, numbers).
        """

    def _compare_all(
        self, output: Samples, noise: Noise, seed: int, ears: HairCells | None = None
    ) -> Tensor:
        """Validate outputs, and compare them with the clean signals of all groups.

        Args:
            output: Outputs at the sample rate and on the scale of the clean signals. Shape: (...,
                time).
            noise: Kind of the internal noise of the ear.
            seed: Seed of the noise.
            ears: Hair cells of the ears that the outputs reach, (all items, 32); by default those
                of the clean signals.

        Returns:
            Results of ``_compare``. Shape: (..., numbers).

        Raises:
            ValueError: The noise is unknown, the seed is out of range, or outputs have another
                shape than the clean signals, are not floating-point, finite and of at most 1e9, or
                are on another device; or, if the clean side is prepared here (``keep=False``), a
                clean signal is silent, too soft or too short. For HASPI also: clean speech is
                inaudible to a normal ear.
        """
        check_choice("noise", noise, Noise)
        check_seed(seed)
        outputs = as_samples(output)
        check_waveform(outputs, "output", full_scale_spl=self._full_scale_spl)
        check_pair(outputs, self._clean)
        rows = outputs.reshape(self._rows.shape)
        check_finite(rows, "output")

        def compare(group: int) -> Tensor:
            batch = self._batches[group] if self._batches else self._prepare(self._groups[group])
            cells = batch.cells if ears is None else ears[batch.clean.items]
            return self._compare(batch, batch.clean.align(rows), cells, noise, seed)

        with torch.autocast(rows.device.type, enabled=False):
            numbers = map_on_cores(compare, range(len(self._groups)), rows)
        return torch.cat(numbers).reshape(*outputs.shape[:-1], -1)


def _amplify(signals: Tensor, ears: Tensor, extent: Extent) -> Tensor:
    """Amplify signals at 24 kHz by NAL-R for ears with thresholds in dB HL.

    As in pyclarity, the first 140 samples of the filter's output are left out, so that the result
    is 70 samples earlier than the signal. It is zero after the longest item of ``extent``.

    Shape: (items, padded), (items, 8) -> (items, padded).
    """
    points = fft_length(extent.longest + NALR_ORDER, 2)
    taps = filters_with_gains(nalr_gains_db(ears.double()), FREQUENCIES, RATE, NALR_ORDER)
    spectrum = torch.fft.rfft(signals[:, : extent.longest], points) * torch.fft.rfft(taps, points)
    filtered = torch.fft.irfft(spectrum, points)[:, NALR_ORDER : NALR_ORDER + extent.longest]
    return functional.pad(filtered, (0, extent.padded - extent.longest))
