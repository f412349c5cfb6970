"""The page and the table of scores of Clarity's scenes."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hlsim.evaluation.previous.clarity import RULE_MS
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.report.page import Section, write_files
from hlsim.report.previous.haspi import Front, write_report
from hlsim.report.previous.tables import Table, number

_COLUMNS = ("scene", "listener", "condition", "combined", "haspi", "hasqi", "level")

_ABOUT = (
    "Scores are the better ear's, by each measure, and combined is the mean of the two, as in Clarity's challenge at "
    "ICASSP 2023. HASPI rewards any gain, so the level that the better ear is given stands beside it. An aid looks ahead "
    "as long as its output changes before its input becomes another sound; the challenges allow {rule:g} ms."
)


def write_scenes(report: HaspiReport, out: str | Path, *, listen: int = 3) -> Path:
    """Write ``scores.csv`` and the files of ``write_report`` into a folder; returns it. ValueError as that."""
    title = f"Clarity's scenes: {len(report.items)} pairs of scene and listener"
    result = Section("Conditions", [_ABOUT.format(rule=RULE_MS)], [conditions_table(report)])
    write_report(
        report, out, listen=listen, front=Front(title, report.headline.in_short(), [result])
    )
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_COLUMNS, *_rows(report)])
    return write_files(out, {"scores.csv": text.getvalue()})


def conditions_table(report: HaspiReport) -> Table:
    """A row a condition: means of the pairs that all have scores of, and how far the aid looks ahead.

    A condition that has no score at all takes none from the others.
    """
    haspi, hasqi, levels = report.scores("haspi"), report.scores("hasqi"), report.levels()
    combined = 0.5 * (haspi + hasqi)
    scored = np.isfinite(combined)
    shared = scored[:, scored.any(0)].all(1)
    rows = []
    for at, name in enumerate(report.conditions):
        ahead = report.extra["looks_ahead_ms"][name]
        figures = ((haspi, ".3f"), (hasqi, ".3f"), (combined, ".3f"), (levels, ".1f"))
        means = [number(_mean(values[shared, at]), how) for values, how in figures]
        rule = "" if ahead is None else "yes" if ahead <= RULE_MS else "no"
        rows.append((name, *means, number(ahead, ".1f"), rule))
    header = (
        "Given",
        "HASPI",
        "HASQI",
        "Combined",
        "Level (dB SPL)",
        "Looks ahead (ms)",
        f"Within {RULE_MS:g} ms",
    )
    of = "" if shared.all() else f"the {shared.sum()} that all have scores of, of "
    return Table(f"Means of {of}{len(report.items)} pairs of scene and listener", header, rows)


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if np.isfinite(values).any() else None


def _rows(report: HaspiReport) -> Iterator[list[str]]:
    for item in report.items:
        scene = item.file.removeprefix(f"{item.listener} ")
        for name in report.conditions:
            haspi, hasqi = (item.scores[measure].get(name) for measure in ("haspi", "hasqi"))
            both = None if haspi is None or hasqi is None else 0.5 * (haspi + hasqi)
            figures = [number(value, ".6f", "") for value in (both, haspi, hasqi)]
            yield [scene, item.listener, name, *figures, number(item.levels[name], ".2f", "")]
