"""The demo's page: what training an aid brought, to be read, heard and seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Item
from hlsim.losses.band_levels import band_centres, band_levels, threshold_in_quiet
from hlsim.metrics.words import words_change
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.listening import players
from hlsim.report.page import Page, Picture, Section, Table
from hlsim.report.plots import (
    condition_colours,
    curves_picture,
    draw_svg,
    gain_picture,
    legend,
    pictures_section,
)
from hlsim.report.recordings import score_details
from hlsim.report.results import Columns, of, parts, summary_table

if TYPE_CHECKING:
    from pandas import DataFrame

UNAIDED, NAL_R, NAL_R_AT_LEVEL = "unaided", "NAL-R", "NAL-R at the trained aid's level"
START, TRAINED = "untrained start", "trained"
"""Names of the demo's conditions."""

_NORMAL_EAR = "a normal ear"
_SHOWN = (UNAIDED, NAL_R, TRAINED)

_RESULT = (
    "HASPI predicts from 0 to 1 how much of the speech is understood, and words are predicted from it by a curve "
    "fitted to listeners' responses. HASPI rewards any gain. The trained aid is therefore compared with NAL-R, the "
    "prescription that clinics know, at the same output level. The loudness error is the level that this ear "
    "perceives minus the level that a normal ear perceives without an aid: at 0 dB speech is as loud as normally, "
    "above it is too loud."
)
_LISTEN = (
    "The utterance {name}, which was not trained on: what this ear perceives of it, by MSBG, and what a normal "
    "ear perceives, which is the goal. All players have the same gain, so that what is soft for the ear is soft "
    "here. Begin with a low volume. All utterances are in the folder audio beside this page."
)
_EAR = (
    "Speech at {level:g} dB SPL in this audiogram: its mean levels in bands 1.25 ERB wide and, shaded, the 30th to 99th "
    "percentile of frames of 32 ms, in dB above a normal ear's threshold (Terhardt 1979). What lies above the line "
    "of the thresholds, towards the top, is inaudible."
)
_GAIN = "A prescription such as NAL-R has one curve for all levels; less gain for louder speech is compression."


def demo_page(
    evaluation: Evaluation, ear_name: str, perceived: Mapping[str, Sequence[Tensor]]
) -> Page:
    """Return the page: verdict, result, sounds, the ear and the speech, gain, details.

    Args:
        evaluation: study of the demo's conditions, with the detail ``gain_curves``.
        ear_name: name of the ear, for the title.
        perceived: perceived signals of each item, by condition.
    """
    headline = evaluation.headline
    assert headline is not None
    colours = condition_colours(evaluation.conditions)
    items = [source.load() for source in evaluation.items]
    normal = [perceive(item.clean, NORMAL, NEURO_RATE) for item in items]
    signals = {"clean speech": items[0].clean, _NORMAL_EAR: normal[0]}
    signals |= {f"{name}, perceived": perceived[name][0] for name in _SHOWN}
    level = float(evaluation.table["clean_level"].iloc[0])
    about = _LISTEN.format(name=items[0].name)
    curves = evaluation.details["gain_curves"]
    drawn = [
        _ear_picture(evaluation, items, colours),
        _perceived_picture({_NORMAL_EAR: normal, **perceived}, colours),
    ]
    sections = [
        Section("Result", [_RESULT], [result_table(evaluation)]),
        Section("Listen", [about], players=players(signals, NEURO_RATE)),
        Section("The ear and the speech", [_EAR.format(level=level)], pictures=drawn),
        Section("Gain", [_GAIN], pictures=[gain_picture(ear_name, curves, colours)]),
        pictures_section(evaluation),
        score_details(evaluation),
    ]
    verdict = headline.verdict("The trained aid", "NAL-R at the same level")
    title = f"A hearing aid trained for one ear: {ear_name}"
    return Page(title, verdict, [section for section in sections if section is not None])


def result_table(evaluation: Evaluation) -> Table:
    """Return means of the utterances, one row per condition."""
    unaided = evaluation.wide("haspi")[UNAIDED].to_numpy().clip(0.0, 1.0)

    def words(rows: DataFrame) -> float:
        share = words_change(unaided, rows["haspi"].to_numpy().clip(0.0, 1.0))
        return share.before if rows["condition"].iloc[0] == UNAIDED else share.after

    columns: Columns = {
        "HASPI": (of("haspi"), ".3f"),
        "Words understood": (words, ".0%"),
        "Output level (dB SPL)": (of("level"), ".1f"),
        "Loudness error (dB)": (of("loudness_error"), "+.1f"),
    }
    return summary_table(f"Means of {len(unaided)} utterances", parts(evaluation.table), columns)


def _ear_picture(
    evaluation: Evaluation, items: Sequence[Item], colours: Mapping[str, Any]
) -> Picture:
    """Draw the audiogram with the speech as it is and as the trained aid amplifies it."""
    ear = items[0].ear
    levels = {}
    for condition in evaluation.conditions:
        if condition.name in (UNAIDED, TRAINED):
            with torch.no_grad():
                bands = [band_levels(condition.output(item), NEURO_RATE) for item in items]
            levels[condition.name] = torch.cat(bands).numpy()

    def draw(axes: Any) -> None:
        ear.plot(axes, label="threshold", zorder=3, color="black")
        for name, values in levels.items():
            quiet = threshold_in_quiet()
            low, high = np.percentile(values, (30, 99), axis=0) - quiet
            mean = 10.0 * np.log10((10.0 ** (values / 10.0)).mean(0)) - quiet
            style = {"color": colours[name], "alpha": 0.25, "linewidth": 0}
            axes.fill_between(band_centres(), low, high, **style)
            axes.plot(band_centres(), mean, color=colours[name], label=f"speech, {name}")
        legend(axes)

    text = "Audiogram, and speech as it is and as the trained aid amplifies it."
    return Picture(draw_svg(draw, height=4.0), text, text)


def _perceived_picture(
    perceived: Mapping[str, Sequence[Tensor]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the mean level that the ear perceives in each band, beside a normal ear's."""
    curves = {}
    for name in (_NORMAL_EAR, *_SHOWN):
        bands = torch.cat([band_levels(signal, NEURO_RATE) for signal in perceived[name]])
        level = 10.0 * (10.0 ** (bands / 10.0)).mean(0).log10()
        style = {"color": colours.get(name, "black"), "linestyle": "-" if name in colours else "--"}
        curves[name] = (list(band_centres()), level.tolist(), style)
    text = "Speech as perceived, by band; the closer to the dashed line the better."
    return curves_picture(curves, text, "perceived level (dB SPL in a band)", lowest=0.0)
