"""HASQI version 2 in torch: pyclarity 0.9.0's score, differentiable, on a CPU or a GPU, many times as fast.

Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio Eng. Soc. 62(3), 99-117. Both
signals are heard by the impaired ear, the clean one with NAL-R: what is scored is distortion, noise and colour, not
whether enough is heard. Of what HASPI's page says of rates, lengths, levels and alignment the same holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import Lengths, check_choice, check_waveform
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanBatch, CleanSpeech, ItemGroup
from hlsim.metrics.ear.model import AUDIOMETRIC_HZ, CHANNELS, Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.haspi_score import Noise, generator_after, item_seeds
from hlsim.metrics.pair import cut_to_common_length
from hlsim.torchtools import constant, not_compiled

_NALR_ORDER = 140
_NALR_BIAS = np.array([-17.0, -8.0, 1.0, -1.0, -2.0, -2.0])

_THRESHOLD_NOISE = -10.0  # dB over threshold, of the noise on the motion

_FROZEN = 2**17  # samples of noise that all channels take theirs from
_APART = 4001


_Source = Callable[[slice, Extent], Tensor]
"""Returns noise of some channels, (items or 1, channels, longest). Channels come in ascending order."""


class HasqiParts(NamedTuple):
    """HASQI and what it is the product of. Shape of all: (...,).

    Attributes:
        combined: the score, 0 to 1.
        nonlinear: envelopes and fine structure: noise and distortion.
        linear: long-term spectra: colour.
    """

    combined: Tensor
    nonlinear: Tensor
    linear: Tensor


@not_compiled  # traced, it takes minutes
def hasqi(
    processed: Tensor,
    clean: Tensor,
    audiogram: AudiogramLike,
    *,
    sample_rate: int = 16000,
    full_scale_spl: float = PASCAL_SPL,
    lengths: Lengths | None = None,
    noise: Noise = "expected",
    seed: int | Sequence[int] = 0,
    whole_khz: bool = False,
) -> Tensor:
    """HASQI v2 of each item: how good the processed speech sounds to this ear beside the clean with NAL-R, 0 to 1.

    Args:
        processed, clean, audiogram, sample_rate, full_scale_spl, lengths, seed, whole_khz: as ``haspi``.
        noise: at the threshold of hearing; it counts where nothing is heard of the processed speech. "expected" takes the
            same noise each time, "seeded" draws what pyclarity draws under ``seed``, "none" leaves it out.

    Shape: (..., time) twice and one audiogram or (..., 8) dB HL -> (...,).

    Raises:
        ValueError: as ``haspi``.
    """
    check_waveform(processed, "processed")
    processed, clean, lengths = cut_to_common_length(processed, clean, sample_rate, lengths)
    reference = HasqiReference(
        clean.to(torch.promote_types(clean.dtype, processed.dtype))
        if isinstance(clean, Tensor)
        else clean,
        audiogram,
        sample_rate=sample_rate,
        full_scale_spl=full_scale_spl,
        lengths=lengths,
        whole_khz=whole_khz,
        keep=False,
    )
    return reference.score(processed, noise=noise, seed=seed)


class HasqiReference:
    """Clean speech as an impaired ear hears it with NAL-R, prepared to score many processed signals against.

    It holds about 18 MB a second of speech in float32.

    Args:
        clean, audiogram, sample_rate, full_scale_spl, lengths, whole_khz: as ``hasqi``; dtype and device are those of
            ``clean``, whose gradient is not followed.
        keep: what the ear makes of it; without, it is computed with each score, in less memory.

    Raises:
        ValueError: as ``haspi``.
    """

    @torch.inference_mode(False)  # it may be scored against where gradients are wanted
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
        self._signals = CleanSpeech(clean, sample_rate, full_scale_spl, lengths, whole_khz, "HASQI")
        signals = self._signals
        ears = signals.thresholds(audiogram)
        host_ears = signals.thresholds(audiogram, host=True).detach().double().numpy()
        unit = 10.0 ** (-check_full_scale(full_scale_spl) / 20.0)
        with torch.autocast(clean.device.type, enabled=False):
            self._parts = [
                _Batch(signals, batch, ears[batch.items], host_ears[batch.items], unit, keep)
                for batch in signals.batches
            ]

    def score(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> Tensor:
        """``hasqi`` of processed signals of the clean ones' shape, rate and scale. Returns (...,)."""
        return self.parts(processed, noise=noise, seed=seed).combined

    def parts(
        self, processed: Tensor, *, noise: Noise = "expected", seed: int | Sequence[int] = 0
    ) -> HasqiParts:
        """As ``score``, with what it is the product of."""
        check_choice("noise", noise, Noise)
        given = self._signals.check(processed)
        seeds = item_seeds(seed, self._signals.shape)
        with torch.autocast(processed.device.type, enabled=False):
            scores = torch.cat([part.compare(given, noise, seeds) for part in self._parts])
            nonlinear, linear = scores.reshape(*self._signals.shape, 2).unbind(-1)
            return HasqiParts(nonlinear * linear, nonlinear, linear)


