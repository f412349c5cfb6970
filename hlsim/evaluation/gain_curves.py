"""Insertion gain of a compensator against frequency, at several input levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import set_level
from hlsim.criteria.bands import band_centres, band_levels
from hlsim.data.clips import Clips
from hlsim.evaluation.steadiness import outputs
from hlsim.neuro.config import NEURO_RATE

UTTERANCES = 6
"""Clips of speech that the curves are of."""

_SECONDS = 3.0


def insertion_gain(
    compensator: nn.Module, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> list[list[float]]:
    """Power out over power in, in dB, in 24 ERB-wide bands (``hlsim.criteria.bands``), over all of the speech.

    Its spectrum is what a fitter's speech-shaped noise stands for; its pauses are in it, for a compensator may take noise
    for noise. ``levels`` are of each utterance in dB SPL. ValueError as ``outputs``.

    Shape: (utterances, time) at 16 kHz -> (levels, 24).
    """
    curves = []
    for level in levels:
        given = set_level(speech, level)
        aided = outputs(compensator, given, ear, f"the output for speech at {level:g} dB SPL")
        curves.append((10.0 * (_powers(aided) / _powers(given)).log10()).tolist())
    return curves


def draw_utterances(speech: str | Path, seed: int) -> Tensor:
    """Six clips of 3 s from a folder, drawn from the seed. Shape: -> (6, 48000) at 16 kHz."""
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=_SECONDS)
    return clips.draw(UTTERANCES, torch.Generator().manual_seed(seed))


def gain_curves(
    compensators: Mapping[str, nn.Module],
    ears: Mapping[str, Audiogram],
    utterances: Tensor,
    levels: Sequence[float],
) -> list[dict[str, Any]]:
    """The curves of every compensator for every ear. Shape: (utterances, time) at 16 kHz. ValueError as ``outputs``.

    Returns: for each ``{"compensator", "ear", "levels", "frequencies", "gain_db": (levels, 24)}``.
    """
    curves = []
    for (ear_name, ear), (name, compensator) in product(ears.items(), compensators.items()):
        try:
            gains = insertion_gain(compensator, ear, utterances, levels)
        except ValueError as error:
            raise ValueError(f"{name}, ear {ear_name}: {error}") from error
        about = {"compensator": name, "ear": ear_name, "levels": [*levels]}
        curves.append({**about, "frequencies": band_centres().tolist(), "gain_db": gains})
    return curves


def _powers(signal: Tensor) -> Tensor:
    """Mean power of each band. Shape: (utterances, time) -> (24,)."""
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))
