"""Comparison of two signals in one impaired ear, which HASQI and HAAQI have in common.

The ear receives the clean signal amplified by NAL-R. What is scored is therefore distortion, noise
and colour, not whether enough is audible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import Lengths, check_choice
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech, ItemGroup
from hlsim.metrics.ear.model import AUDIOMETRIC_HZ, CHANNELS, Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.haspi_score import Noise, item_seeds, legacy_rng_after_normals
from hlsim.torchtools import constant

NALR_ORDER = 140
NALR_BIAS = np.array([-17.0, -8.0, 1.0, -1.0, -2.0, -2.0])

THRESHOLD_NOISE_DB = -10.0
"""Level of the noise on the motion of the basilar membrane, in dB over threshold."""

FROZEN_SAMPLES = 2**17
"""Length of the noise from which every channel takes a part."""

FROZEN_STRIDE = 4001
"""Samples between the parts of two neighbouring channels."""

NoiseSource = Callable[[slice, Extent], Tensor]
"""Function that returns noise of some channels, (items or 1, channels, longest).

Channels are requested in ascending order.
"""


class QualityParts(NamedTuple):
    """Score of quality and its two parts. Shape of all: (...,).

    Attributes:
        combined: the score, 0 to 1.
        nonlinear: similarity of envelopes and fine structure, which noise and distortion reduce.
        linear: similarity of long-term spectra, which colour reduces.

    >>> QualityParts(torch.tensor(0.4), torch.tensor(0.5), torch.tensor(0.8)).nonlinear
    tensor(0.5000)
    """

    combined: Tensor
    nonlinear: Tensor
    linear: Tensor


class Comparison(NamedTuple):
    """Features of two signals in one ear, from which a score is computed.

    Attributes:
        clean_levels, processed_levels: smoothed levels in dB over threshold. Shape: (items, 32,
            segments).
        coherence: coherence of the fine structures. Shape: (items, 32, segments of 16 ms).
        energy: mean squares of the clean segments. Shape: (items, 32, segments of 16 ms).
        clean_spectrum, processed_spectrum: long-term levels in dB over threshold. Shape: (items,
            32).

    >>> Comparison._fields[:2]
    ('clean_levels', 'processed_levels')
    """

    clean_levels: Tensor
    processed_levels: Tensor
    coherence: Tensor
    energy: Tensor
    clean_spectrum: Tensor
    processed_spectrum: Tensor


class QualityReference:
    """Clean signals in an impaired ear, prepared for the scores of many processed signals.

    Subclasses compute the score from a ``Comparison``.

    Args:
        clean: clean signals, whose dtype and device are those of the scores. Their gradient is not
            computed.
        audiogram: the impaired ear, -10 to 120 dB HL; one ear, or one for each item.
        sample_rate: sample rate in Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0.
        lengths: number of samples of each item in a padded batch.
        whole_khz: round the rate to whole kHz, as pyclarity does.
        keep: store the clean signal's features; otherwise they are computed for each score, which
            takes less memory.

    Raises:
        ValueError: clean signals that are too short, not finite, silent or below 20 dB SPL; a rate,
            level, audiogram or length out of range.

    >>> from hlsim import example_speech
    >>> from hlsim.metrics import HasqiReference
    >>> parts = HasqiReference(example_speech()[:16000], "N3").parts(example_speech()[:16000])
    >>> bool(parts.combined == parts.nonlinear * parts.linear)
    True
    """

    score_name: ClassVar[str]
    envelope_segment: ClassVar[int]

    @torch.inference_mode(False)  # the features may serve a training later
    def __init__(
        self,
        clean: Tensor,
        audiogram: AudiogramLike,
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
        signals = self._signals
        ears = signals.thresholds(audiogram)
        host_ears = signals.thresholds(audiogram, host=True).detach().double().numpy()
        unit = 10.0 ** (-check_full_scale(full_scale_spl) / 20.0)
        with torch.autocast(clean.device.type, enabled=False):
            self._batches = [
                _Batch(
                    signals,
                    batch,
                    ears[batch.items],
                    host_ears[batch.items],
                    unit,
                    self.envelope_segment,
                    keep,
                )
                for batch in signals.batches
            ]

    def score(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> Tensor:
        """Return the score of each processed signal.

        Args:
            processed: signals of the shape, rate and scale of the clean ones. Lengths that differ
                by 0.1 s at most are cut to the shorter one, with a warning.
            noise: noise at the threshold of hearing, as in ``hasqi``.
            seed: one seed, or one for each item.

        Shape: (..., time) -> (...,).

        Raises:
            ValueError: signals of another shape, not finite or on another device.
        """
        return self.parts(processed, noise=noise, seed=seed).combined

    def parts(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> QualityParts:
        """Return the score of each processed signal with its nonlinear and its linear part.

        The arguments are those of ``score``.
        """
        check_choice("noise", noise, Noise)
        processed, shorter = self._signals.cut(processed)
        if shorter is not None:
            reference = type(self)(**shorter, audiogram=self._audiogram, keep=False)
            return reference.parts(processed, noise=noise, seed=seed)
        rows = self._signals.check(processed)
        seeds = item_seeds(seed, self._signals.shape)
        with torch.autocast(processed.device.type, enabled=False):
            parts = []
            for batch in self._batches:
                comparison = batch.compare(rows, noise, seeds)
                parts.append(self._compute_parts(comparison, batch.extent))
            scores = torch.cat(parts).reshape(*self._signals.shape, 2)
            nonlinear, linear = scores.unbind(-1)
            return QualityParts(self._combine(nonlinear, linear), nonlinear, linear)

    @staticmethod
    def _compute_parts(comparison: Comparison, extent: Extent) -> Tensor:
        """Return the nonlinear and the linear part of each item. Shape: -> (items, 2)."""
        raise NotImplementedError

    @staticmethod
    def _combine(nonlinear: Tensor, linear: Tensor) -> Tensor:
        """Return the scores. Shape: (...,) twice -> (...,)."""
        raise NotImplementedError


# -- items that are processed together -------------------------------------------------------------


@dataclass(frozen=True)
class _Channels:
    """Features of the clean signal in some channels.

    Attributes:
        channels: the channels.
        envelope, motion: spectra that find the lags of the processed signal.
        delays: delays that equalise the filters' group delays. Shape: (items, channels).
        smooth_levels: smoothed levels. Shape: (items, channels, segments).
        adapted_motion: motion after adaptation. Shape: (items, channels, padded).
        segments: ``segment_spectra`` of that motion.
        spectrum: long-term levels in dB over threshold. Shape: (items, channels).
    """

    channels: slice
    envelope: Tensor
    motion: Tensor
    delays: Tensor
    smooth_levels: Tensor
    adapted_motion: Tensor
    segments: tuple[Tensor, Tensor]
    spectrum: Tensor


class _Batch:
    """Clean signals of a batch in their impaired ears.

    Args:
        signals: all clean signals.
        batch: those of the batch.
        ears, host_ears: ears of the items, on the device of the signals and on the CPU.
            Shape: (items, 8) dB HL.
        unit: amplitude of 20 uPa in the signals.
        envelope_segment: samples of a segment of the smoothed envelopes.
        keep: compute the features now, and store them.
    """

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        ears: Tensor,
        host_ears: NDArray[np.float64],
        unit: float,
        envelope_segment: int,
        keep: bool,
    ) -> None:
        self._signals, self._batch = signals, batch
        self.extent = batch.audible
        with torch.no_grad():
            amplified = _amplify(batch.signals, host_ears, batch.audible)
            cells = ear_model.hair_cells(ears)
        self._groups = [
            _Group(
                signals,
                batch,
                items,
                amplified[items],
                cells.select_items(items),
                unit,
                envelope_segment,
            )
            for items in signals.groups(batch)
        ]
        if keep:
            for group in self._groups:
                group.store()

    def compare(self, processed: Tensor, noise: Noise, seeds: list[int]) -> Comparison:
        """Compare all processed signals with the clean ones.

        Args:
            processed: all signals. Shape: (items, time).
            noise: kind of noise.
            seeds: seeds of all items.
        """
        aligned = self._signals.align(processed, self._batch)
        batch_seeds = seeds[self._batch.items]
        comparisons = [group.compare(aligned, noise, batch_seeds) for group in self._groups]
        return Comparison(*(_join_items(parts) for parts in zip(*comparisons, strict=True)))


def _join_items(parts: Sequence[Tensor]) -> Tensor:
    """Join tensors of several groups of items. Segments that a group lacks are zero."""
    longest = max(part.shape[-1] for part in parts)
    return torch.cat([functional.pad(part, (0, longest - part.shape[-1])) for part in parts])


class _Group(ItemGroup[_Channels]):
    """Items whose ears are computed together, each with the features of its clean signal."""

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        items: slice,
        amplified: Tensor,
        cells: ear_model.HairCells,
        unit: float,
        envelope_segment: int,
    ) -> None:
        super().__init__(signals, batch, items)
        self._unit = unit
        self._noise_amplitude = unit * 10.0 ** (THRESHOLD_NOISE_DB / 20.0)
        self._envelope_segment = envelope_segment
        self._counts = fine_structure.segments_of(self._extent)
        self._cells = cells
        with torch.no_grad():
            self._clean = signals.through_middle_ear(amplified, self._extent)
            self._longest_delay = ear_model.longest_group_delay(self._clean, cells, self._extent)

    @torch.no_grad()
    def _prepare(self, channels: slice) -> _Channels:
        extent, cells = self._extent, self._cells[channels]
        cochlea = ear_model.simulate_cochlea(
            self._clean, self._cells, channels, extent, motion=True
        )
        assert cochlea.motion is not None
        delays = self._longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        levels = ear_model.apply_adaptation(ear_model.sensation(cochlea.power, cells.inner))
        motion = scale_motion_to_level(cochlea.motion, cochlea.power, levels, self._unit)
        return _Channels(
            channels=channels,
            envelope=ear_model.lag_spectrum(cochlea.power.sqrt(), extent),
            motion=ear_model.lag_spectrum(cochlea.motion, extent),
            delays=delays,
            smooth_levels=self._smooth(levels, delays),
            adapted_motion=motion,
            segments=self._segment_spectra(motion, delays),
            spectrum=ear_model.mean_level(cochlea, cells),
        )

    def _smooth(self, levels: Tensor, delays: Tensor) -> Tensor:
        """Smooth levels after equalising the group delays."""
        extent = self._extent
        delayed = ear_model.shift(levels, delays, extent.ends, extent.ends, extent.longest)
        return fine_structure.smooth_levels(delayed, extent, self._envelope_segment)

    def _segment_spectra(
        self, motion: Tensor, delays: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Add noise to the motion, equalise the group delays, and compute ``segment_spectra``."""
        extent = self._extent
        motion = motion[..., : extent.longest]
        if noise is not None:
            motion = motion + self._noise_amplitude * noise
        delayed = ear_model.shift(motion, delays, extent.ends, extent.ends, extent.longest)
        return fine_structure.segment_spectra(delayed, extent)

    def compare(self, processed: Tensor, noise: Noise, seeds: list[int]) -> Comparison:
        """Compare the signals in all channels. Shape: (items, padded) of the batch."""
        extent = self._extent
        sound = self._signals.through_middle_ear(processed[self.items], extent)
        clean_noise, processed_noise = _noise_sources(noise, seeds[self.items], extent, sound)
        comparisons: list[Comparison] = []
        for clean in self._channels():
            cells = self._cells[clean.channels]
            cochlea = ear_model.simulate_cochlea(
                sound, self._cells, clean.channels, extent, motion=True
            )
            assert cochlea.motion is not None
            lags = ear_model.channel_lags(clean.envelope, cochlea.power.detach().sqrt(), extent)
            power = ear_model.shift(cochlea.power, lags, extent.ends, extent.ends, extent.padded)
            lags = ear_model.channel_lags(clean.motion, cochlea.motion.detach(), extent)
            motion = ear_model.shift(cochlea.motion, lags, extent.ends, extent.ends, extent.padded)
            levels = ear_model.apply_adaptation(ear_model.sensation(power, cells.inner))
            motion = scale_motion_to_level(motion, power, levels, self._unit)
            smooth_levels = self._smooth(levels, clean.delays)
            noise_values = None
            if processed_noise is not None:
                noise_values = processed_noise(clean.channels, extent)
            segments = self._segment_spectra(motion, clean.delays, noise_values)
            clean_segments = clean.segments
            if clean_noise is not None:
                noise_values = clean_noise(clean.channels, extent)
                clean_segments = self._segment_spectra(
                    clean.adapted_motion, clean.delays, noise_values
                )
            comparison = Comparison(
                clean_levels=clean.smooth_levels,
                processed_levels=smooth_levels,
                coherence=fine_structure.coherence(clean_segments, segments, self._counts),
                energy=clean_segments[1],
                clean_spectrum=clean.spectrum,
                processed_spectrum=ear_model.mean_level(cochlea, cells),
            )
            comparisons.append(comparison)
        return Comparison(*(torch.cat(parts, 1) for parts in zip(*comparisons, strict=True)))


