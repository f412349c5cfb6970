"""Comparison of two signals in one impaired ear, which HASQI and HAAQI have in common.

The ear receives the clean signal amplified by NAL-R, and the output of an aid as it is. The scores
therefore show distortion, noise and colour, not whether enough is audible.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from compensators.nalr import nalr_gains_db
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.model import AUDIOMETRIC_HZ, AUDIOMETRIC_INDICES, CHANNELS
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.haspi_score import legacy_rng_after_normals
from hlsim.metrics.pair import Noise
from hlsim.metrics.reference import PreparedBatch, Reference, map_on_cores
from hlsim.torchtools import constant

NALR_ORDER = 140
"""Order of the filter that amplifies the clean signal."""

THRESHOLD_NOISE_DB = -10.0
"""Level of the noise on the motion of the basilar membrane, in dB over threshold."""

FROZEN_SAMPLES = 2**17
"""Length of the fixed noise of ``noise="expected"``, from which every channel takes a part."""

FROZEN_STRIDE = 4001
"""Samples between the starts of the parts of two neighbouring channels."""


class QualityParts(NamedTuple):
    """HASQI or HAAQI with the two parts from which it follows. Shape of all: (...,).

    Attributes:
        combined: The score, 0 to 1.
        nonlinear: Similarity of envelopes and fine structure, 0 to 1. Noise and distortion reduce
            it.
        linear: Similarity of long-term spectra, 0 to 1. Changes of the frequency response reduce
            it.

    >>> QualityParts(torch.tensor(0.4), torch.tensor(0.5), torch.tensor(0.8)).nonlinear
    tensor(0.5000)
    """

    combined: Tensor
    nonlinear: Tensor
    linear: Tensor


class Comparison(NamedTuple):
    """Features of a clean signal and of the output of an aid in one ear, which give a score.

    The ear divides sounds into 32 channels, bands of frequencies.

    Attributes:
        clean_levels: Levels of the clean signal in dB over threshold, smoothed over segments of 16
            ms (HASQI) or 8 ms (HAAQI). Shape: (items, 32, segments).
        processed_levels: The same of the output.
        coherence: Similarity of the fine structures in each segment of 16 ms, 0 to 1. Shape:
            (items, 32, segments).
        energy: Mean square of the clean signal in each segment of 16 ms. Shape: (items, 32,
            segments).
        clean_spectrum: Long-term level of the clean signal in each channel, in dB over threshold.
            Shape: (items, 32).
        processed_spectrum: The same of the output.

    >>> Comparison._fields[:2]
    ('clean_levels', 'processed_levels')
    """

    clean_levels: Tensor
    processed_levels: Tensor
    coherence: Tensor
    energy: Tensor
    clean_spectrum: Tensor
    processed_spectrum: Tensor


class QualityReference(Reference):
    """Base of ``HasqiReference`` and ``HaaqiReference``: clean signals in an impaired ear.

    Subclasses compute the score from a ``Comparison``.

    Args:
        clean: Clean signals, not amplified. The scores have their dtype and their device. Their
            gradient is not computed. Shape: (..., time).
        audiogram: The impaired ear, -10 to 120 dB HL; one ear, or one for each item.
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        keep: Store the clean signals' features, about 18 MB per second in float32; otherwise they
            are computed for each score.

    Raises:
        ValueError: Clean signals that last less than 0.7 s, are not finite, silent or below 20 dB
            SPL; a rate, level, audiogram or length out of range.

    >>> from hlsim import example_speech
    >>> from hlsim.metrics import HasqiReference
    >>> parts = HasqiReference(example_speech()[:16000], "N3").parts(example_speech()[:16000])
    >>> bool(parts.combined == parts.nonlinear * parts.linear)
    True
    """

    envelope_segment: ClassVar[int]

    def _prepare_batches(self, signals: CleanSpeech, keep: bool) -> list[PreparedBatch]:
        ears = signals.thresholds(self._audiogram)
        host_ears = signals.thresholds(self._audiogram, host=True).detach().double()

        def prepare(batch: CleanBatch) -> _Batch:
            amplified = _amplify(batch.signals, host_ears[batch.items], batch.audible)
            cells = ear_model.hair_cells(ears[batch.items])
            return _Batch(signals, batch, amplified, cells, keep, score=type(self))

        return map_on_cores(prepare, signals.batches, signals.clean)

    def score(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> Tensor:
        """Return the score of each output of an aid.

        Args:
            processed: Outputs of the shape, rate and scale of the clean signals. Lengths that
                differ by 0.1 s at most are cut to the shorter one, with a warning. Shape: (...,
                time).
            noise: Noise at the threshold of hearing: ``"expected"``, the same every time;
                ``"seeded"``, the noise that pyclarity draws; or ``"none"``.
            seed: Seed of the drawn noise, or one seed for each item.

        Returns:
            Scores, 0 to 1. Shape: (...,).

        Raises:
            ValueError: Outputs of another shape, not finite or on another device.
        """
        return self.parts(processed, noise=noise, seed=seed).combined

    def parts(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> QualityParts:
        """Return the score of each output of an aid with its nonlinear and its linear part.

        Args:
            processed: Outputs of the shape, rate and scale of the clean signals. Shape: (...,
                time).
            noise: Noise at the threshold of hearing: ``"expected"``, the same every time;
                ``"seeded"``, the noise that pyclarity draws; or ``"none"``.
            seed: Seed of the drawn noise, or one seed for each item.

        Raises:
            ValueError: Outputs of another shape, not finite or on another device.
        """
        return QualityParts(*self._compare(processed, noise, seed).unbind(-1))

    @staticmethod
    @abstractmethod
    def _compute_parts(comparison: Comparison, extent: Extent) -> QualityParts:
        """Compute the score of each item and its parts.

        Args:
            comparison: Features of the clean signals and of the outputs.
            extent: Number of samples of each item before padding.
        """


# -- batches --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Channels:
    """Features of the clean signal in some channels.

    Attributes:
        channels: The channels.
        envelope, motion: Spectra with which envelope and motion of an output are aligned.
        delays: Delays that make up for different group delays. Shape: (items, channels).
        smooth_levels: Smoothed levels. Shape: (items, channels, segments).
        adapted_motion: Motion after adaptation. Shape: (items, channels, padded).
        segments: ``segment_spectra`` of that motion.
        level: Long-term level in dB over threshold. Shape: (items, channels).
    """

    channels: slice
    envelope: Tensor
    motion: Tensor
    delays: Tensor
    smooth_levels: Tensor
    adapted_motion: Tensor
    segments: tuple[Tensor, Tensor]
    level: Tensor


class _Batch(PreparedBatch):
    """Clean signals of a batch, amplified by NAL-R, in their impaired ears.

    Args:
        arguments: Those of ``PreparedBatch``.
        score: The score that is computed.
    """

    def __init__(self, *arguments: Any, score: type[QualityReference]) -> None:
        self._score = score
        super().__init__(*arguments)

    @property
    def _unit(self) -> float:
        """Amplitude of 20 uPa in the unit of the input."""
        return 10.0 ** (-self._signals.full_scale / 20.0)

    def _prepare(self, channels: slice) -> _Channels:
        extent = self._extent
        cochlea = self._simulate(self._clean, channels)
        delays = self._longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        levels, motion = self._adapt(cochlea.power, cochlea.motion, channels, delays)
        return _Channels(
            channels=channels,
            envelope=ear_model.lag_spectrum(cochlea.power.sqrt(), extent),
            motion=ear_model.lag_spectrum(cochlea.motion, extent),
            delays=delays,
            smooth_levels=levels,
            adapted_motion=motion,
            segments=self._segment_spectra(motion, delays, None),
            level=cochlea.level,
        )

    def _simulate(self, sound: Tensor, channels: slice) -> ear_model.CochlearOutput:
        return ear_model.simulate_cochlea(sound, self._cells, channels, self._extent, motion=True)

    def _adapt(
        self, power: Tensor, motion: Tensor, channels: slice, delays: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the smoothed levels, with equal group delays, and the adapted motion."""
        levels = ear_model.nerve_levels(power, self._cells[..., channels].inner)
        motion = _scale_motion_to_level(motion, power, levels, self._unit)
        segment = self._score.envelope_segment
        delayed = self._delay(levels, delays)
        return fine_structure.smooth_levels(delayed, self._extent, segment), motion

    def _delay(self, signal: Tensor, delays: Tensor) -> Tensor:
        """Delay channels. Shape: (items, channels, padded) -> (items, channels, longest)."""
        ends, longest = self._extent.ends, self._extent.longest
        return ear_model.shift(signal, delays, ends, ends, longest)

    def _segment_spectra(
        self, motion: Tensor, delays: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Add noise to the motion, delay its channels, and compute ``segment_spectra``."""
        extent = self._extent
        motion = motion[..., : extent.longest]
        if noise is not None:
            motion = motion + self._unit * 10.0 ** (THRESHOLD_NOISE_DB / 20.0) * noise
        return fine_structure.segment_spectra(self._delay(motion, delays), extent)

    def compare(
        self, processed: Tensor, noise: Noise, seeds: Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Compute the score of each item, its nonlinear and its linear part.

        The arguments are those of ``PreparedBatch.compare``.
        """
        sound = self._signals.align(processed, self._batch)
        sources = _NoiseSources(noise, seeds[self._batch.items], self._extent, sound)
        comparisons = [
            self._compare_channels(clean, sound, *sources.draw(clean.channels))
            for clean in self._clean_features()
        ]
        joined = Comparison(*(torch.cat(parts, 1) for parts in zip(*comparisons, strict=True)))
        return torch.stack(self._score._compute_parts(joined, self._extent), -1)

    def _compare_channels(
        self,
        clean: _Channels,
        sound: Tensor,
        clean_noise: Tensor | None,
        processed_noise: Tensor | None,
    ) -> Comparison:
        channels, extent = clean.channels, self._extent
        cochlea = self._simulate(sound, channels)
        power, motion = cochlea.power, cochlea.motion
        envelope = power.detach().sqrt()
        power = ear_model.align_channels(power, envelope, clean.envelope, extent)
        motion = ear_model.align_channels(motion, motion.detach(), clean.motion, extent)
        levels, motion = self._adapt(power, motion, channels, clean.delays)
        segments = self._segment_spectra(motion, clean.delays, processed_noise)
        clean_segments = clean.segments
        if clean_noise is not None:
            clean_segments = self._segment_spectra(clean.adapted_motion, clean.delays, clean_noise)
        counts = fine_structure.segments_of(extent)
        return Comparison(
            clean_levels=clean.smooth_levels,
            processed_levels=levels,
            coherence=fine_structure.coherence(clean_segments, segments, counts),
            energy=clean_segments[1],
            clean_spectrum=clean.level,
            processed_spectrum=cochlea.level,
        )


def _scale_motion_to_level(motion: Tensor, power: Tensor, levels: Tensor, unit: float) -> Tensor:
    """Give the motion of the basilar membrane the level at the auditory nerve as its envelope.

    Envelope and motion are aligned separately. Where the shift of the envelope leaves nothing,
    pyclarity keeps the motion in the unit of the signals, and so does this function.

    Args:
        motion: Motion of the basilar membrane.
        power: Power of its envelope, in multiples of that at 0 dB SPL.
        levels: Levels in dB over threshold.
        unit: Amplitude of 20 uPa in the signals.

    Shape: (items, channels, padded) three times -> (items, channels, padded).
    """
    scaled = motion * levels * power.clamp_min(1.0).rsqrt()  # below 0 dB SPL the level is 0
    return torch.where(power > 0.0, scaled, unit * motion)


# -- noise -----------------------------------------------------------------------------------------


class _NoiseSources:
    """Noise at the threshold of hearing, which is added to the motion of clean signal and output.

    Args:
        noise: Kind of the noise.
        seeds: Seed of each item.
        extent: Number of samples of each item before padding.
        like: Tensor whose dtype and device the noise has.
    """

    def __init__(self, noise: Noise, seeds: Sequence[int], extent: Extent, like: Tensor) -> None:
        self._noise, self._extent, self._like = noise, extent, like
        if noise == "seeded":  # pyclarity draws that of the clean signal, then that of the output
            self._generators = [
                [
                    legacy_rng_after_normals(seed, skipped * CHANNELS * end)
                    for seed, end in zip(seeds, extent.ends, strict=True)
                ]
                for skipped in (0, 1)
            ]

    def draw(self, channels: slice) -> tuple[Tensor | None, Tensor | None]:
        """Return the noise of the clean signal and of the output in some channels.

        Channels must be requested in ascending order.

        Shape: -> (items or 1, channels, longest) twice, or None where there is no noise.
        """
        if self._noise == "seeded":
            clean, processed = (self._draw(generators, channels) for generators in self._generators)
            return clean, processed
        if self._noise == "expected":
            # Only audible parts of the clean signal count, and the noise is far below them.
            return None, self._frozen_noise(channels)
        return None, None

    def _draw(self, generators: list[np.random.RandomState], channels: slice) -> Tensor:
        """Draw the noise of pyclarity."""
        ends, like = self._extent.ends, self._like
        count = channels.stop - channels.start
        noise = torch.zeros(len(ends), count, self._extent.longest, dtype=like.dtype)
        for row, generator, end in zip(noise, generators, ends, strict=True):
            row[:, :end] = torch.from_numpy(generator.standard_normal((count, end)))
        return noise.to(like.device, non_blocking=like.device.type != "cpu")

    def _frozen_noise(self, channels: slice) -> Tensor:
        """Return the same noise every time: each channel takes its part of one signal."""
        longest = self._extent.longest
        table = constant(_frozen_table, dtype=torch.float32, device=self._like.device)
        first = channels.start * FROZEN_STRIDE
        last = (channels.stop - 1) * FROZEN_STRIDE
        repeated = table.repeat(-(-(last + longest) // FROZEN_SAMPLES))[first:]
        count = channels.stop - channels.start
        return repeated.unfold(0, longest, FROZEN_STRIDE)[:count].to(self._like)


def _frozen_table() -> NDArray[np.float64]:
    return np.random.RandomState(0).standard_normal(FROZEN_SAMPLES)


# -- NAL-R -----------------------------------------------------------------------------------------


def _nalr_taps(thresholds: Tensor) -> NDArray[np.float64]:
    """Return the taps of NAL-R at 24 kHz, linear in dB between the audiometric frequencies.

    Shape: (8,) dB HL -> (141,).
    """
    indices = list(AUDIOMETRIC_INDICES)
    if thresholds[indices].max() <= 0.0:
        return np.eye(NALR_ORDER + 1)[NALR_ORDER // 2]
    gains = nalr_gains_db(thresholds)[indices].numpy()
    grid = np.arange(NALR_ORDER + 1) / NALR_ORDER
    decibels = np.interp(grid * RATE / 2, AUDIOMETRIC_HZ, gains)
    return frequency_sampling_fir(len(grid), grid, 10.0 ** (decibels / 20.0))


def _amplify(signals: Tensor, ears: Tensor, extent: Extent) -> Tensor:
    """Amplify signals by NAL-R. As in pyclarity, the output begins at the filter's last tap.

    Shape: (items, padded), (items, 8) dB HL -> (items, padded).
    """
    points = fft_length(extent.longest + NALR_ORDER, 2)
    taps = torch.from_numpy(np.stack([_nalr_taps(ear) for ear in ears]))
    fir = taps.to(signals.device, signals.dtype, non_blocking=signals.device.type != "cpu")
    spectrum = torch.fft.rfft(signals[:, : extent.longest], points) * torch.fft.rfft(fir, points)
    filtered = torch.fft.irfft(spectrum, points)[:, NALR_ORDER : NALR_ORDER + extent.longest]
    return functional.pad(filtered, (0, extent.padded - extent.longest))
