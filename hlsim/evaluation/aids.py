"""Aids that others are compared with: none, an equaliser, another one at the same level, an enhancer first."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.signal import firwin2
from torch import Tensor, nn

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.fir import filter_without_delay
from hlsim.dsp.resample import resample
from hlsim.evaluation.measurements import insertion_gain
from hlsim.losses.band_levels import band_centres
from hlsim.neuro.config import NEURO_RATE
from hlsim.plugins import WaveformPlugin

_TAPS = 513  # of an equaliser: 31 Hz at 16 kHz
_LOWEST_GAIN_DB = -100.0
_SPEECH = Path(__file__).parents[1] / "data" / "speech" / "valid" / "flite-rms-01.flac"

_GAINS: dict[tuple[str, Audiogram], list[float]] = {}
"""Gains of equalisers by their token and the ear, for this process."""


class Unaided(nn.Module):
    """No hearing aid: the output is the input."""

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Return the waveform."""
        return waveform


class AtLevelOf(nn.Module):
    """An aid whose output has the RMS level of another aid's output for the same input."""

    def __init__(self, aid: nn.Module, other: nn.Module) -> None:
        super().__init__()
        self.aid, self.other = aid, other

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Process the waveform with both aids, and return the first output at the second's level."""
        return set_level(self.aid(waveform, audiogram), level_spl(self.other(waveform, audiogram)))


class EqualiserLike(nn.Module):
    """A fixed filter for each ear with an aid's mean insertion gain: what is left of the aid without the rest.

    Args:
        aid: the aid.
        utterances: speech that its gain is measured on, (utterances, time) at 16 kHz.
        levels: levels of the speech in dB SPL; the gain in dB is their mean.
    """

    utterances: Tensor

    def __init__(self, aid: nn.Module, utterances: Tensor, levels: Sequence[float]) -> None:
        super().__init__()
        self.aid, self.levels = aid, tuple(levels)
        self.register_buffer("utterances", utterances, persistent=False)
        self._token = uuid.uuid4().hex  # the same in every process that this object is sent to

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Filter the waveform. The gains of an ear are measured once in a process."""
        place = self._token, audiogram
        if place not in _GAINS:
            _GAINS[place] = self.gains_db(audiogram)
        return equalise_bands(waveform, _GAINS[place])

    def gains_db(self, audiogram: Audiogram) -> list[float]:
        """Return the gain in dB of each band, rounded to 0.1 dB."""
        gains = insertion_gain(self.aid, audiogram, self.utterances, self.levels)
        mean = np.mean(gains, 0).clip(_LOWEST_GAIN_DB, None)
        return [round(gain, 1) for gain in mean.tolist()]


def equalise_bands(waveform: Tensor, gains_db: Sequence[float]) -> Tensor:
    """Filter with gains in dB at ``band_centres``, with linear phase and without delay."""
    hertz = np.linspace(0.0, NEURO_RATE / 2.0, _TAPS)
    gains = np.interp(np.log(hertz.clip(1.0)), np.log(band_centres()), gains_db)
    taps = firwin2(_TAPS, hertz, 10.0 ** (gains / 20.0), fs=NEURO_RATE)
    return filter_without_delay(waveform, torch.from_numpy(taps).to(waveform))


class Enhanced(nn.Module):
    """An aid behind an enhancer that reduces noise."""

    def __init__(self, enhancer: WaveformPlugin, aid: nn.Module) -> None:
        super().__init__()
        self.enhancer, self.aid = enhancer, aid
        self.limit_spl = limit_of(aid)

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Enhance the waveform, and process what comes out."""
        aided: Tensor = self.aid(self.enhancer(waveform, NEURO_RATE), audiogram)
        return aided


def load_enhancer(name: str) -> WaveformPlugin:
    """Load an enhancer ``(waveform, sample_rate) -> waveform`` of (..., time) in pascals.

    Raises:
        ValueError: As ``WaveformPlugin``, or its output for speech is no waveform, or not aligned.
    """
    enhancer = WaveformPlugin(name, "enhancer")
    waveform, rate = read_audio(_SPEECH)
    speech = set_level(resample(waveform[0], rate, NEURO_RATE)[: 2 * NEURO_RATE], 65.0)
    enhancer.check_aligned(speech, NEURO_RATE, NEURO_RATE)
    return enhancer


def load_enhancers(names: Sequence[str]) -> dict[str, WaveformPlugin]:
    """Load enhancers by the part of their names after the colon; ValueError for the same part twice."""
    enhancers = {name.rpartition(":")[2]: load_enhancer(name) for name in names}
    if len(enhancers) < len(names):
        raise ValueError(
            f"enhancers {', '.join(names)}: two have the same name after the colon; rename one"
        )
    return enhancers


def limit_of(aid: Any) -> float | None:
    """Return the peak in dB SPL that an aid promises not to pass; None if it promises none."""
    limit: float | None = getattr(getattr(aid, "config", aid), "limit_spl", None)
    return limit
