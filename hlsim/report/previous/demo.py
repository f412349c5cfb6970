"""The demo's page: what training brought, to be read, seen and heard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.audiogram.plot import frequency_axis
from hlsim.evaluation.previous.comparison import EQUAL_DB
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.losses.band_levels import band_centres, band_levels, threshold_in_quiet
from hlsim.neuro.config import NEURO_RATE
from hlsim.report import spectrograms
from hlsim.report.page import Picture, Section
from hlsim.report.plots import gain_picture
from hlsim.report.previous.haspi import Front
from hlsim.report.previous.listening import players
from hlsim.report.previous.pictures import condition_colours, draw_svg, legend
from hlsim.report.previous.tables import Table, verdict

UNAIDED, PRESCRIBED, AS_LOUD, TRAINED = "unaided", "NAL-R", "NAL-R as loud as trained", "trained"
"""Conditions that the page tells of; there may be others between the first and the last."""

NORMAL_EAR = "a normal ear"

_SHOWN = (UNAIDED, PRESCRIBED, TRAINED)

_RESULT = (
    "HASPI predicts from 0 to 1 how much of the speech is understood. It rewards any gain, so the aid is held against "
    "NAL-R, the prescription that clinics know, made as loud as what the aid gives. The level heard is that of the exact "
    "MSBG's output, less a normal ear's: at 0 dB the speech is as loud as normally, above it is too loud."
)
_LISTEN = (
    "The utterance {name}, which was not trained on, as this ear hears it by MSBG. All players have one gain, so that "
    "what is softer in the ear is softer here: set the volume by the original. The other utterances are in the folder "
    "audio beside this page."
)
_EAR = (
    "Speech at {level:g} dB SPL in this audiogram: its levels in bands 1.25 ERB wide, the mean, and shaded from the 30th "
    "to the 99th percentile of frames of 32 ms, in dB above a normal ear's threshold (Terhardt 1979). What lies above "
    "the line of the thresholds, towards the top, is not heard."
)
_GAIN = "A prescription such as NAL-R has one curve for all levels; less gain for louder speech is compression."


@dataclass(frozen=True)
class Sounds:
    """The scored utterances, in pascals at 16 kHz: as spoken, and by condition, as given and as heard, also by
    ``NORMAL_EAR``. Shape: (time,) each.
    """

    names: Sequence[str]
    clean: Sequence[Tensor]
    given: Mapping[str, Sequence[Tensor]]
    heard: Mapping[str, Sequence[Tensor]]


def result_table(report: HaspiReport, heard_off: Mapping[str, float]) -> Table:
    """A row a condition; ``heard_off`` is its level heard less a normal ear's, in dB."""
    haspi, level = report.scores("haspi").mean(0), report.levels().mean(0)
    rows = [
        (name, f"{haspi[i]:.3f}", f"{level[i]:.1f}", f"{heard_off[name]:+.1f}")
        for i, name in enumerate(report.conditions)
    ]
    header = (
        "What the ear is given",
        "HASPI",
        "Level given (dB SPL)",
        "Level heard, against normal (dB)",
    )
    return Table(f"Means of {len(report.items)} utterances", header, rows)


def demo_verdict(report: HaspiReport) -> str:
    """One sentence: the trained aid against NAL-R, at one level."""
    haspi, level = (
        dict(zip(report.conditions, of.mean(0), strict=True))
        for of in (report.scores("haspi"), report.levels())
    )
    aid, unaided = "The trained aid", f"the unaided ear has {haspi[UNAIDED]:.3f}."
    louder = level[TRAINED] - level[PRESCRIBED]
    if abs(louder) < EQUAL_DB:
        return f"{verdict(report.items, PRESCRIBED, TRAINED, aid, PRESCRIBED)}; {unaided}"
    told = verdict(report.items, AS_LOUD, TRAINED, aid, "NAL-R made as loud")
    off = f"{abs(louder):.1f} dB {'softer' if louder > 0 else 'louder'}"
    return f"{told}; NAL-R as prescribed, {off}, has {haspi[PRESCRIBED]:.3f}, and {unaided}"


