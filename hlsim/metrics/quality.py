"""Comparison of two signals in one impaired ear, which HASQI and HAAQI have in common.

The ear receives the clean signal amplified by NAL-R. What is scored is therefore distortion, noise
and colour, not whether enough is audible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, NamedTuple, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from compensators.nalr import nalr_gains_db
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech
from hlsim.metrics.ear.model import AUDIOMETRIC_HZ, AUDIOMETRIC_INDICES, CHANNELS, Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.haspi_score import legacy_rng_after_normals
from hlsim.metrics.pair import Noise
from hlsim.metrics.reference import PreparedBatch, Reference, Settings, map_on_cores
from hlsim.torchtools import constant

NALR_ORDER = 140
"""Order of the filter that amplifies the clean signal."""

THRESHOLD_NOISE_DB = -10.0
"""Level of the noise on the motion of the basilar membrane, in dB over threshold."""

FROZEN_SAMPLES = 2**17
"""Length of the noise from which every channel takes a part."""

FROZEN_STRIDE = 4001
"""Samples between the parts of two neighbouring channels."""

NoiseSource = Callable[[slice], Tensor | None]
"""Function that returns noise of some channels, (items or 1, channels, longest), or None.

Channels are requested in ascending order.
"""


class QualityParts(NamedTuple):
    """Score of quality and its two parts. Shape of all: (...,).

    Attributes:
        combined: The score, 0 to 1.
        nonlinear: Similarity of envelopes and fine structure, which noise and distortion reduce.
        linear: Similarity of long-term spectra, which colour reduces.

    >>> QualityParts(torch.tensor(0.4), torch.tensor(0.5), torch.tensor(0.8)).nonlinear
    tensor(0.5000)
    """

    combined: Tensor
    nonlinear: Tensor
    linear: Tensor


class Comparison(NamedTuple):
    """Features of two signals in one ear, from which a score is computed.

    Attributes:
        clean_levels, processed_levels: Smoothed levels in dB over threshold. Shape: (items, 32,
            segments).
        coherence: Coherence of the fine structures. Shape: (items, 32, segments of 16 ms).
        energy: Mean squares of the clean segments. Shape: (items, 32, segments of 16 ms).
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


