"""The page of ``haspi-report``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.result import Evaluation
from hlsim.metrics.words import words_change
from hlsim.report.listening import listening_section
from hlsim.report.page import Page, Section, Table, write_page
from hlsim.report.plots import study_pictures
from hlsim.report.results import (
    GAIN_NOTE,
    STATISTICS_NOTES,
    comparison_sections,
    conditions_table,
    failure_section,
    headline_table,
    items_table,
    mean_verdict,
    scored_by,
    severity_counts,
    versions_text,
)


def write_report(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write the evaluation as ``report.html``, ``report.md`` and ``report.json`` into a folder.

    Args:
        listen: number of items with players and spectrograms.

    Returns: the path of ``report.html``.

    Raises:
        ValueError: the files cannot be written.
        MissingExtraError: matplotlib or jinja2 is not installed.
    """
    return write_page(report_page(evaluation, listen), evaluation.to_dict(), out)


def report_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page of recorded speech: verdict, scores, sounds, pictures, details."""
    columns = evaluation.settings["measures"]
    headline = evaluation.headline
    if headline is None:
        verdict = mean_verdict(evaluation, columns[0])
        result = Section("Scores", [*_gain_note(columns)], [conditions_table(evaluation, columns)])
    else:
        verdict = headline.verdict()
        result = Section(
            "Scores",
            [headline.limits(), *_gain_note(columns), *_words(evaluation, headline)],
            _score_tables(evaluation, headline, columns),
        )
    pictures = study_pictures(evaluation)
    sections = [
        result,
        listening_section(evaluation, listen),
        Section("Pictures", pictures=pictures) if pictures else None,
        detail_section(evaluation),
    ]
    title = f"{', '.join(evaluation.names)}: {headline_title(evaluation)}"
    return Page(title, verdict, [section for section in sections if section is not None])


def headline_title(evaluation: Evaluation) -> str:
    """Return the titles of the measures."""
    return ", ".join(measure.title or measure.name for measure in evaluation.measures)


def detail_section(evaluation: Evaluation) -> Section:
    """Return all comparisons, failures, notes and scores of items, folded."""
    columns = evaluation.settings["measures"]
    failures = failure_section(evaluation.failures)
    sections = [
        *comparison_sections(evaluation),
        *([failures] if failures is not None else []),
        Section("How the scores were made", _notes(evaluation)),
        Section("All items", tables=[items_table(evaluation, columns)], folded=True),
    ]
    return Section("Details", sections=sections, folded=True)


def _score_tables(evaluation: Evaluation, headline: Comparison, columns: list[str]) -> list[Table]:
    tables = [headline_table(headline)]
    if len(evaluation.conditions) > 2 or len(columns) > 1:
        tables.insert(0, conditions_table(evaluation, columns))
    return tables


def _gain_note(columns: list[str]) -> list[str]:
    return [GAIN_NOTE] if "haspi" in columns else []


def _words(evaluation: Evaluation, c: Comparison) -> list[str]:
    """Say how many words a listener would understand, if the headline is HASPI's."""
    if c.measure != "haspi":
        return []
    both = evaluation.wide("haspi")[[c.before, c.after]].dropna().to_numpy().clip(0.0, 1.0)
    words = words_change(*np.ascontiguousarray(both.T))
    shares = [f"{100.0 * share:.0f} %" for share in (words.before, words.after)]
    change, low, high = [f"{100.0 * x:+.0f}" for x in (words.change, words.low, words.high)]
    return [
        f"In words: a listener would understand {shares[0]} of the words of these sentences under "
        f"{c.before} and {shares[1]} under {c.after}, a change of {change} points. For nine of ten "
        f"listeners the change lies between {low} and {high} points.",
        "Words are predicted from HASPI by a curve that was fitted to 22 listeners with ten hearing aids "
        "(hlsim.metrics.words). HASPI ranks aids well, but says little about single listeners.",
    ]


def _notes(evaluation: Evaluation) -> list[str]:
    """Say how the scores were made."""
    items = evaluation.table.drop_duplicates("item")
    named = items["listener"] if "listener" in items else items["name"].iloc[:0]
    listeners = named[named != ""].nunique()
    better_ear = "Each score is that of the better ear."
    notes = [
        scored_by(evaluation),
        severity_counts(evaluation),
        f"Listeners: {listeners}." if listeners else "",
        _about_level(evaluation),
        better_ear if evaluation.settings.get("better_ear") else "",
        *STATISTICS_NOTES,
        f"The seed is {evaluation.settings['seed']}. {versions_text(evaluation.versions)}",
    ]
    return [note for note in notes if note]


def _about_level(evaluation: Evaluation) -> str:
    if "full_scale_spl" in evaluation.settings:
        return f"RMS 1.0 stands for {evaluation.settings['full_scale_spl']:g} dB SPL."
    scales = evaluation.table["full_scale_spl"].dropna().round(1)
    scale = f"{scales.min():.1f} dB SPL"
    if scales.max() > scales.min():
        scale = f"{scales.min():.1f} to {scales.max():.1f} dB SPL, depending on the item"
    clean = f"{evaluation.table['clean_level'].mean():.1f} dB SPL"
    return f"The clean speech has {clean} on average; RMS 1.0 stands for {scale}."
