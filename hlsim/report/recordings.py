"""The page of ``haspi-report``, which presents what ``hlsim.evaluation.recordings`` computes."""

from __future__ import annotations

from pathlib import Path

from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation
from hlsim.report.page import Page, Section, write_page
from hlsim.report.players import listening_sections
from hlsim.report.plots import pictures_sections
from hlsim.report.results import (
    GAIN_NOTE,
    LEVEL,
    comparison_table,
    score_columns,
    score_details,
    split_rows,
    summary_table,
)


def write_report(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write three files: ``report.html``, a page; ``report.md``, its text; and ``report.json``.

    ``report.json`` contains the settings, comparisons and scores, see ``Evaluation.to_dict``.

    Args:
        evaluation: Evaluation of ``haspi_report``.
        out: Folder of the files.
        listen: Number of items with a player.

    Returns: The path of ``report.html``.

    Raises:
        ValueError: The files cannot be written.
        MissingExtraError: matplotlib or jinja2 is not installed.

    >>> import tempfile
    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import haspi_report
    >>> from hlsim.shortcuts import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> with tempfile.TemporaryDirectory() as out:
    ...     write_report(evaluation, out).name
    'report.html'
    """
    return write_page(report_page(evaluation, listen), evaluation.to_dict(), out)


def report_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page about recorded speech: verdict, scores, sounds, pictures, details.

    Args:
        evaluation: Evaluation of ``haspi_report``.
        listen: Number of items with a player.

    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import haspi_report
    >>> from hlsim.shortcuts import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> report_page(evaluation).title
    'STOI: after'
    """
    columns = {**score_columns(evaluation), **LEVEL}
    tables = [summary_table("Means of all items", split_rows(evaluation.table), columns)]
    texts = [GAIN_NOTE] if "haspi" in evaluation.scores else []
    headline = evaluation.headline
    verdict = _mean_verdict(evaluation)
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
    measures = ", ".join(map(column_title, evaluation.scores))
    return Page(f"{measures}: {', '.join(evaluation.names)}", verdict, sections)


def _mean_verdict(evaluation: Evaluation) -> str:
    """Return the verdict of a page with a single condition: its mean score in a sentence."""
    measure = evaluation.scores[0]
    scored = evaluation.table.dropna(subset=[measure])
    return (
        f"{column_title(measure)} of the condition {evaluation.names[0]} is "
        f"{scored[measure].mean():.3f} on average ({len(scored)} items, at "
        f"{scored['level'].mean():.1f} dB SPL)."
    )


def _words(evaluation: Evaluation, c: Comparison) -> list[str]:
    """Return sentences about the words understood, if the headline is that of HASPI."""
    if c.measure != "haspi":
        return []
    words = evaluation.words(c.before, c.after)
    before, after, _, low, high = (round(100.0 * share) for share in words)
    return [
        f"In words: a listener would understand {before} % of the words of these sentences "
        f"under {c.before} and {after} % under {c.after}, a change of {after - before:+d} points. "
        f"For nine of ten listeners the change lies between {low:+d} and {high:+d} points.",
        "Words are predicted from HASPI by a curve that was fitted to 22 listeners with ten "
        "hearing aids (hlsim.metrics.words). HASPI ranks aids well, but says little about single "
        "listeners.",
    ]
