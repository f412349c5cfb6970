"""Comparison of two signals in one impaired ear, which HASQI and HAAQI have in common.

The ear receives the clean signal amplified by NAL-R, and the output of an aid as it is. The scores
therefore show distortion, noise and changes of the spectrum, not whether enough is audible.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.metrics.ear import alignment, fine_structure, model as ear_model
from hlsim.metrics.ear.extent import Extent
from hlsim.metrics.ear.model import CHANNELS, HairCells
from hlsim.metrics.ear.motion_noise import draw_motion_noise
from hlsim.metrics.pair import Noise
from hlsim.metrics.reference import PreparedBatch, Reference
from hlsim.torchtools import Audio, Samples, as_type_of, constant

THRESHOLD_NOISE_DB = -10.0
"""Level of the noise on the motion of the basilar membrane, in dB over threshold."""

FROZEN_SAMPLES = 2**17
"""Number of samples of the fixed noise of ``noise="expected"``. Each channel uses a part of it."""

FROZEN_STRIDE = 4001
"""Samples between the starts of the parts of two neighbouring channels."""


class QualityParts(NamedTuple):
    """HASQI or HAAQI, and its two parts. Shape of each attribute: (...).

    Attributes:
        combined: The score, 0 to 1.
        nonlinear: Similarity of envelopes and fine structure, 0 to 1. Noise and distortion reduce
            it.
        linear: Similarity of long-term spectra, 0 to 1. Changes of the long-term spectrum, such as
            another frequency response, reduce it.

    >>> QualityParts(torch.tensor(0.4), torch.tensor(0.5), torch.tensor(0.8)).nonlinear
    tensor(0.5000)
    """

    combined: Tensor
    nonlinear: Tensor
    linear: Tensor


class QualityReference(Reference):
    """Base of ``HasqiReference`` and ``HaaqiReference``: clean signals in an impaired ear.

    Subclasses combine similarities of envelopes, fine structure and spectra into the score.

    Args:
        clean: Clean signals, not amplified unless ``equalisation`` is 2. The scores are on their
            device, and float64 if they are, otherwise float32. Their gradient is not computed.
            Shape: (..., time).
        audiogram: The impaired ear, -10 to 120 dB HL: one for all items or one for each, or a
            ``Listener`` for (..., 2, time).
        sample_rate: Sample rate in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0, 0 to 200.
        lengths: Number of samples of each item in a padded batch. Shape: (...).
        whole_khz: Round the rate to whole kHz, as pyclarity does.
        equalisation: Mode of pyclarity: 1 amplifies the clean signals by NAL-R here, 2 takes
            signals that NAL-R or another prescription has amplified.
        keep: Store the clean signals' features, about 19 MB per second in float32; otherwise they
            are computed, and the level is validated, for each score.

    Raises:
        ValueError: Clean signals that last less than 0.7 s, have less than 16 ms of sound, are not
            floating-point, not finite, above 1e9, silent or below 20 dB SPL; a rate, level,
            audiogram, length or equalisation out of range.

    >>> from hlsim import example_speech
    >>> from hlsim.metrics import HasqiReference
    >>> parts = HasqiReference(example_speech()[:16000], "N3").parts(example_speech()[:16000])
    >>> bool(parts.combined == parts.nonlinear * parts.linear)
    True
    """

    envelope_segment: ClassVar[int]
    """Length of a segment over which envelopes are smoothed, in samples at 24 kHz."""

    split_by_rate: ClassVar[Any] = None
    """Function that divides the fluctuations of envelopes into bands of modulation, or None."""

    def score(self, output: Audio, *, noise: Noise = "expected", seed: int = 0) -> Audio:
        """Return the score of each output of an aid.

        Args:
            output: Outputs with the shape, rate and scale of the clean signals. Shape: (...,
                time).
            noise: Noise 10 dB below the threshold of hearing: ``"expected"``, the same every time;
                ``"seeded"``, the noise that pyclarity draws; or ``"none"``.
            seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.

        Returns:
            Scores, 0 to 1, of NumPy if ``output`` is an array. Shape: (...).

        Raises:
            ValueError: Outputs of another shape, not floating-point, not finite, above 1e9 or on
                another device; an unknown noise or a seed out of range; with ``keep=False``, a
                clean signal that is silent, too soft or too short.
        """
        return as_type_of(output, self.parts(output, noise=noise, seed=seed).combined)

    def parts(self, output: Samples, *, noise: Noise = "expected", seed: int = 0) -> QualityParts:
        """Return the score of each output of an aid with its nonlinear and its linear part.

        Args:
            output: Outputs with the shape, rate and scale of the clean signals. Shape: (...,
                time).
            noise: Noise 10 dB below the threshold of hearing: ``"expected"``, the same every time;
                ``"seeded"``, the noise that pyclarity draws; or ``"none"``.
            seed: Seed of the drawn noise of each item, 0 to 2**32 - 1.

        Returns:
            Score and parts, tensors even if ``output`` is an array. Shape of each: (...).

        Raises:
            ValueError: Outputs of another shape, not floating-point, not finite, above 1e9 or on
                another device; an unknown noise or a seed out of range; with ``keep=False``, a
                clean signal that is silent, too soft or too short.
        """
        return QualityParts(*self._compare_all(output, noise, seed).unbind(-1))

    @staticmethod
    @abstractmethod
    def _combine(envelopes: Tensor, fine: Tensor, x: Tensor, y: Tensor) -> QualityParts:
        """Compute the score of each item and its parts. Shape of each part: (items,).

        Args:
            envelopes: Correlation of the envelopes. Shape: (items,).
            fine: Similarity of the fine structures. Shape: (items,).
            x, y: Long-term spectra of clean signals and outputs: the share of each channel in the
                sum of amplitudes. Shape: (items, 32).
        """

    @property
    def _unit(self) -> float:
        """Amplitude of 20 uPa, that is 0 dB SPL, on the scale of the input."""
        return 10.0 ** (-self._full_scale_spl / 20.0)

    def _features(
        self,
        sound: Tensor,
        cells: HairCells,
        channels: slice,
        longest_delay: Tensor,
        extent: Extent,
    ) -> _Channels:
        cochlea = ear_model.simulate_cochlea(sound, cells, channels, extent, motion=True)
        delays = longest_delay - ear_model.group_delays(cochlea.bandwidth, channels)
        inner = cells[..., channels].inner
        levels, motion = self._adapt(cochlea.power, cochlea.motion, inner, delays, extent)
        segments = None
        if self._keeps_features:
            segments = self._segment_spectra(motion, delays, channels, None, extent)
        return _Channels(
            channels=channels,
            envelope=alignment.lag_spectrum(cochlea.power.sqrt(), extent),
            motion=alignment.lag_spectrum(cochlea.motion, extent),
            delays=delays,
            smooth_levels=levels,
            adapted_motion=motion,
            segments=segments,
            level=cochlea.level,
        )

    def _adapt(
        self, power: Tensor, motion: Tensor, inner: Tensor, delays: Tensor, extent: Extent
    ) -> tuple[Tensor, Tensor]:
        """Simulate the inner hair cells: smoothed levels, and motion with the level as envelope.

        Args:
            power: Power of the compressed envelopes. Shape: (items, channels, padded).
            motion: Compressed motion of the basilar membrane. Shape: (items, channels, padded).
            inner: Loss of the inner hair cells in dB. Shape: (items, channels) or (channels,).
            delays: Delays in samples that compensate for different group delays, used for the
                levels only. Shape: (items, channels).
            extent: Number of samples of each item before padding.

        Returns:
            Levels in dB over threshold, (items, channels, segments), and motion, (items, channels,
            padded).
        """
        levels = ear_model.nerve_levels(power, inner)
        motion = _scale_motion_to_level(motion, power, levels, self._unit)
        delayed = _delay(levels, delays, extent)
        return fine_structure.smooth_levels(delayed, extent, self.envelope_segment), motion

    def _compare(
        self, batch: PreparedBatch, output: Tensor, cells: HairCells, noise: Noise, seed: int
    ) -> Tensor:
        """Compute the score of each item, its nonlinear part and its linear part, (items, 3).

        Arguments are those of ``Reference._compare``.
        """
        extent = batch.clean.audible
        noises = _threshold_noise(noise, seed, extent, output)
        comparisons = [
            self._compare_channels(clean, output, cells, noises, extent) for clean in batch.features
        ]
        clean_levels, levels, coherence, energy, clean_spectrum, spectrum = (
            torch.cat(parts, 1) for parts in zip(*comparisons, strict=True)
        )
        counts = fine_structure.segments_of(extent, self.envelope_segment)
        envelopes = fine_structure.envelope_correlation(
            clean_levels, levels, counts, self.split_by_rate
        )
        fine = fine_structure.synchrony(coherence, energy, fine_structure.segments_of(extent))
        x = fine_structure.channel_shares(clean_spectrum)
        y = fine_structure.channel_shares(spectrum)
        return torch.stack(self._combine(envelopes, fine, x, y), -1)

    def _compare_channels(
        self,
        clean: _Channels,
        output: Tensor,
        cells: HairCells,
        noises: tuple[Tensor | None, Tensor | None],
        extent: Extent,
    ) -> tuple[Tensor, ...]:
        """Compute the features of outputs in some channels, beside those of the clean signals.

        Args:
            clean: Features of the clean signals in these channels.
            output: Aligned outputs behind the middle ear. Shape: (items, padded).
            cells: Hair cells of all channels.
            noises: Noise of clean signals and outputs, from ``_threshold_noise``.
            extent: Number of samples of each item before padding.

        Returns:
            - Levels of the clean signals, then of the outputs, in dB over threshold, smoothed over
              segments of 16 ms (HASQI) or 8 ms (HAAQI). Shape: (items, channels, segments).
            - Similarity of the fine structures in each segment of 16 ms, 0 to 1. Shape: (items,
              channels, segments), with fewer segments than the levels of HAAQI.
            - Mean square of the envelope of the clean signals' fine structure in these segments,
              with the ear's noise if ``noise`` is ``"seeded"``; see ``segment_spectra``.
            - Long-term levels of the clean signals, then of the outputs, in dB over threshold.
              Shape: (items, channels).
        """
        channels, inner = clean.channels, cells[..., clean.channels].inner
        cochlea = ear_model.simulate_cochlea(output, cells, channels, extent, motion=True)
        power, motion = cochlea.power, cochlea.motion
        envelope = power.detach().sqrt()
        power = alignment.align_channels(power, envelope, clean.envelope, extent)
        motion = alignment.align_channels(motion, motion.detach(), clean.motion, extent)
        levels, motion = self._adapt(power, motion, inner, clean.delays, extent)
        clean_noise, noise = noises
        segments = self._segment_spectra(motion, clean.delays, channels, noise, extent)
        clean_segments = clean.segments
        if clean_segments is None or clean_noise is not None:
            clean_segments = self._segment_spectra(
                clean.adapted_motion, clean.delays, channels, clean_noise, extent
            )
        counts = fine_structure.segments_of(extent)
        coherence = fine_structure.coherence(clean_segments, segments, counts)
        energy = clean_segments[1]
        return clean.smooth_levels, levels, coherence, energy, clean.level, cochlea.level

    def _segment_spectra(
        self,
        motion: Tensor,
        delays: Tensor,
        channels: slice,
        noise: Tensor | None,
        extent: Extent,
    ) -> tuple[Tensor, Tensor]:
        """Add noise to the motion, delay its channels, and compute ``segment_spectra``.

        Args:
            motion: Motion of the channels, (items, channels, padded).
            delays: Delays in samples, (items, channels).
            channels: Range of these channels among the 32 of the ear.
            noise: Noise of standard deviation 1 for all 32 channels, (items, 32, longest) or (32,
                longest), or None for no noise.
            extent: Number of samples of each item before padding. Samples after the longest item
                are left out.

        Returns:
            Spectra, (items, channels, segments, frequencies), and mean squares, (items, channels,
            segments).
        """
        motion = motion[..., : extent.longest]
        if noise is not None:
            amplitude = self._unit * 10.0 ** (THRESHOLD_NOISE_DB / 20.0)
            motion = motion + amplitude * noise[..., channels, :].to(motion)
        return fine_structure.segment_spectra(_delay(motion, delays, extent), extent)


@dataclass(frozen=True)
class _Channels:
    """Features of the clean signal in some channels.

    Attributes:
        channels: Range of these channels among the 32 of the ear.
        envelope, motion: Results of ``lag_spectrum`` for the clean signal's envelope and motion,
            with which those of an output are aligned. Shape: (items, channels, blocks,
            frequencies).
        delays: Delays in samples that compensate for different group delays. Shape: (items,
            channels).
        smooth_levels: Levels in dB over threshold, smoothed over segments. Shape: (items, channels,
            segments).
        adapted_motion: Motion whose envelope is the level at the auditory nerve. Shape: (items,
            channels, padded).
        segments: Spectra and mean squares of segments of that motion by ``segment_spectra``;
            None if they serve a single score, which computes them with its noise.
        level: Long-term level in dB over threshold. Shape: (items, channels).
    """

    channels: slice
    envelope: Tensor
    motion: Tensor
    delays: Tensor
    smooth_levels: Tensor
    adapted_motion: Tensor
    segments: tuple[Tensor, Tensor] | None
    level: Tensor


def _delay(signal: Tensor, delays: Tensor, extent: Extent) -> Tensor:
    """Delay channels. Shape: (items, channels, padded) -> (items, channels, longest)."""
    return alignment.shift(signal, delays, extent.ends, extent.ends, extent.longest)


def _scale_motion_to_level(motion: Tensor, power: Tensor, levels: Tensor, unit: float) -> Tensor:
    """Rescale the motion so that its envelope equals the level in dB at the auditory nerve.

    The envelope and the motion of an output are shifted separately to fit those of the clean
    signal, so the envelope may be zero where the motion is not. There, the motion is only converted
    to the scale of the input, as in pyclarity.

    Args:
        motion: Motion of the basilar membrane in multiples of 20 uPa.
        power: Power of its envelope, where 1 is 0 dB SPL.
        levels: Levels at the auditory nerve in dB over threshold.
        unit: Amplitude of 20 uPa on the scale of the input.

    Shape: (items, channels, padded) three times -> (items, channels, padded).
    """
    factor = levels * power.clamp_min(1.0).rsqrt()  # below 0 dB SPL the level is 0
    return motion * factor.masked_fill_(power <= 0.0, unit)


# -- noise -----------------------------------------------------------------------------------------


def _threshold_noise(
    noise: Noise, seed: int, extent: Extent, like: Tensor
) -> tuple[Tensor | None, Tensor | None]:
    """Draw the noise that is added to the motion of the basilar membrane, for clean and output.

    Its standard deviation is 1. ``_segment_spectra`` scales it to 10 dB below the threshold of
    hearing.

    Args:
        noise: Kind of the noise.
        seed: Seed of the noise, the same for every item.
        extent: Number of samples of each item.
        like: Tensor whose device the noise has, and for ``"seeded"`` its dtype.

    Returns:
        Noise of clean signal and output: (items, 32, longest) twice for ``"seeded"``; None and
        (32, longest) for ``"expected"``; None twice for ``"none"``.
    """
    longest = extent.longest
    if noise == "seeded":
        drawn = torch.zeros(2, len(extent.ends), CHANNELS, longest, dtype=like.dtype)
        for item, end in enumerate(extent.ends):
            drawn[:, item, :, :end] = draw_motion_noise(seed, end, like.dtype)
        clean_noise, output_noise = drawn.to(like.device)
        return clean_noise, output_noise
    if noise == "expected":
        # The same noise every time: each channel takes its part of one signal. Only audible parts
        # of the clean signal count, and the noise is far below them.
        table = _frozen_table(like=like.float())
        copies = -(-((CHANNELS - 1) * FROZEN_STRIDE + longest) // FROZEN_SAMPLES)
        return None, table.repeat(copies).unfold(0, longest, FROZEN_STRIDE)[:CHANNELS]
    return None, None


@constant
def _frozen_table() -> NDArray[np.float64]:
    """Return noise with a standard deviation of 1, (FROZEN_SAMPLES,), the same every time."""
    return np.random.RandomState(0).standard_normal(FROZEN_SAMPLES)
