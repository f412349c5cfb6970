"""The page of the demo: how training changes an aid, in numbers, sounds and pictures."""

from hlsim.evaluation.conditions import NAL_R, NAL_R_AT_LEVEL, TRAINED
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.sounds import NORMAL_EAR
from hlsim.metrics.words import predict_words
from hlsim.report.page import Card, Page, Picture, Section, Table
from hlsim.report.players import make_player
from hlsim.report.plots import (
    INK,
    Curve,
    condition_colours,
    curves_picture,
    gain_picture,
)
from hlsim.report.tables import (
    Columns,
    mean_level,
    score_details,
    split_rows,
    statistic,
    summary_table,
)
from hlsim.report.verdict import count_items, verdict

_COMPARISON = (
    "HASPI rewards any gain. The trained aid is therefore compared with NAL-R, the prescription "
    "that clinics know, amplified to the same output level. This comparison was planned before "
    "the scores were known. The {utterances} utterances are those of {voices} voices. Utterances "
    "of one voice are not independent, so that the test compares the means of the voices, and "
    "{voices} voices are few: other voices may give other results."
)
_LISTEN = (
    "One utterance of a voice that the aid was not trained on. Its words: My father fixed the "
    "broken zip with a pair of pliers."
)
_ABOUT_PICTURES = (
    "The aid started from the gains of NAL-R, and was trained for this ear through Neuro-MSBG for "
    "{steps} steps, so that the ear perceives speech as loud as a normal ear does, in "
    "each frequency band. No sample of its output exceeds {limit:g} dB SPL. NAL-R follows "
    "from the audiogram alone, and has one gain for all levels and no limit. Less gain for louder "
    "speech is compression."
)


def demo_page(evaluation: Evaluation) -> Page:
    """Return the page of ``hlsim demo``: verdict, sounds, pictures, scores, details and cards.

    The cards are HASPI, the share of words understood and the loudness error.

    Args:
        evaluation: Evaluation of ``evaluate_trained_aid``.
    """
    settings, (sounds,) = evaluation.settings, evaluation.sounds
    headline = evaluation.headline
    assert headline is not None
    about_pictures = _ABOUT_PICTURES.format(
        steps=settings["training_steps"], limit=settings["limit_spl"]
    )
    voices = evaluation.table["voice"].nunique()
    comparison = _COMPARISON.format(utterances=len(evaluation.items), voices=voices)
    sections = [
        Section("Listen", [_LISTEN], player=make_player(sounds.groups, sounds.sample_rate)),
        Section("What training changed", [about_pictures], pictures=_draw_pictures(evaluation)),
        Section("Scores", [_loudness(evaluation), comparison], [result_table(evaluation)]),
        score_details(evaluation),
    ]
    title = f"A hearing aid trained for one ear: {settings['ear']}"
    subject = f"By the means of {count_items(voices, 'voice')}, the trained aid"
    first_sentence = verdict(headline, subject, "NAL-R at the same level", "voice")
    return Page(title, first_sentence, sections, _cards(evaluation))


def _loudness(evaluation: Evaluation) -> str:
    """Return a sentence about the loudness errors of the aid and of NAL-R at the same level."""
    errors = evaluation.table.groupby("condition")["loudness_error"].mean()
    return (
        f"The loudness error of the trained aid is {_decibels(errors[TRAINED])}, that of NAL-R at "
        f"the same level {_decibels(errors[NAL_R_AT_LEVEL])}."
    )


def result_table(evaluation: Evaluation) -> Table:
    """Return the table of ``hlsim demo``, with one row per condition.

    The columns are the mean HASPI, the share of words that is predicted from HASPI to be
    understood, the mean output level in dB SPL, and the mean loudness error in dB.

    Args:
        evaluation: Evaluation of ``evaluate_trained_aid``.
    """
    columns: Columns = {
        "HASPI": (statistic("haspi"), ".3f"),
        "Words understood": (lambda rows: predict_words(rows["haspi"]), ".0%"),
        "Output level (dB SPL)": (mean_level("haspi"), ".1f"),
        "Loudness error (dB)": (statistic("loudness_error"), "+.1f"),
    }
    count = len(evaluation.items)
    return summary_table(f"Means of {count} utterances", evaluation.table, columns)


