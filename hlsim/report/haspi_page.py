"""A report as one HTML page: the tables and words of ``report.md``, pictures, and chosen items as heard."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hlsim.metrics.registry import MEASURES
from hlsim.report.haspi_pictures import report_pictures
from hlsim.report.haspi_text import (
    comparisons_table,
    failure_table,
    listener_table,
    notes,
    opening,
    paper_table,
    severity_table,
    title,
)
from hlsim.report.listening import listening_section
from hlsim.report.page import Section, Table, render_page

if TYPE_CHECKING:
    from hlsim.evaluation.scores import HaspiReport


def html(report: HaspiReport, listen: int = 3) -> str:
    """What ``report.html`` says.

    Args:
        listen: how many items have spectrograms and players, where their files are known.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    headline = report.headline
    further = [listener_table(headline)]
    if len(report.comparisons) > 1:
        further.append(comparisons_table(report))
    others = [c.in_short() for c in report.comparisons if c is not headline]
    sections = [
        Section("Result", paragraphs=[headline.in_words(), *opening(report)], tables=[paper_table(headline)]),
        Section("Pictures", pictures=report_pictures(report)),
        Section("By degree of loss", tables=[severity_table(headline)]),
    ]
    tables = [table for table in further if table is not None]
    if tables:
        sections.append(Section("Listeners and further comparisons", paragraphs=others, tables=tables))
    if report.failures:
        sections.append(Section("Failures", tables=[failure_table(report)]))
    if (listening := listening_section(report, listen)) is not None:
        sections.append(listening)
    sections.append(Section("How the figures were made", paragraphs=notes(report)))
    sections.append(Section("All items", tables=[_items(report)], folded=True))
    lead = f"{headline.overall.n} items, {len(report.conditions)} conditions: {', '.join(report.conditions)}."
    return render_page(title(report), sections, lead)


def _items(report: HaspiReport) -> Table:
    header = ["Item", "Loss", "Clean (dB SPL)", "Full scale (dB SPL)"]
    for condition in report.conditions:
        header += [f"{MEASURES[measure].title}, {condition}" for measure in report.measures]
        header.append(f"dB SPL, {condition}")
    rows = []
    for item in report.items:
        row = [item.file, item.audiogram.severity, f"{item.clean_level:.1f}", f"{item.full_scale_spl:.1f}"]
        for condition in report.conditions:
            for measure in report.measures:
                score = item.scores.get(measure, {}).get(condition)
                row.append("n/a" if score is None else f"{score:.3f}")
            level = item.levels[condition]
            row.append("n/a" if level is None else f"{level:.1f}")
        rows.append(row)
    return Table("Scores and levels of every item", header, rows)
