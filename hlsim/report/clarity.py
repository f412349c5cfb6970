"""The page of ``clarity``, which presents what ``hlsim.evaluation.clarity`` computes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hlsim.evaluation.clarity import NAL_R, RULE_MS, UNAIDED
from hlsim.evaluation.result import Evaluation
from hlsim.files import write_atomically
from hlsim.report.page import Page, Section, Table
from hlsim.report.players import listening_sections
from hlsim.report.plots import pictures_sections
from hlsim.report.results import (
    LEVEL,
    format_number,
    score_details,
    split_rows,
    statistic,
    summary_table,
)

_ABOUT = (
    "Scores are those of the better ear, by each measure, and combined is the mean of HASPI and "
    "HASQI, as in Clarity's challenge at ICASSP 2023. HASPI rewards any gain, so that the level "
    "of the better ear stands beside it. The look-ahead is measured; the challenges allow "
    f"{RULE_MS:g} ms."
)


def write_scores(evaluation: Evaluation, out: str | Path) -> None:
    """Write ``scores.csv`` with one row per scene, listener and condition.

    Args:
        evaluation: Evaluation of ``evaluate_scenes``.
        out: Folder of the file.
    """
    columns = ["utterance", "listener", "condition", "combined", "haspi", "hasqi", "level"]
    scores = _add_combined(evaluation).table[columns].rename(columns={"utterance": "scene"})
    write_atomically(Path(out) / "scores.csv", scores.to_csv(index=False, float_format="%.6f"))


def _add_combined(evaluation: Evaluation) -> Evaluation:
    """Add the column ``combined``, the mean of HASPI and HASQI, to the table of an evaluation."""
    combined = evaluation.table[["haspi", "hasqi"]].mean(axis=1, skipna=False)
    return replace(evaluation, table=evaluation.table.assign(combined=combined))


def scenes_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page about scenes: verdict, conditions, sounds, pictures, details.

    Args:
        evaluation: Evaluation of ``evaluate_scenes``.
        listen: Number of scenes with a player.
    """
    planned = [c.verdict() for c in evaluation.comparisons if c.planned]
    verdict, *further_verdicts = planned or [f"No pair of aids could be compared with {NAL_R}."]
    played = [UNAIDED, NAL_R, *evaluation.of_kind("aid")]
    sections = [
        Section("Conditions", [*further_verdicts, _ABOUT], [_conditions_table(evaluation)]),
        *listening_sections(evaluation, listen, played),
        *pictures_sections(evaluation),
        score_details(evaluation),
    ]
    title = f"Clarity's scenes: {evaluation.table['item'].nunique()} pairs of scene and listener"
    return Page(title, verdict, sections)


def _conditions_table(evaluation: Evaluation) -> Table:
    """Return a table with one row per condition.

    The columns are mean scores, the level of the output, the look-ahead in ms, and whether this is
    within the rule of the Clarity challenge. Only those pairs of scene and listener are used for
    which all conditions have scores, except conditions that have no score at all.
    """
    evaluation = _add_combined(evaluation)
    combined = evaluation.wide("combined").dropna(axis=1, how="all")
    scored = combined.notna().all(axis=1)
    table = evaluation.table[evaluation.table["item"].map(scored)]
    scores = {"HASPI": "haspi", "HASQI": "hasqi", "Combined": "combined"}
    columns = {**{title: (statistic(score), ".3f") for title, score in scores.items()}, **LEVEL}
    shared = "" if scored.all() else f"the {scored.sum()} that all conditions have scores of, of "
    caption = f"Means of {shared}{len(scored)} pairs of scene and listener"
    means = summary_table(caption, split_rows(table), columns)
    rows = []
    for row in means.rows:
        look_ahead = evaluation.details["look_ahead_ms"][row[0]]
        within_rule = ""
        if look_ahead is not None:
            within_rule = "yes" if look_ahead <= RULE_MS else "no"
        rows.append((*row, format_number(look_ahead, ".1f"), within_rule))
    return Table(caption, (*means.header, "Look-ahead (ms)", f"Within {RULE_MS:g} ms"), rows)
