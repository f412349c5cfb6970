"""The page of the demo: how training changes an aid, in numbers, sounds and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.evaluation.aid_properties import mean_band_levels
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.result import Evaluation
from hlsim.report.page import Card, Page, Picture, Section, Table
from hlsim.report.players import NORMAL_EAR, make_player
from hlsim.report.plots import (
    INK,
    Curve,
    condition_colours,
    curves_picture,
    gain_picture,
)
from hlsim.report.results import Columns, score_details, split_rows, statistic, summary_table

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
    """Return the page of the demo: three numbers, verdict, sounds, pictures, details.

    Args:
        evaluation: Study of the demo's conditions, with the detail ``gain_curves``.
        ear_name: Name of the ear, for the title.
        outputs: Outputs of the aid for each item in pascals, by condition. Shape of each: (time,).
        perceived: The same outputs as the ear perceives them, by condition.
        sentence: Words of the last item, which is played.
    """
    headline = evaluation.headline
    assert headline is not None
    colours = condition_colours(evaluation.conditions)
    items = [source.load() for source in evaluation.items]
    rate = items[0].sample_rate
    normal = [perceive(item.clean, NORMAL, rate) for item in items]
    level = float(evaluation.table["clean_level"].iloc[0])
    gains = evaluation.details["gain_curves"]
    frequencies = gains[0]["frequencies"]
    pictures = [
        _perceived_picture({NORMAL_EAR: normal, **perceived}, colours, frequencies),
        _ear_picture(items[0].ear, level, outputs, colours, frequencies),
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
    player = make_player(groups, rate, sentence)
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
    """Return the table of the demo, with mean scores and levels of each condition."""
    columns: Columns = {
        "HASPI": (statistic("haspi"), ".3f"),
        "Words understood": (
            lambda rows: _predict_words(evaluation, rows["condition"].iloc[0]),
            ".0%",
        ),
        "Output level (dB SPL)": (statistic("level"), ".1f"),
        "Loudness error (dB)": (statistic("loudness_error"), "+.1f"),
    }
    count = len(evaluation.items)
    return summary_table(f"Means of {count} utterances", split_rows(evaluation.table), columns)


def _predict_words(evaluation: Evaluation, condition: str) -> float:
    """Return the proportion of words that a listener understands, predicted from HASPI."""
    return evaluation.words(condition, condition).before


def _cards(evaluation: Evaluation) -> list[Card]:
    """Return the cards with HASPI, words understood and loudness error of all conditions."""
    means = evaluation.table.groupby("condition", sort=False)[["haspi", "loudness_error"]].mean()
    haspi, errors = means["haspi"], means["loudness_error"]
    words = {name: _predict_words(evaluation, name) for name in means.index}
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
            [(name, _decibels(e), abs(e) / errors.abs().max()) for name, e in errors.items()],
        ),
    ]


def _decibels(value: float) -> str:
    """Format a level difference with its sign, as a typeset minus."""
    return f"{value:+.1f} dB".replace("-", "\N{MINUS SIGN}")


def _ear_picture(
    ear: Audiogram,
    level: float,
    outputs: Mapping[str, Sequence[Tensor]],
    colours: Mapping[str, Any],
    frequencies: Sequence[float],
) -> Picture:
    """Draw the audiogram, and the levels of speech without an aid and after the trained one.

    Args:
        ear: The audiogram.
        level: Level of the speech in dB SPL.
        outputs: Outputs for each item, by condition.
        colours: Colour of each condition.
        frequencies: Centres of the 24 bands in Hz.
    """
    curves: dict[str, Curve] = {}
    for name in (UNAIDED, TRAINED):
        levels = mean_band_levels(outputs[name], hearing_level=True)
        curves[f"speech, {name}"] = (frequencies, levels, {"color": colours[name]})
    style = {"color": INK, "marker": "o"}
    curves["threshold of this ear"] = (ear.frequencies, ear.levels, style)
    note = (
        f"Speech at {level:g} dB SPL, mean level in each band. Where it lies above the line of the "
        "threshold, it is inaudible on average."
    )
    title = "The ear, and the speech that reaches it"
    return curves_picture(curves, title, "level (dB HL)", axis_range=(120.0, -10.0), note=note)


def _perceived_picture(
    perceived: Mapping[str, Sequence[Tensor]],
    colours: Mapping[str, Any],
    frequencies: Sequence[float],
) -> Picture:
    """Draw the mean level that the ear perceives in each band, beside a normal ear's.

    Args:
        perceived: Perceived signals of each item, by condition.
        colours: Colour of each condition.
        frequencies: Centres of the 24 bands in Hz.
    """
    styles = {name: {"color": colours[name]} for name in _PLAYED}
    styles[NORMAL_EAR] = {"color": INK, "linestyle": "--"}
    curves = {
        name: (frequencies, mean_band_levels(perceived[name]), style)
        for name, style in styles.items()
    }
    note = "The closer to the dashed line, the better."
    title = "Speech as this ear perceives it"
    return curves_picture(
        curves, title, "level (dB SPL per band)", axis_range=(0.0, None), note=note
    )