def _cards(evaluation: Evaluation) -> list[Card]:
    """Return the three cards of the page: HASPI, words understood and loudness error."""
    columns = ["haspi", "loudness_error", "level"]
    means = evaluation.table.groupby("condition", sort=False)[columns].mean()
    haspi, errors = means["haspi"], means["loudness_error"]
    change = means.loc[NAL_R_AT_LEVEL] - means.loc[NAL_R]
    rows = split_rows(evaluation.table)
    words = {name: predict_words(part["haspi"]) for name, part in rows.items()}
    fewest_words, most_words = (predict_words([score] * len(evaluation.items)) for score in (0, 1))
    return [
        Card(
            "HASPI",
            f"{haspi[TRAINED]:.3f}",
            "Predicted intelligibility, from 0 to 1. It rewards any gain, so compare the last two, "
            "which have the same output level.",
            [(name, f"{value:.3f}", value) for name, value in haspi.items()],
        ),
        Card(
            "Words understood",
            f"{words[TRAINED]:.0%}",
            "Predicted from HASPI for listeners with a hearing loss: "
            f"{fewest_words:.0%} at a HASPI of 0, {most_words:.0%} at 1.",
            [(name, f"{value:.0%}", value) for name, value in words.items()],
        ),
        Card(
            "Loudness error",
            _decibels(errors[TRAINED]),
            "Perceived level minus that of a normal ear; a picture below shows each frequency "
            f"band. NAL-R gets {_decibels(change['level'])} to reach the same level, perceived as "
            f"{_decibels(change['loudness_error'])}. In an ear with recruitment, loudness grows "
            "faster than the level.",
            [(name, _decibels(e), abs(e) / errors.abs().max()) for name, e in errors.items()],
        ),
    ]


def _decibels(value: float) -> str:
    """Format a level difference with its sign, as a typeset minus."""
    return f"{value:+.1f} dB".replace("-", "\N{MINUS SIGN}")


def _draw_pictures(evaluation: Evaluation) -> list[Picture]:
    """Return three pictures: perceived levels, speech beside the ear's thresholds, and gains."""
    details = evaluation.details
    ear = evaluation.sounds[0].ear
    colours = condition_colours(evaluation.conditions)
    frequencies = details["gain_curves"][0]["frequencies"]
    styles = {name: {"color": colour} for name, colour in colours.items()}
    styles[NORMAL_EAR] = {"color": INK, "linestyle": "--"}
    perceived_curves = {
        name: (frequencies, details["perceived_levels"][name], style)
        for name, style in styles.items()
    }
    curves: dict[str, Curve] = {
        f"speech, {name}": (frequencies, levels, {"color": colours[name]})
        for name, levels in details["speech_levels_hl"].items()
    }
    style = {"color": INK, "marker": "o"}
    curves["threshold of this ear"] = (ear.frequencies, ear.levels, style)
    return [
        curves_picture(
            perceived_curves,
            "Speech as this ear perceives it",
            "level (dB SPL per band)",
            axis_range=(0.0, None),
            note="The closer to the dashed line, the better.",
        ),
        curves_picture(
            curves,
            "The ear, and the speech that reaches it",
            "level (dB HL)",
            axis_range=(120.0, -10.0),
            note=f"Speech at {evaluation.table['clean_level'].iloc[0]:g} dB SPL, mean level in "
            "each band. Where it lies above the line of the threshold, it is inaudible on average.",
        ),
        gain_picture("Gain by input level", details["gain_curves"], colours),
    ]
