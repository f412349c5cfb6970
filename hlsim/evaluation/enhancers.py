"""Enhancers of your own, which remove noise before an aid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hlsim.audio import read_audio
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.neuro.config import NEURO_RATE
from hlsim.plugins import WaveformPlugin

_SPEECH = Path(__file__).parents[1] / "data" / "speech" / "valid" / "flite-rms-01.flac"


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