def scale_motion_to_level(motion: Tensor, power: Tensor, levels: Tensor, unit: float) -> Tensor:
    """Give the motion of the basilar membrane the adapted level as its envelope.

    Envelope and motion are aligned separately. Where the shift of the envelope leaves nothing,
    pyclarity keeps the motion in the unit of the signals, and so does this function.

    Args:
        motion: motion of the basilar membrane.
        power: power of its envelope, in multiples of that at 0 dB SPL.
        levels: adapted levels in dB over threshold.
        unit: amplitude of 20 uPa in the signals.

    Shape: (items, channels, padded) three times -> (items, channels, padded).

    >>> motion, power, levels = torch.tensor([4.0]), torch.tensor([100.0]), torch.tensor([20.0])
    >>> scale_motion_to_level(motion, power, levels, unit=0.25)
    tensor([8.])
    """
    scaled = motion * levels * power.clamp_min(1.0).rsqrt()  # below 0 dB SPL the level is 0
    return torch.where(power > 0.0, scaled, unit * motion)


# -- noise -----------------------------------------------------------------------------------------


def _noise_sources(
    noise: Noise, seeds: list[int], extent: Extent, like: Tensor
) -> tuple[NoiseSource | None, NoiseSource | None]:
    """Return the sources of noise for the clean and for the processed signals."""
    if noise == "none":
        return None, None
    if noise == "expected":
        # Only audible parts of the clean signal count, and the noise is far below them.
        return None, partial(_frozen_noise, like=like)
    return _drawn_noise(seeds, extent, like, 0), _drawn_noise(seeds, extent, like, 1)


