"""The page and the table of scores of Clarity's scenes."""

from __future__ import annotations

from pathlib import Path

from hlsim.evaluation.clarity import RULE_MS
from hlsim.evaluation.measures import title_of
from hlsim.evaluation.result import Evaluation
from hlsim.files import write_atomically
from hlsim.report.listening import listening_section
from hlsim.report.page import Page, Section, Table, write_page
from hlsim.report.plots import study_pictures
from hlsim.report.recordings import detail_section
from hlsim.report.results import number

_ABOUT = (
    "Scores are those of the better ear, by each measure, and combined is the mean of HASPI and HASQI, as in "
    "Clarity's challenge at ICASSP 2023. HASPI rewards any gain, so that the level of the better ear stands beside "
    f"it. The look-ahead is measured; the challenges allow {RULE_MS:g} ms."
)


def write_scenes(evaluation: Evaluation, out: str | Path, *, listen: int = 3) -> Path:
    """Write ``scores.csv`` and the files of ``write_report`` into a folder."""
    write_scores(evaluation, out)
    return write_page(scenes_page(evaluation, listen), evaluation.to_dict(), out)


def write_scores(evaluation: Evaluation, out: str | Path) -> None:
    """Write ``scores.csv``: a row for each scene, listener and condition."""
    table = evaluation.table.assign(
        combined=(evaluation.table["haspi"] + evaluation.table["hasqi"]) / 2
    )
    columns = ["scene", "listener", "condition", "combined", "haspi", "hasqi", "level"]
    text = table[columns].to_csv(index=False, float_format="%.6f")
    write_atomically(Path(out) / "scores.csv", text)


def scenes_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page of scenes: verdict, conditions, sounds, pictures, details."""
    planned = [c.verdict() for c in evaluation.comparisons if c.planned]
    verdict = (
        planned[0] if planned else f"No pair of aids could be compared with {evaluation.names[1]}."
    )
    items = len(evaluation.items)
    aids = [condition.name for condition in evaluation.conditions if condition.kind == "aid"]
    heard = [*evaluation.names[:1], "NAL-R", *aids]
    pictures = study_pictures(evaluation)
    sections = [
        Section("Conditions", [*planned[1:], _ABOUT], [conditions_table(evaluation)]),
        listening_section(evaluation, listen, heard),
        Section("Pictures", pictures=pictures) if pictures else None,
        detail_section(evaluation),
    ]
    title = f"Clarity's scenes: {items} pairs of scene and listener"
    return Page(title, verdict, [section for section in sections if section is not None])


def conditions_table(evaluation: Evaluation) -> Table:
    """Return means of the pairs that all conditions have scores of, and the look-ahead.

    A condition without any score takes none from the others.
    """
    haspi, hasqi, level = (evaluation.wide(column) for column in ("haspi", "hasqi", "level"))
    columns = {
        title_of("haspi"): haspi,
        title_of("hasqi"): hasqi,
        "Combined": 0.5 * (haspi + hasqi),
    }
    scored = columns["Combined"].dropna(axis=1, how="all").notna().all(axis=1)
    rows = []
    for name in evaluation.names:
        row = {"Condition": name}
        for title, wide in columns.items():
            row[title] = number(wide[name][scored].mean(), ".3f")
        row["Level (dB SPL)"] = number(level[name][scored].mean(), ".1f")
        ahead = evaluation.details["look_ahead_ms"][name]
        row["Look-ahead (ms)"] = number(ahead, ".1f")
        within = "" if ahead is None else "yes" if ahead <= RULE_MS else "no"
        rows.append({**row, f"Within {RULE_MS:g} ms": within})
    shared = "" if scored.all() else f"the {scored.sum()} that all conditions have scores of, of "
    return Table.of(f"Means of {shared}{len(scored)} pairs of scene and listener", rows)
