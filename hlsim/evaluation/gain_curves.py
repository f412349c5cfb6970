"""Insertion gain of a compensator against frequency, at several input levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.calibration import set_level
from hlsim.criteria.bands import band_edges, band_levels
from hlsim.data.clips import Clips
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.haspi_pictures import draw_svg
from hlsim.report.page import Picture, Section, Table
from hlsim.report.pictures import plain

_SECONDS = 3.0
_UTTERANCES = 6
_SHOWN = FREQUENCIES[:-1]  # 8 kHz is beyond the bands
_TICKS = (250, 500, 1000, 2000, 4000)


def insertion_gain(
    compensator: nn.Module, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> list[list[float]]:
    """Power out over power in, in dB, in 24 ERB-wide bands (``hlsim.criteria.bands``), over all of the speech.

    Args:
        speech: its spectrum is what a fitter's speech-shaped noise stands for; its own pauses are in it, for a
            compensator may take noise for noise.
        levels: of each utterance in dB SPL.

    Shape: (utterances, time) at 16 kHz -> (levels, 24).

    Raises:
        ValueError: the compensator gives samples that are NaN or infinite.
    """
    curves = []
    with torch.no_grad():
        for level in levels:
            given = set_level(speech, level)
            aided = torch.stack([compensator(utterance, ear) for utterance in given])
            if not aided.isfinite().all():
                raise ValueError(
                    f"the output for speech at {level:g} dB SPL holds samples that are NaN or infinite"
                )
            taken, made = (_powers(signal) for signal in (given, aided))
            curves.append((10.0 * (made / taken).log10()).tolist())
    return curves


def gain_curves(
    compensators: Mapping[str, nn.Module],
    ears: Mapping[str, Audiogram],
    speech: str | Path,
    levels: Sequence[float],
    seed: int = 0,
) -> list[dict[str, Any]]:
    """The curves of every compensator for every ear, on six clips of 3 s drawn from a folder.

    Raises:
        ValueError: a compensator gives samples that are NaN or infinite.

    Returns: for each ``{"compensator", "ear", "levels", "frequencies", "gain_db": (levels, 24)}``.
    """
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=_SECONDS)
    drawn = clips.draw(_UTTERANCES, torch.Generator().manual_seed(seed))
    curves = []
    for ear_name, ear in ears.items():
        for name, compensator in compensators.items():
            try:
                gains = insertion_gain(compensator, ear, drawn, levels)
            except ValueError as error:
                raise ValueError(f"{name}, ear {ear_name}: {error}") from error
            about = {"compensator": name, "ear": ear_name, "levels": [*levels]}
            curves.append({**about, "frequencies": _centres().tolist(), "gain_db": gains})
    return curves


def gain_table(curves: Sequence[Mapping[str, Any]]) -> Table:
    """A row an ear, compensator and level; gains between the bands' centres go linearly over log frequency."""
    rows = []
    for curve in curves:
        for level, gains in zip(curve["levels"], curve["gain_db"], strict=True):
            shown = np.interp(np.log(_SHOWN), np.log(curve["frequencies"]), gains)
            rows.append(
                [f"{curve['ear']}, {curve['compensator']}, {level:g} dB SPL", *(f"{g:+.1f}" for g in shown)]
            )
    header = ["Ear, compensator, input", *(f"{hz:g} Hz" for hz in _SHOWN)]
    return Table("Insertion gain in dB", header, rows)


def gain_section(curves: Sequence[Mapping[str, Any]]) -> Section:
    """Table and a picture an ear.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    ears = dict.fromkeys(curve["ear"] for curve in curves)
    pictures = [_picture(ear, [curve for curve in curves if curve["ear"] == ear]) for ear in ears]
    text = (
        f"Power out over power in, in ERB-wide bands, of {_UTTERANCES} clips of speech. A linear prescription has one "
        "curve for all levels; less gain for louder speech is compression."
    )
    return Section("Gain curves", [text], [gain_table(curves)], pictures)


def _picture(ear: str, curves: Sequence[Mapping[str, Any]]) -> Picture:
    def draw(axes: Any) -> None:
        styles = ("-", "--", ":", "-.")
        for number, curve in enumerate(curves):
            for style, level, gains in zip(styles, curve["levels"], curve["gain_db"], strict=False):
                label = plain(f"{curve['compensator'][:18]}, {level:g}")
                axes.plot(curve["frequencies"], gains, style, color=f"C{number}", label=label)
        axes.set(xscale="log", xlabel="frequency (kHz)", ylabel="insertion gain (dB)")
        axes.set_xticks(_TICKS, [f"{hz / 1000:g}" for hz in _TICKS])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize="x-small")

    at_2k = []
    for curve in curves:
        gains = [np.interp(np.log(2000.0), np.log(curve["frequencies"]), own) for own in curve["gain_db"]]
        at_2k.append(f"{curve['compensator']} " + ", ".join(f"{gain:.0f}" for gain in gains))
    levels = ", ".join(f"{level:g}" for level in curves[0]["levels"])
    alt = f"Insertion gain for {ear} over frequency; at 2 kHz and {levels} dB SPL: {'; '.join(at_2k)} dB."
    return Picture(draw_svg(draw), alt, f"{ear}; the legend tells the input level in dB SPL.")


def _powers(signal: Tensor) -> Tensor:
    """Mean power of each band. Shape: (utterances, time) -> (24,)."""
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))


def _centres() -> NDArray[np.float64]:
    edges = band_edges()
    centres: NDArray[np.float64] = np.sqrt(edges[1:] * edges[:-1])
    return centres