# -- items that are processed together ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Channels:
    """Some channels of the clean speech.

    Attributes:
        chosen: the channels.
        envelope, motion: spectra for the lags of the processed ones.
        delays: that match the filters' group delays. Shape: (items, channels).
        smoothed: smoothed levels. Shape: (items, channels, segments).
        moving: the adapted motion. Shape: (items, channels, padded).
        segments: ``segment_spectra`` of that.
        level: long-term, in dB over threshold. Shape: (items, channels).
    """

    chosen: slice
    envelope: Tensor
    motion: Tensor
    delays: Tensor
    smoothed: Tensor
    moving: Tensor
    segments: tuple[Tensor, Tensor]
    level: Tensor


class _Comparison(NamedTuple):
    """What a score is computed from, over all channels.

    Attributes:
        clean, processed: smoothed levels. Shape: (items, 32, segments).
        coherence: coherence of the motion of both. Shape: (items, 32, segments).
        energy: mean squares of the segments of the clean signal. Shape: (items, 32, segments).
        clean_level, processed_level: long-term levels in dB over threshold. Shape: (items, 32).
    """

    clean: Tensor
    processed: Tensor
    coherence: Tensor
    energy: Tensor
    clean_level: Tensor
    processed_level: Tensor


class _Batch:
    """Clean signals of a batch, each as an impaired ear hears it.

    Args:
        ears, host_ears: ears of the items, on the device of the signals and on the CPU. Shape: (items, 8) dB HL.
        unit: amplitude that 20 uPa have in the signals.
        keep: compute now what the ears make of the signals, and keep it.
    """

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        ears: Tensor,
        host_ears: NDArray[np.float64],
        unit: float,
        keep: bool,
    ) -> None:
        self._signals, self._batch = signals, batch
        with torch.no_grad():
            amplified = _amplified(batch.signals, host_ears, batch.audible)
            cells = ear_model.hair_cells(ears)
        self._groups = [
            _Group(signals, batch, items, amplified[items], cells.items(items), unit)
            for items in signals.groups(batch)
        ]
        if keep:
            for group in self._groups:
                group.keep()

    def compare(self, processed: Tensor, noise: Noise, seeds: list[int]) -> Tensor:
        """Compute the nonlinear and the linear part of each item.

        Shape: (items, time) of the whole input -> (items of the batch, 2).
        """
        given = self._signals.matched(processed, self._batch)
        own_seeds = seeds[self._batch.items]
        found = [group.compare(given, noise, own_seeds) for group in self._groups]
        counts = fine_structure.segments_of(self._batch.audible)
        joined = _Comparison(*(_joined(parts, counts) for parts in zip(*found, strict=True)))
        envelopes = fine_structure.envelope_correlation(joined.clean, joined.processed, counts)
        fine = fine_structure.synchrony(joined.coherence, joined.energy, counts)
        likeness = fine_structure.spectral_likeness(joined.clean_level, joined.processed_level)
        return torch.stack((envelopes.square() * fine, likeness), -1)


def _joined(parts: Sequence[Tensor], counts: Extent) -> Tensor:
    """Join tensors of several groups of items; segments that a group lacks are zero."""
    if len(parts) == 1 or parts[0].ndim == 2:
        return torch.cat(list(parts))
    longest = counts.longest
    return torch.cat([functional.pad(part, (0, longest - part.shape[-1])) for part in parts])


