"""A HASPI report as JSON, Markdown, LaTeX, one HTML page and a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.metrics.registry import MEASURES
from hlsim.metrics.words import WordsChange
from hlsim.report.page import Picture, Section, render_markdown, render_page, write_files
from hlsim.report.previous.listening import listening_section
from hlsim.report.previous.pictures import draw_report, report_pictures
from hlsim.report.previous.tables import (
    Table,
    comparisons_table,
    listener_table,
    number,
    paper_table,
    severity_table,
)

REPORT_FILES = ("report.json", "report.md", "report.html", "before-after.png")


@dataclass(frozen=True)
class Front:
    """What a page begins with in place of the report's title and lead; the report's own sections follow, folded."""

    title: str
    lead: str
    sections: Sequence[Section]


def write_report(
    report: HaspiReport, out_dir: str | Path, *, listen: int = 3, front: Front | None = None
) -> Path:
    """Write ``report.json``, ``.md``, ``.tex``, ``.html`` and ``before-after.png`` into a folder; returns it.

    Reports of an earlier run are replaced, other files stay. ``listen`` items have spectrograms and players on the page,
    where their files are known.

    Raises:
        ValueError: the path is no folder or cannot be written, or an extra value is nothing that JSON can hold, such
            as NaN.
        MissingExtraError: matplotlib is not installed.
    """
    try:
        text = json.dumps(report.to_dict(), indent=2, ensure_ascii=False, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"report cannot be written as JSON: {error}") from error
    pages = markdown(report, front), html(report, listen, front)
    contents = (text + "\n", *pages, draw_report(report))
    return write_files(out_dir, dict(zip(REPORT_FILES, contents, strict=True)))


def markdown(report: HaspiReport, front: Front | None = None) -> str:
    """What ``report.md`` says: the page without its pictures, what is heard, and the table of all items."""
    front = front or Front(_title(report), report.headline.in_short(), [])
    picture = f"![{report.headline.title} and level, before against after](before-after.png)"
    told = [section for section in front.sections if section.tables]
    return render_markdown(front.title, [*told, *_sections(report)], f"{front.lead}\n\n{picture}")


def html(report: HaspiReport, listen: int = 3, front: Front | None = None) -> str:
    """What ``report.html`` says, with spectrograms and players of ``listen`` items, where their files are known."""
    sections = _sections(report, report_pictures(report), listening_section(report, listen))
    if front is None:
        return render_page(_title(report), sections, report.headline.in_short())
    details = Section("Details", sections=sections, folded=True)
    return render_page(front.title, [*front.sections, details], front.lead)


def _title(report: HaspiReport) -> str:
    measures = ", ".join(MEASURES[name].title for name in report.measures)
    if list(report.conditions) == ["before", "after"]:
        return f"{measures} before and after"
    return f"{measures}: {', '.join(report.conditions)}"


def _sections(
    report: HaspiReport, pictures: Sequence[Picture] = (), listening: Section | None = None
) -> list[Section]:
    headline = report.headline
    ears = " Each is the better ear's." if report.ears else ""
    about = f"{report.comparison.n} items.{ears} {report.note}".rstrip()
    texts = [
        about,
        headline.limits(),
        *([] if report.words is None else [_in_words_understood(report.words)]),
    ]
    sections = [Section("Result", texts, [paper_table(headline)])]
    if listening is not None:
        sections.append(listening)
    if pictures:
        sections.append(Section("Pictures", pictures=pictures))
    sections.append(Section("By degree of loss", tables=[severity_table(headline)]))
    if further := _further(report):
        others = [c.in_short() for c in report.comparisons if c is not headline]
        sections.append(Section("Listeners and further comparisons", others, further))
    if report.failures:
        rows = [(f.file, f.condition, MEASURES[f.measure].title, f.reason) for f in report.failures]
        table = Table(
            "Scores that could not be made", ("Item", "Condition", "Measure", "Reason"), rows
        )
        sections.append(Section("Failures", tables=[table]))
    sections.append(Section("How the figures were made", _notes(report)))
    tables = [_items(report, report.items, "Scores and levels of every item")]
    if report.ears:
        tables.append(_items(report, report.ears, "Scores and levels of each ear"))
    return [*sections, Section("All items", tables=tables, folded=True)]


def _in_words_understood(words: WordsChange) -> str:
    share = (
        f"{100.0 * words.before:.0f} % of the words before and {100.0 * words.after:.0f} % after"
    )
    change, low, high = (f"{100.0 * value:+.0f}" for value in (words.change, words.low, words.high))
    return (
        f"In words: a listener who hears these sentences would understand {share}, a change of {change} points; for nine "
        f"of ten listeners it lies between {low} and {high}. That is a curve fitted to 22 hearing-impaired listeners of "
        "ten aids and HASPI of their better ears (hlsim.metrics.words). HASPI ranks aids, not people: how listeners "
        "differ it hardly tells."
    )


def scored_by(versions: Mapping[str, str]) -> str:
    """What computed HASPI and HASQI."""
    return f"by hlsim {versions['hlsim']} as pyclarity 0.9 computes them"


def _further(report: HaspiReport) -> list[Table]:
    listeners = listener_table(report.headline)
    tables = [] if listeners is None else [listeners]
    return (
        [*tables, comparisons_table(report.comparisons)] if len(report.comparisons) > 1 else tables
    )


def _items(report: HaspiReport, items: Sequence[ItemScore], title: str) -> Table:
    titles = [MEASURES[name].title for name in report.measures]
    rows = []
    for item in items:
        row = {
            "Item": item.file,
            "Loss": item.severity,
            "Clean (dB SPL)": f"{item.clean_level:.1f}",
        }
        row["Full scale (dB SPL)"] = f"{item.full_scale_spl:.1f}"
        for condition in report.conditions:
            for name, measure in zip(report.measures, titles, strict=True):
                row[f"{measure}, {condition}"] = number(
                    item.scores.get(name, {}).get(condition), ".3f"
                )
            row[f"dB SPL, {condition}"] = number(item.levels[condition], ".1f")
        rows.append(row)
    return Table.of(title, rows)


def _notes(report: HaspiReport) -> list[str]:
    """How the figures were made, a sentence or two each."""
    degrees = report.severities
    ears = ", ".join(f"{name} {degrees.count(name)}" for name in SEVERITIES if name in degrees)
    listeners = len({item.listener for item in report.items if item.listener})
    scales = [item.full_scale_spl for item in report.items]
    scale = f"{min(scales):.1f} to {max(scales):.1f} dB SPL, by item"
    if report.full_scale_spl is not None:
        scale = f"{report.full_scale_spl:g} dB SPL"
    extra = [
        f"{name}: {f'{value:.5g}' if isinstance(value, float) else value}"
        for name, value in report.extra.items()
        if isinstance(value, str | int | float)
    ]
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    of_ear = [MEASURES[name].title for name in report.measures if MEASURES[name].of_an_ear]
    computed = f"{' and '.join(of_ear)} (v2) {scored_by(report.versions)}"
    if any(item.sample_rate % 1000 for item in report.items):
        computed += ", the rates rounded to whole kHz (44.1 to 44)"
    return [
        *([f"{computed}."] if of_ear else []),
        f"Degrees of hearing loss: {ears}. {f'Listeners: {listeners}. ' if listeners else ''}"
        f"Clean speech at {report.clean_level_mean:.1f} dB SPL on average. A signal of RMS 1.0 is taken as {scale}.",
        "Changes are after minus before, so a gain is positive. Deviations with n - 1; tests two-sided; "
        "d is the mean difference over the deviation of the differences, t / sqrt(n). "
        "Intervals are percentiles of 9999 bootstrap resamples, expanded for few items (Hesterberg 2015); under six "
        "there is none.",
        f"Wilcoxon: zero differences dropped ({report.comparison.zeros} of {report.comparison.n}; scipy's zero_method "
        '"wilcox"); W is the smaller rank sum.',
        "Tests and intervals take the items as independent; where several share a talker or a listener, p is too small "
        "and the interval too narrow.",
        f"Numpy's seed {report.seed}; each item's seed is in report.json. {versions}.",
        *([f"{'; '.join(extra)}."] if extra else []),
    ]
