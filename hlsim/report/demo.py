"""The demo's page: the effect of training an aid, to be read, heard and seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.result import Evaluation
from hlsim.losses.band_levels import band_centres, band_levels, threshold_in_quiet
from hlsim.metrics.words import words_change
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.page import Card, Page, Picture, Section, Table
from hlsim.report.plots import (
    INK,
    Curve,
    condition_colours,
    curves_picture,
    gain_picture,
)
from hlsim.report.recordings import score_details
from hlsim.report.results import Columns, split_rows, statistic, summary_table
from hlsim.report.sounds import NORMAL_EAR, make_player

if TYPE_CHECKING:
    from pandas import DataFrame

UNAIDED, NAL_R, NAL_R_AT_LEVEL, TRAINED = "unaided", "NAL-R", "NAL-R, same level", "trained aid"
"""Names of the demo's conditions."""

_PLAYED = (UNAIDED, NAL_R, TRAINED)

_COMPARISON = (
    "HASPI rewards any gain. The trained aid is therefore compared with NAL-R, the prescription "
    "that clinics know, amplified to the same output level. This comparison was planned before "
    "the scores were known and is the only test on this page."
)
_LISTEN = (
    "One utterance of a voice that the aid was not trained on. The sounds of all utterances are "
    "in the folder audio beside this page."
)
_PICTURES = (
    "The training adjusts the gain so that this ear perceives speech as loud as a normal ear "
    "does, in each frequency band. NAL-R has one gain for all levels. Less gain for louder "
    "speech is compression."
)


def demo_page(
    evaluation: Evaluation,
    ear_name: str,
    outputs: Mapping[str, Sequence[Tensor]],
    perceived: Mapping[str, Sequence[Tensor]],
    sentence: str = "",
) -> Page:
    """Return the page: three numbers, verdict, sounds, pictures, details.

    Args:
        evaluation: Study of the demo's conditions, with the detail ``gain_curves``.
        ear_name: Name of the ear, for the title.
        outputs: Outputs of the aid for each item, by condition.
        perceived: Perceived signals of each item, by condition.
        sentence: Words of the last item, which is played.
    """
    headline = evaluation.headline
    assert headline is not None
    colours = condition_colours(evaluation.conditions)
    items = [source.load() for source in evaluation.items]
    normal = [perceive(item.clean, NORMAL, NEURO_RATE) for item in items]
    level = float(evaluation.table["clean_level"].iloc[0])
    gains = evaluation.details["gain_curves"]
    pictures = [
        _perceived_picture({NORMAL_EAR: normal, **perceived}, colours),
        _ear_picture(items[0].ear, level, outputs, colours),
        gain_picture("Gain by input level", gains, colours),
    ]
    groups = {
        "As this ear perceives it": {
            NORMAL_EAR: normal[-1],
            **{name: perceived[name][-1] for name in _PLAYED},
        },
        "What comes out of the aid": {
            "original speech": items[-1].clean,
            **{name: outputs[name][-1] for name in (NAL_R, TRAINED)},
        },
    }
    player = make_player(groups, NEURO_RATE, sentence)
    details = score_details(evaluation, [_COMPARISON], [result_table(evaluation)])
    sections = [
        Section("Listen", [_LISTEN], player=player),
        Section("What training changed", [_PICTURES], pictures=pictures),
        details,
    ]
    verdict = headline.verdict("The trained aid", "NAL-R at the same level")
    return Page(
        f"A hearing aid trained for one ear: {ear_name}", verdict, sections, _cards(evaluation)
    )


def result_table(evaluation: Evaluation) -> Table:
    """Return means of the utterances, one row per condition."""
    columns: Columns = {
        "HASPI": (statistic("haspi"), ".3f"),
        "Words understood": (_predict_words, ".0%"),
        "Output level (dB SPL)": (statistic("level"), ".1f"),
        "Loudness error (dB)": (statistic("loudness_error"), "+.1f"),
    }
    count = len(evaluation.items)
    return summary_table(f"Means of {count} utterances", split_rows(evaluation.table), columns)


def _predict_words(rows: DataFrame) -> float:
    """Return the proportion of words that a listener understands, predicted from HASPI."""
    scores = rows["haspi"].dropna().to_numpy().clip(0.0, 1.0)
    return words_change(scores, scores).before


def _cards(evaluation: Evaluation) -> list[Card]:
    """Return HASPI, words and loudness error of all conditions."""
    rows = split_rows(evaluation.table)
    errors = {name: float(part["loudness_error"].mean()) for name, part in rows.items()}
    largest_error = max(map(abs, errors.values()))
    haspi = {name: float(part["haspi"].mean()) for name, part in rows.items()}
    words = {name: _predict_words(part) for name, part in rows.items()}
    return [
        Card(
            "HASPI",
            f"{haspi[TRAINED]:.3f}",
            "Predicted intelligibility, from 0 to 1. It rewards any gain, however loud.",
            [(name, f"{value:.3f}", value) for name, value in haspi.items()],
        ),
        Card(
            "Words understood",
            f"{words[TRAINED]:.0%}",
            "Predicted from HASPI, for listeners with a hearing loss.",
            [(name, f"{value:.0%}", value) for name, value in words.items()],
        ),
        Card(
            "Loudness error",
            _decibels(errors[TRAINED]),
            "Perceived level minus that of a normal ear. At 0 dB, speech is as loud as normal.",
            [(name, _decibels(e), abs(e) / largest_error) for name, e in errors.items()],
        ),
    ]


def _decibels(value: float) -> str:
    return f"{value:+.1f} dB".replace("-", "\N{MINUS SIGN}")


def _ear_picture(
    ear: Audiogram,
    level: float,
    outputs: Mapping[str, Sequence[Tensor]],
    colours: Mapping[str, Any],
) -> Picture:
    """Draw the audiogram with the speech as it is and as the trained aid amplifies it."""
    curves: dict[str, Curve] = {}
    for name in (UNAIDED, TRAINED):
        levels = _mean_levels(outputs[name]) - threshold_in_quiet()
        curves[f"speech, {name}"] = (band_centres(), levels, {"color": colours[name]})
    style = {"color": INK, "marker": "o"}
    curves["threshold of this ear"] = (ear.frequencies, ear.levels, style)
    note = (
        f"Speech at {level:g} dB SPL, mean level in each band. Where it lies above the line of the "
        "threshold, it is inaudible on average."
    )
    title = "The ear, and the speech that reaches it"
    return curves_picture(curves, title, "level (dB HL)", ends=(120.0, -10.0), note=note)


def _perceived_picture(
    perceived: Mapping[str, Sequence[Tensor]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the mean level that the ear perceives in each band, beside a normal ear's."""
    styles = {name: {"color": colours[name]} for name in _PLAYED}
    styles[NORMAL_EAR] = {"color": INK, "linestyle": "--"}
    curves = {
        name: (band_centres(), _mean_levels(perceived[name]), style)
        for name, style in styles.items()
    }
    note = "The closer to the dashed line, the better."
    title = "Speech as this ear perceives it"
    return curves_picture(curves, title, "level (dB SPL per band)", ends=(0.0, None), note=note)


def _mean_levels(signals: Sequence[Tensor]) -> np.ndarray:
    """Return the mean level of all frames in dB SPL. Shape: (bands,)."""
    frames = torch.cat([band_levels(signal, NEURO_RATE) for signal in signals])
    powers: np.ndarray = (10.0 ** (frames / 10.0)).mean(0).numpy()
    return 10.0 * np.log10(powers)