class _Group(ItemGroup[_Channels]):
    """Items whose ears are computed together, each with what the ear makes of the clean speech."""

    def __init__(
        self,
        signals: CleanSpeech,
        batch: CleanBatch,
        items: slice,
        amplified: Tensor,
        cells: ear_model.HairCells,
        unit: float,
    ) -> None:
        super().__init__(signals, batch, items)
        self._unit, self._noise = unit, unit * 10.0 ** (_THRESHOLD_NOISE / 20.0)
        self._counts = fine_structure.segments_of(self._extent)
        self._ear = cells
        with torch.no_grad():
            self._heard = signals.through_middle_ear(amplified, self._extent)
            self._latest = ear_model.longest_group_delay(self._heard, self._ear, self._extent)

    @torch.no_grad()
    def _hear(self, chosen: slice) -> _Channels:
        extent, cells = self._extent, self._ear[chosen]
        heard = ear_model.listen(self._heard, self._ear, chosen, extent, motion=True)
        assert heard.motion is not None
        delays = self._latest - ear_model.group_delays(heard.bandwidth, chosen)
        levels = ear_model.adapted(ear_model.sensation(heard.power, cells.inner))
        moving = _moving(heard.motion, heard.power, levels, self._unit)
        return _Channels(
            chosen,
            ear_model.lag_spectrum(heard.power.sqrt(), extent),
            ear_model.lag_spectrum(heard.motion, extent),
            delays,
            self._smoothed(levels, delays),
            moving,
            self._segments(moving, delays),
            ear_model.mean_level(heard, cells),
        )

    def _smoothed(self, levels: Tensor, delays: Tensor) -> Tensor:
        extent = self._extent
        late = ear_model.shift(levels, delays, extent.ends, extent.ends, extent.longest)
        return fine_structure.smoothed(late, extent)

    def _segments(
        self, moving: Tensor, delays: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """``segment_spectra`` of the motion, delayed to match, with noise at the threshold of hearing."""
        extent = self._extent
        motion = moving[..., : extent.longest]
        if noise is not None:
            motion = motion + self._noise * noise
        late = ear_model.shift(motion, delays, extent.ends, extent.ends, extent.longest)
        return fine_structure.segment_spectra(late, extent)

    def compare(self, processed: Tensor, noise: Noise, seeds: list[int]) -> _Comparison:
        """Compare all channels. Shape: (items, padded) of the batch."""
        extent, signals = self._extent, self._signals
        sound = signals.through_middle_ear(processed[self.items], extent)
        clean_noise, processed_noise = _sources(noise, seeds[self.items], extent, sound)
        found: list[_Comparison] = []
        for part in self._channels():
            cells = self._ear[part.chosen]
            heard = ear_model.listen(sound, self._ear, part.chosen, extent, motion=True)
            assert heard.motion is not None
            lags = ear_model.channel_lags(part.envelope, heard.power.detach().sqrt(), extent)
            power = ear_model.shift(heard.power, lags, extent.ends, extent.ends, extent.padded)
            lags = ear_model.channel_lags(part.motion, heard.motion.detach(), extent)
            motion = ear_model.shift(heard.motion, lags, extent.ends, extent.ends, extent.padded)
            levels = ear_model.adapted(ear_model.sensation(power, cells.inner))
            moving = _moving(motion, power, levels, self._unit)
            smoothed = self._smoothed(levels, part.delays)
            drawn = None if processed_noise is None else processed_noise(part.chosen, extent)
            y = self._segments(moving, part.delays, drawn)
            x = part.segments
            if clean_noise is not None:
                x = self._segments(part.moving, part.delays, clean_noise(part.chosen, extent))
            coherence = fine_structure.coherence(x, y, self._counts)
            level = ear_model.mean_level(heard, cells)
            found.append(_Comparison(part.smoothed, smoothed, coherence, x[1], part.level, level))
        return _Comparison(*(torch.cat(parts, 1) for parts in zip(*found, strict=True)))


# -- noise -------------------------------------------------------------------------------------------------------------


def _sources(
    noise: Noise, seeds: list[int], extent: Extent, like: Tensor
) -> tuple[_Source | None, _Source | None]:
    """Return sources of noise for the clean signals, where it is drawn, and for the processed ones."""
    if noise == "none":
        return None, None
    if noise == "expected":
        # only what is heard of the clean signal counts, and there noise is nothing
        return None, partial(_frozen, like=like)
    return _drawn(seeds, extent, like, 0), _drawn(seeds, extent, like, 1)


def _drawn(seeds: list[int], extent: Extent, like: Tensor, start: int) -> _Source:
    """Draw noise as pyclarity does, after ``start`` times as many deviates as a signal takes."""
    generators = [
        generator_after(seed, start * CHANNELS * end)
        for seed, end in zip(seeds, extent.ends, strict=True)
    ]

    def source(channels: slice, extent: Extent) -> Tensor:
        count = channels.stop - channels.start
        noise = torch.zeros(len(extent.ends), count, extent.longest, dtype=like.dtype)
        for row, generator, end in zip(noise, generators, extent.ends, strict=True):
            row[:, :end] = torch.from_numpy(generator.standard_normal((count, end)))
        return noise.to(like.device, non_blocking=like.device.type != "cpu")

    return source


def _frozen(channels: slice, extent: Extent, *, like: Tensor) -> Tensor:
    """Return the same noise each time: every channel takes its part of one stretch of noise."""
    table = constant(_frozen_noise, dtype=torch.float32, device=like.device)
    first, last = channels.start * _APART, (channels.stop - 1) * _APART
    repeated = table.repeat(-(-(last + extent.longest) // _FROZEN))[first:]
    count = channels.stop - channels.start
    return repeated.unfold(0, extent.longest, _APART)[:count].to(like)


def _frozen_noise() -> NDArray[np.float64]:
    return np.random.RandomState(0).standard_normal(_FROZEN)


def _moving(motion: Tensor, power: Tensor, levels: Tensor, unit: float) -> Tensor:
    """The motion with the adapted level as its envelope, in dB over threshold. Shape: (items, channels, padded) each.

    Envelope and motion are aligned each by itself. Where the shift of the envelope leaves nothing at all, pyclarity keeps
    the motion as it is, in the signals' ``unit``.
    """
    scaled = motion * levels * power.clamp_min(1.0).rsqrt()  # under 0 dB SPL the level is 0
    return torch.where(power > 0.0, scaled, unit * motion)


# -- NAL-R -------------------------------------------------------------------------------------------------------------


def _nalr(thresholds: NDArray[np.float64]) -> NDArray[np.float64]:
    """NAL-R's filter at 24 kHz (Byrne and Dillon 1986), linear in dB between the audiometric frequencies.

    Shape: (8,) dB HL -> (141,).
    """
    loss = thresholds[[FREQUENCIES.index(hz) for hz in AUDIOMETRIC_HZ]]
    if loss.max() <= 0.0:
        return np.eye(_NALR_ORDER + 1)[_NALR_ORDER // 2]
    three = float(loss[1:4].sum())  # at 500, 1000 and 2000 Hz
    common = 0.05 * three if three <= 180.0 else 9.0 + 0.116 * (three - 180.0)
    gains = np.maximum(common + 0.31 * loss + _NALR_BIAS, 0.0)
    grid = np.arange(_NALR_ORDER + 1) / _NALR_ORDER
    decibels = np.interp(grid * RATE / 2, AUDIOMETRIC_HZ, gains)
    return frequency_sampling_fir(len(grid), grid, 10.0 ** (decibels / 20.0), hamming(len(grid)))


def _amplified(signals: Tensor, ears: NDArray[np.float64], extent: Extent) -> Tensor:
    """Amplify by NAL-R, from the filter's last sample on, as pyclarity does.

    Shape: (items, padded), (items, 8) dB HL -> (items, padded).
    """
    points = fft_length(extent.longest + _NALR_ORDER, 2)
    taps = torch.from_numpy(np.stack([_nalr(ear) for ear in ears]))
    fir = taps.to(signals.device, signals.dtype, non_blocking=signals.device.type != "cpu")
    spectrum = torch.fft.rfft(signals[:, : extent.longest], points) * torch.fft.rfft(fir, points)
    filtered = torch.fft.irfft(spectrum, points)[:, _NALR_ORDER : _NALR_ORDER + extent.longest]
    return functional.pad(filtered, (0, extent.padded - extent.longest))