def demo_front(
    report: HaspiReport, table: Table, sounds: Sounds, curves: Sequence[Mapping[str, Any]]
) -> tuple[Front, bytes]:
    """The page's beginning, and the PNG of all its spectrograms."""
    ear, level = report.items[0].audiogram, report.items[0].clean_level
    colours = condition_colours(report.conditions)
    both = (("given", sounds.given), ("heard", sounds.heard))
    shown = {f"{name}, {what}": signals[name][0] for name in _SHOWN for what, signals in both}
    panels = spectrograms.panels(shown, NEURO_RATE)
    heard = {
        f"heard, {name}": sounds.heard[name][0] for name in (UNAIDED, PRESCRIBED, AS_LOUD, TRAINED)
    }
    sections = [
        Section("Result", [_RESULT], [table]),
        Section(
            "The ear and the speech",
            [_EAR.format(level=level)],
            pictures=[_ear_picture(ear, sounds, colours), _heard_picture(sounds, colours)],
        ),
        Section("What is given, and what is heard of it", pictures=spectrograms.pictures(panels)),
        Section(
            "Listen",
            [_LISTEN.format(name=sounds.names[0])],
            players=players({"original": sounds.clean[0], **heard}, NEURO_RATE),
        ),
        Section("Gain", [_GAIN], pictures=[gain_picture(curves[0]["ear"], curves, colours)]),
    ]
    title = f"A hearing aid trained for one ear: {curves[0]['ear']}"
    return Front(title, demo_verdict(report), sections), spectrograms.composite(panels)


def _ear_picture(ear: Audiogram, sounds: Sounds, colours: Mapping[str, Any]) -> Picture:
    def draw(axes: Any) -> None:
        axes.figure.set_figheight(4.0)
        ear.plot(axes, label="threshold", zorder=3, color="black")
        for name in (UNAIDED, TRAINED):
            levels = torch.cat(
                [band_levels(signal, NEURO_RATE) for signal in sounds.given[name]]
            ).numpy()
            low, high = np.percentile(levels, (30, 99), axis=0) - threshold_in_quiet()
            mean = 10.0 * np.log10((10.0 ** (levels / 10.0)).mean(0)) - threshold_in_quiet()
            axes.fill_between(
                band_centres(), low, high, color=colours[name], alpha=0.25, linewidth=0
            )
            axes.plot(band_centres(), mean, color=colours[name], label=f"speech, {name}")
        legend(axes)

    thresholds = ", ".join(f"{level:g}" for level in ear.levels)
    alt = f"Audiogram of the ear, {thresholds} dB HL, with the speech as it is and as the trained aid gives it."
    return Picture(
        draw_svg(draw), alt, "Audiogram and speech. The bands are MSBG's degrees of loss."
    )


def _heard_picture(sounds: Sounds, colours: Mapping[str, Any]) -> Picture:
    levels = {}
    for name in (NORMAL_EAR, *_SHOWN):
        powers = [10.0 ** (band_levels(signal, NEURO_RATE) / 10.0) for signal in sounds.heard[name]]
        levels[name] = 10.0 * torch.cat(powers).mean(0).log10().numpy()

    def draw(axes: Any) -> None:
        for name, level in levels.items():
            style = "--" if name == NORMAL_EAR else "-"
            axes.plot(band_centres(), level, style, color=colours.get(name, "black"), label=name)
        axes.set(ylabel="level heard (dB SPL in a band)", ylim=(0.0, None))
        frequency_axis(axes, (250, 500, 1000, 2000, 4000))
        legend(axes)

    off = {name: np.abs(levels[name] - levels[NORMAL_EAR]).mean() for name in _SHOWN}
    told = ", ".join(f"{name} {value:.1f}" for name, value in off.items())
    alt = f"Level heard by band; mean absolute distance from a normal ear's in dB: {told}."
    return Picture(
        draw_svg(draw),
        alt,
        "Speech as heard, by band; the nearer to the dashed line the better. Under 0 dB SPL nothing is drawn.",
    )