class QualityReference(Reference["_Batch"]):
    """Clean signals in an impaired ear, prepared for the scores of many processed signals.

    Subclasses compute the score from a ``Comparison``. In float32 it takes about 18 MB per second.

    Args:
        clean: Clean signals, not amplified. The scores have their dtype and their device. Their
            gradient is not computed.
        audiogram: The impaired ear, -10 to 120 dB HL; one ear, or one for each item.
        settings: ``sample_rate``, ``full_scale_spl``, ``lengths`` and ``whole_khz`` as for
            ``haspi``. ``keep=False`` computes the clean signals' features for each score instead
            of storing them, which takes less memory.

    Raises:
        ValueError: As for ``haspi``.

    >>> from hlsim import example_speech
    >>> from hlsim.metrics import HasqiReference
    >>> parts = HasqiReference(example_speech()[:16000], "N3").parts(example_speech()[:16000])
    >>> bool(parts.combined == parts.nonlinear * parts.linear)
    True
    """

    envelope_segment: ClassVar[int]

    def __init__(
        self, clean: Tensor, audiogram: AudiogramLike, **settings: Unpack[Settings]
    ) -> None:
        super().__init__(clean, audiogram, **settings)

    def _prepare_batches(self, signals: CleanSpeech) -> list[_Batch]:
        assert self._audiogram is not None
        ears = signals.thresholds(self._audiogram)
        host_ears = signals.thresholds(self._audiogram, host=True).detach().double()
        return map_on_cores(
            lambda batch: _Batch(
                signals, batch, ears[batch.items], host_ears[batch.items], type(self)
            ),
            signals.batches,
            signals.clean,
        )

    def score(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> Tensor:
        """Return the score of each processed signal.

        Args:
            processed: Signals of the shape, rate and scale of the clean ones. Lengths that differ
                by 0.1 s at most are cut to the shorter one, with a warning.
            noise: Noise at the threshold of hearing, as in ``hasqi``.
            seed: One seed, or one for each item.

        Shape: (..., time) -> (...,).

        Raises:
            ValueError: Signals of another shape, not finite or on another device.
        """
        return self.parts(processed, noise=noise, seed=seed).combined

    def parts(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> QualityParts:
        """Return the score of each processed signal with its nonlinear and its linear part.

        The arguments are those of ``score``.
        """
        nonlinear, linear = self._compare(processed, noise, seed).unbind(-1)
        return QualityParts(self._combine(nonlinear, linear), nonlinear, linear)

    @staticmethod
    def compute_parts(comparison: Comparison, extent: Extent) -> Tensor:
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
        channels: The channels.
        envelope, motion: Spectra that find the lags of the processed signal.
        delays: Delays that equalise the filters' group delays. Shape: (items, channels).
        smooth_levels: Smoothed levels. Shape: (items, channels, segments).
        adapted_motion: Motion after adaptation. Shape: (items, channels, padded).
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


class _Batch(PreparedBatch[_Channels]):
    """Clean signals of a batch in their impaired ears.

    Args:
        signals: All clean signals.
        batch: Those of the batch.
        ears, host_ears: Ears of the items, on the device of the signals and on the CPU.
            Shape: (items, 8) dB HL.
        score: The score that is computed.
    """

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        ears: Tensor,
        host_ears: Tensor,
        score: type[QualityReference],
    ) -> None:
        amplified = _amplify(batch.signals, host_ears, batch.audible)
        super().__init__(signals, batch, amplified, ear_model.hair_cells(ears))
        self._score = score
        self._unit = 10.0 ** (-signals.full_scale / 20.0)

    def _prepare(self, channels: slice) -> _Channels:
        extent = self._extent
        cochlea, motion = self._simulate(self._clean, channels)
        delays = self._longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        cells = self._cells[channels]
        smooth_levels, adapted_motion = self._adapt(cochlea.power, motion, cells, delays)
        return _Channels(
            channels=channels,
            envelope=ear_model.lag_spectrum(cochlea.power.sqrt(), extent),
            motion=ear_model.lag_spectrum(motion, extent),
            delays=delays,
            smooth_levels=smooth_levels,
            adapted_motion=adapted_motion,
            segments=self._segment_spectra(adapted_motion, delays, None),
            spectrum=ear_model.mean_level(cochlea, cells),
        )

    def _simulate(self, sound: Tensor, channels: slice) -> tuple[ear_model.CochlearOutput, Tensor]:
        """Return the output of the cochlea, and the motion of its basilar membrane."""
        cells, extent = self._cells, self._extent
        cochlea = ear_model.simulate_cochlea(sound, cells, channels, extent, motion=True)
        assert cochlea.motion is not None
        return cochlea, cochlea.motion

    def _adapt(
        self, power: Tensor, motion: Tensor, cells: ear_model.HairCells, delays: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the smoothed levels, with equal group delays, and the adapted motion."""
        levels = ear_model.apply_adaptation(ear_model.sensation(power, cells.inner))
        motion = scale_motion_to_level(motion, power, levels, self._unit)
        delayed = self._equalise_delays(levels, delays)
        segment = self._score.envelope_segment
        return fine_structure.smooth_levels(delayed, self._extent, segment), motion

    def _equalise_delays(self, channels: Tensor, delays: Tensor) -> Tensor:
        ends, longest = self._extent.ends, self._extent.longest
        return ear_model.shift(channels, delays, ends, ends, longest)

    def _segment_spectra(
        self, motion: Tensor, delays: Tensor, noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Add noise to the motion, equalise the group delays, and compute ``segment_spectra``."""
        extent = self._extent
        motion = motion[..., : extent.longest]
        if noise is not None:
            motion = motion + self._unit * 10.0 ** (THRESHOLD_NOISE_DB / 20.0) * noise
        return fine_structure.segment_spectra(self._equalise_delays(motion, delays), extent)

    def compare(
        self, processed: Tensor, noise: Noise, seeds: Sequence[int], *ears: ear_model.HairCells
    ) -> Tensor:
        """Compute the nonlinear and the linear part of each item."""
        sound, chunks = self._align(processed), self._channel_chunks()
        sources = _noise_sources(noise, seeds[self._batch.items], self._extent, sound)
        noises = {channels.start: [source(channels) for source in sources] for channels in chunks}
        comparisons = self._map_channels(
            lambda clean: self._compare_channels(clean, sound, *noises[clean.channels.start]), sound
        )
        joined = Comparison(*(torch.cat(parts, 1) for parts in zip(*comparisons, strict=True)))
        return self._score.compute_parts(joined, self._extent)

    def _compare_channels(
        self,
        clean: _Channels,
        sound: Tensor,
        clean_noise: Tensor | None,
        processed_noise: Tensor | None,
    ) -> Comparison:
        channels, extent = clean.channels, self._extent
        cells = self._cells[channels]
        cochlea, motion = self._simulate(sound, channels)
        lags = ear_model.channel_lags(clean.envelope, cochlea.power.detach().sqrt(), extent)
        power = ear_model.shift(cochlea.power, lags, extent.ends, extent.ends, extent.padded)
        lags = ear_model.channel_lags(clean.motion, motion.detach(), extent)
        motion = ear_model.shift(motion, lags, extent.ends, extent.ends, extent.padded)
        smooth_levels, motion = self._adapt(power, motion, cells, clean.delays)
        segments = self._segment_spectra(motion, clean.delays, processed_noise)
        clean_segments = clean.segments
        if clean_noise is not None:
            clean_segments = self._segment_spectra(clean.adapted_motion, clean.delays, clean_noise)
        counts = fine_structure.segments_of(extent)
        return Comparison(
            clean_levels=clean.smooth_levels,
            processed_levels=smooth_levels,
            coherence=fine_structure.coherence(clean_segments, segments, counts),
            energy=clean_segments[1],
            clean_spectrum=clean.spectrum,
            processed_spectrum=ear_model.mean_level(cochlea, cells),
        )


def scale_motion_to_level(motion: Tensor, power: Tensor, levels: Tensor, unit: float) -> Tensor:
    """Give the motion of the basilar membrane the adapted level as its envelope.

    Envelope and motion are aligned separately. Where the shift of the envelope leaves nothing,
    pyclarity keeps the motion in the unit of the signals, and so does this function.

    Args:
        motion: Motion of the basilar membrane.
        power: Power of its envelope, in multiples of that at 0 dB SPL.
        levels: Adapted levels in dB over threshold.
        unit: Amplitude of 20 uPa in the signals.

    Shape: (items, channels, padded) three times -> (items, channels, padded).

    >>> motion, power, levels = torch.tensor([4.0]), torch.tensor([100.0]), torch.tensor([20.0])
    >>> scale_motion_to_level(motion, power, levels, unit=0.25)
    tensor([8.])
    """
    scaled = motion * levels * power.clamp_min(1.0).rsqrt()  # below 0 dB SPL the level is 0
    return torch.where(power > 0.0, scaled, unit * motion)


# -- noise -----------------------------------------------------------------------------------------


def _noise_sources(
    noise: Noise, seeds: Sequence[int], extent: Extent, like: Tensor
) -> tuple[NoiseSource, NoiseSource]:
    """Return the sources of noise for the clean and for the processed signals."""
    if noise == "seeded":
        return _drawn_noise(seeds, extent, like, 0), _drawn_noise(seeds, extent, like, 1)
    if noise == "expected":
        # Only audible parts of the clean signal count, and the noise is far below them.
        return _no_noise, partial(_frozen_noise, extent=extent, like=like)
    return _no_noise, _no_noise


def _no_noise(channels: slice) -> None:
    return None


def _drawn_noise(seeds: Sequence[int], extent: Extent, like: Tensor, skipped: int) -> NoiseSource:
    """Draw the noise of pyclarity, after skipping the deviates of a number of signals."""
    generators = [
        legacy_rng_after_normals(seed, skipped * CHANNELS * end)
        for seed, end in zip(seeds, extent.ends, strict=True)
    ]

    def draw(channels: slice) -> Tensor:
        count = channels.stop - channels.start
        noise = torch.zeros(len(extent.ends), count, extent.longest, dtype=like.dtype)
        for row, generator, end in zip(noise, generators, extent.ends, strict=True):
            row[:, :end] = torch.from_numpy(generator.standard_normal((count, end)))
        return noise.to(like.device, non_blocking=like.device.type != "cpu")

    return draw


def _frozen_noise(channels: slice, *, extent: Extent, like: Tensor) -> Tensor:
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
    return frequency_sampling_fir(len(grid), grid, 10.0 ** (decibels / 20.0), hamming(len(grid)))


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