def _drawn_noise(seeds: list[int], extent: Extent, like: Tensor, skipped: int) -> NoiseSource:
    """Draw the noise of pyclarity, after skipping the deviates of a number of signals."""
    generators = [
        legacy_rng_after_normals(seed, skipped * CHANNELS * end)
        for seed, end in zip(seeds, extent.ends, strict=True)
    ]

    def draw(channels: slice, extent: Extent) -> Tensor:
        count = channels.stop - channels.start
        noise = torch.zeros(len(extent.ends), count, extent.longest, dtype=like.dtype)
        for row, generator, end in zip(noise, generators, extent.ends, strict=True):
            row[:, :end] = torch.from_numpy(generator.standard_normal((count, end)))
        return noise.to(like.device, non_blocking=like.device.type != "cpu")

    return draw


def _frozen_noise(channels: slice, extent: Extent, *, like: Tensor) -> Tensor:
    """Return the same noise every time: each channel takes its part of one signal."""
    table = constant(_frozen_table, dtype=torch.float32, device=like.device)
    first = channels.start * FROZEN_STRIDE
    last = (channels.stop - 1) * FROZEN_STRIDE
    repeated = table.repeat(-(-(last + extent.longest) // FROZEN_SAMPLES))[first:]
    count = channels.stop - channels.start
    return repeated.unfold(0, extent.longest, FROZEN_STRIDE)[:count].to(like)


def _frozen_table() -> NDArray[np.float64]:
    return np.random.RandomState(0).standard_normal(FROZEN_SAMPLES)


# -- NAL-R -----------------------------------------------------------------------------------------


def _nalr(thresholds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the taps of NAL-R at 24 kHz, linear in dB between the audiometric frequencies.

    Shape: (8,) dB HL -> (141,).

    Source: Byrne and Dillon 1986, Ear and Hearing 7(4), 257-265.
    """
    loss = thresholds[[FREQUENCIES.index(hz) for hz in AUDIOMETRIC_HZ]]
    if loss.max() <= 0.0:
        return np.eye(NALR_ORDER + 1)[NALR_ORDER // 2]
    sum_of_three = float(loss[1:4].sum())  # at 500, 1000 and 2000 Hz
    if sum_of_three <= 180.0:
        common_gain = 0.05 * sum_of_three
    else:
        common_gain = 9.0 + 0.116 * (sum_of_three - 180.0)
    gains = np.maximum(common_gain + 0.31 * loss + NALR_BIAS, 0.0)
    grid = np.arange(NALR_ORDER + 1) / NALR_ORDER
    decibels = np.interp(grid * RATE / 2, AUDIOMETRIC_HZ, gains)
    return frequency_sampling_fir(len(grid), grid, 10.0 ** (decibels / 20.0), hamming(len(grid)))


def _amplify(signals: Tensor, ears: NDArray[np.float64], extent: Extent) -> Tensor:
    """Amplify signals by NAL-R. As in pyclarity, the output begins at the filter's last tap.

    Shape: (items, padded), (items, 8) dB HL -> (items, padded).
    """
    points = fft_length(extent.longest + NALR_ORDER, 2)
    taps = torch.from_numpy(np.stack([_nalr(ear) for ear in ears]))
    fir = taps.to(signals.device, signals.dtype, non_blocking=signals.device.type != "cpu")
    spectrum = torch.fft.rfft(signals[:, : extent.longest], points) * torch.fft.rfft(fir, points)
    filtered = torch.fft.irfft(spectrum, points)[:, NALR_ORDER : NALR_ORDER + extent.longest]
    return functional.pad(filtered, (0, extent.padded - extent.longest))
