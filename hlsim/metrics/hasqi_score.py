"""HASQI version 2 in torch: pyclarity 0.9.0's score, differentiable, on a CPU or a GPU, many times as fast.

Kates and Arehart 2014, "The hearing-aid speech quality index (HASQI) version 2", J. Audio Eng. Soc. 62(3), 99-117. Both
signals are heard by the impaired ear, the clean one with NAL-R: what is scored is distortion, noise and colour, not
whether enough is heard. Of what HASPI's page says of rates, lengths, levels and alignment the same holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike
from hlsim.calibration import PASCAL_SPL, check_full_scale
from hlsim.checks import Lengths, check_choice, check_waveform
from hlsim.dsp.fft import fft_length
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import hamming
from hlsim.metrics.ear import fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.ear.clean_speech import CleanItem, CleanSpeech, ItemGroup
from hlsim.metrics.ear.model import AUDIOMETRIC_HZ, CHANNELS, Extent
from hlsim.metrics.ear.recursions import RATE
from hlsim.metrics.haspi_score import Noise, generator_after, item_seeds
from hlsim.torchtools import constant, not_compiled

_NALR_ORDER = 140
_NALR_BIAS = np.array([-17.0, -8.0, 1.0, -1.0, -2.0, -2.0])

_THRESHOLD_NOISE = -10.0  # dB over threshold, of the noise on the motion

_FROZEN = 2**17  # samples of noise that all channels take theirs from
_APART = 4001


_Source = Callable[[int, int], Tensor]
"""Noise of the next so many channels, each so many samples long."""


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
        thresholds = self._signals.thresholds(audiogram)
        unit = 10.0 ** (-check_full_scale(full_scale_spl) / 20.0)
        with torch.autocast(clean.device.type, enabled=False):
            self._groups = [
                _Group(self._signals, items, thresholds, unit) for items in self._signals.groups()
            ]
            if keep:
                for group in self._groups:
                    group.keep()

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
            scores = [
                score for group in self._groups for score in group.compare(given, noise, seeds)
            ]
            nonlinear, linear = torch.stack(scores).reshape(*self._signals.shape, 2).unbind(-1)
            return HasqiParts(nonlinear * linear, nonlinear, linear)


# -- items that are worked on together ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Channels:
    """Some channels of the clean speech.

    Attributes:
        chosen: the channels.
        envelope, motion: spectra for the lags of the processed ones.
        delays: that match the filters' group delays. Shape: (items, channels).
        smoothed: levels of each item. Shape: (channels, segments).
        moving: the adapted motion. Shape: (items, channels, padded).
        segments: of that, of each item.
        level: long-term, in dB over threshold. Shape: (items, channels).
    """

    chosen: slice
    envelope: Tensor
    motion: Tensor
    delays: Tensor
    smoothed: list[Tensor]
    moving: Tensor
    segments: list[tuple[Tensor, Tensor]]
    level: Tensor


class _Group(ItemGroup[_Channels]):
    """Items that are worked on together, each with what the ear makes of the clean speech."""

    def __init__(
        self, signals: CleanSpeech, items: list[CleanItem], thresholds: Tensor, unit: float
    ) -> None:
        super().__init__(signals, items)
        self._unit, self._noise = unit, unit * 10.0 ** (_THRESHOLD_NOISE / 20.0)
        chosen = thresholds[[item.index for item in items]]
        with torch.no_grad():
            self._ear = ear_model.hair_cells(chosen)
            taps = [_nalr(ear) for ear in chosen.double().cpu().numpy()]
            amplified = [_amplified(item.heard, fir) for item, fir in zip(items, taps, strict=True)]
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

    def _smoothed(self, levels: Tensor, delays: Tensor) -> list[Tensor]:
        ends = self._extent.ends
        late = ear_model.shift(levels, delays, ends, ends, self._extent.longest)
        return [fine_structure.smoothed(late[i, :, :end]) for i, end in enumerate(ends)]

    def _segments(
        self, moving: Tensor, delays: Tensor, sources: Sequence[_Source] | None = None
    ) -> list[tuple[Tensor, Tensor]]:
        """``segment_spectra`` of each item, delayed to match, with noise at the threshold of hearing."""
        made = []
        for i, end in enumerate(self._extent.ends):
            item = moving[i : i + 1, :, :end]
            if sources is not None:
                item = item + self._noise * sources[i](item.shape[1], end).to(item)
            late = ear_model.shift(item, delays[i : i + 1], (end,), (end,), end)
            made.append(fine_structure.segment_spectra(late[0]))
        return made

    def compare(self, processed: Tensor, noise: Noise, seeds: list[int]) -> list[Tensor]:
        """Nonlinear and linear part of each item. Shape: (items, time) of the whole batch -> (2,) each."""
        extent, signals = self._extent, self._signals
        places = [item.index for item in self._items]
        given = [signals.matched(processed[item.index], item) for item in self._items]
        sound = signals.through_middle_ear(given, extent)
        first, second = _sources(noise, [seeds[place] for place in places], extent)
        found: list[list[tuple[Tensor, ...]]] = [[] for _ in places]
        for part in self._channels():
            cells = self._ear[part.chosen]
            heard = ear_model.listen(sound, self._ear, part.chosen, extent, motion=True)
            assert heard.motion is not None
            lags = ear_model.channel_lags(part.envelope, heard.power.detach().sqrt(), extent)
            power = ear_model.shift(heard.power, lags, extent.ends, extent.ends, extent.padded)
            lags = ear_model.channel_lags(part.motion, heard.motion.detach(), extent)
            motion = ear_model.shift(heard.motion, lags, extent.ends, extent.ends, extent.padded)
            levels = ear_model.adapted(ear_model.sensation(power, cells.inner))
            smoothed = self._smoothed(levels, part.delays)
            y = self._segments(_moving(motion, power, levels, self._unit), part.delays, second)
            x = part.segments if first is None else self._segments(part.moving, part.delays, first)
            level = ear_model.mean_level(heard, cells)
            for i, rows in enumerate(found):
                both = fine_structure.coherence(x[i], y[i])
                rows.append((part.smoothed[i], smoothed[i], both, x[i][1], part.level[i], level[i]))
        return [
            self._score(*(torch.cat(column) for column in zip(*rows, strict=True)))
            for rows in found
        ]

    def _score(
        self,
        clean: Tensor,
        heard: Tensor,
        coherence: Tensor,
        energy: Tensor,
        before: Tensor,
        after: Tensor,
    ) -> Tensor:
        envelopes = fine_structure.envelope_correlation(clean, heard)
        fine = fine_structure.synchrony(coherence, energy)
        return torch.stack(
            (envelopes.square() * fine, fine_structure.spectral_likeness(before, after))
        )


# -- noise -------------------------------------------------------------------------------------------------------------


def _sources(
    noise: Noise, seeds: list[int], extent: Extent
) -> tuple[list[_Source] | None, list[_Source] | None]:
    """Noise of the clean signals, where it is drawn, and of the processed ones."""
    if noise == "none":
        return None, None
    if (
        noise == "expected"
    ):  # only what is heard of the clean signal counts, and there noise is nothing
        return None, [_frozen() for _ in seeds]
    drawn = [
        [_drawn(seed, start * CHANNELS * end) for seed, end in zip(seeds, extent.ends, strict=True)]
        for start in (0, 1)
    ]
    return drawn[0], drawn[1]


def _drawn(seed: int, start: int) -> _Source:
    """As pyclarity draws it."""
    generator = generator_after(seed, start)
    return lambda channels, end: torch.from_numpy(generator.standard_normal((channels, end)))


def _frozen() -> _Source:
    """The same each time: every channel takes its part of one stretch of noise."""
    table = constant(_frozen_noise, dtype=torch.float32, device=torch.device("cpu"))
    taken = 0

    def source(channels: int, end: int) -> Tensor:
        nonlocal taken
        starts = range(taken * _APART, (taken + channels) * _APART, _APART)
        taken += channels
        return table.repeat(-(-(starts[-1] + end) // _FROZEN))[starts[0] :].unfold(0, end, _APART)[
            :channels
        ]

    return source


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


def _amplified(signal: Tensor, taps: NDArray[np.float64]) -> Tensor:
    """Filtered, from the filter's last sample on, as pyclarity takes it. Shape: (time,) -> (time,)."""
    time = signal.shape[-1]
    points = fft_length(time + _NALR_ORDER, 2)
    fir = torch.from_numpy(taps).to(signal)
    filtered = torch.fft.irfft(torch.fft.rfft(signal, points) * torch.fft.rfft(fir, points), points)
    return filtered[_NALR_ORDER : _NALR_ORDER + time]
