"""The page of ``haspi-report``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.measures import title_of
from hlsim.evaluation.result import Evaluation
from hlsim.metrics.words import words_change
from hlsim.report.page import Page, Section, Table, write_page
from hlsim.report.plots import pictures_sections
from hlsim.report.results import (
    GAIN_NOTE,
    LEVEL,
    STATISTICS_NOTE,
    comparison_sections,
    comparison_table,
    detail_section,
    items_table,
    mean_verdict,
    score_cells,
    scored_by,
    severity_counts,
    split_rows,
    summary_table,
)
from hlsim.report.sounds import listening_sections


def write_report(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write the evaluation as ``report.html``, ``report.md`` and ``report.json`` into a folder.

    Args:
        evaluation: Result of ``haspi_report``.
        out: Folder of the files.
        listen: Number of items with players and spectrograms.

    Returns: The path of ``report.html``.

    Raises:
        ValueError: The files cannot be written.
        MissingExtraError: matplotlib or jinja2 is not installed.
    """
    return write_page(report_page(evaluation, listen), evaluation.to_dict(), out)


def report_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page of recorded speech: verdict, scores, sounds, pictures, details."""
    columns = {**score_cells(evaluation), **LEVEL}
    tables = [summary_table("Means of all items", split_rows(evaluation.table), columns)]
    texts = [GAIN_NOTE] if "haspi" in evaluation.scores else []
    headline = evaluation.headline
    verdict = mean_verdict(evaluation)
    if headline is not None:
        verdict = headline.verdict()
        tables.append(comparison_table([headline], "The comparison of the first sentence"))
        texts = [headline.limits(), *texts, *_words(evaluation, headline)]
    sections = [
        Section("Scores", texts, tables),
        *listening_sections(evaluation, listen),
        *pictures_sections(evaluation),
        score_details(evaluation),
    ]
    measures = ", ".join(map(title_of, evaluation.scores))
    return Page(f"{', '.join(evaluation.names)}: {measures}", verdict, sections)


def score_details(
    evaluation: Evaluation, texts: Sequence[str] = (), tables: Sequence[Table] = ()
) -> Section:
    """Return all comparisons, scores of items and of ears, failures and notes, folded.

    Args:
        evaluation: The study.
        texts: Paragraphs to begin with.
        tables: Tables to begin with.
    """
    item_tables = [items_table(evaluation, "Scores and levels of every item")]
    better_ear = ""
    if "ears" in evaluation.groups:
        caption = "Scores and levels of each ear"
        item_tables.append(items_table(evaluation.groups["ears"], caption))
        better_ear = "Each score is that of the better ear, by each measure."
    sections = [*comparison_sections(evaluation), Section("All items", tables=item_tables)]
    clean, scale = (evaluation.table[name].dropna() for name in ("clean_level", "full_scale_spl"))
    levels = (
        f"The clean speech has {clean.mean():.1f} dB SPL on average; RMS 1.0 stands for "
        f"{scale.min():.1f} to {scale.max():.1f} dB SPL."
    )
    notes = [
        scored_by(evaluation),
        severity_counts(evaluation),
        levels,
        better_ear,
        STATISTICS_NOTE,
    ]
    return detail_section(evaluation, sections, notes, texts=texts, tables=tables)


def _words(evaluation: Evaluation, c: Comparison) -> list[str]:
    """Return sentences about the words understood, if the headline is that of HASPI."""
    if c.measure != "haspi":
        return []
    both = evaluation.wide("haspi")[[c.before, c.after]].dropna().clip(0.0, 1.0)
    words = words_change(both[c.before].to_numpy(), both[c.after].to_numpy())
    before, after, change, low, high = (100.0 * share for share in words)
    return [
        f"In words: a listener would understand {before:.0f} % of the words of these sentences "
        f"under {c.before} and {after:.0f} % under {c.after}, a change of {change:+.0f} points. "
        f"For nine of ten listeners the change lies between {low:+.0f} and {high:+.0f} points.",
        "Words are predicted from HASPI by a curve that was fitted to 22 listeners with ten "
        "hearing aids (hlsim.metrics.words). HASPI ranks aids well, but says little about single "
        "listeners.",
    ]
