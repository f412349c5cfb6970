"""The pages about recordings: those of ``haspi-report`` and of ``clarity``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hlsim.evaluation.clarity import RULE_MS
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.conditions import NAL_R, UNAIDED
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation
from hlsim.files import write_atomically
from hlsim.report.page import Page, Section, Table, write_page
from hlsim.report.players import listening_sections
from hlsim.report.plots import scores_pictures
from hlsim.report.results import (
    GAIN_NOTE,
    Columns,
    comparison_table,
    score_columns,
    score_details,
    split_rows,
    statistic,
    summary_table,
)

_ABOUT_SCENES = (
    "Scores are those of the better ear, by each measure, and combined is the mean of HASPI and "
    "HASQI, as in Clarity's challenge at ICASSP 2023. HASPI rewards any gain, so that the level "
    "of the better ear stands beside it. The look-ahead is measured; the challenges allow "
    f"{RULE_MS:g} ms."
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
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> with tempfile.TemporaryDirectory() as out:
    ...     write_report(evaluation, out).name
    'report.html'
    """
    return write_page(report_page(evaluation, listen), evaluation.to_dict(), out)


def report_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page about recorded speech: verdict, scores, sounds, details.

    Args:
        evaluation: Evaluation of ``haspi_report``.
        listen: Number of items with a player.

    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import haspi_report
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> report_page(evaluation).title
    'STOI: after'
    """
    rows, columns = split_rows(evaluation.table), score_columns(evaluation)
    tables = [summary_table("Means of all items", rows, columns)]
    texts = [GAIN_NOTE] if "haspi" in evaluation.scores else []
    headline = evaluation.headline
    verdict = _mean_verdict(evaluation)
    if headline is not None:
        verdict = headline.verdict()
        tables.append(comparison_table([headline], "The comparison of the first sentence"))
        texts = [headline.limits(), *texts, *_words(evaluation, headline)]
    sections = [
        Section("Scores", texts, tables, scores_pictures(evaluation)),
        *listening_sections(evaluation, listen),
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


def write_scores(evaluation: Evaluation, out: str | Path) -> None:
    """Write ``scores.csv`` with one row per scene, listener and condition.

    Args:
        evaluation: Evaluation of ``evaluate_scenes``.
        out: Folder of the file.

    >>> import pandas
    >>> import tempfile
    >>> row = {"utterance": "S1", "listener": "L1", "condition": "aid", "haspi": 0.5, "hasqi": 0.3}
    >>> evaluation = Evaluation([], [], [], pandas.DataFrame([row | {"level": 80.0}]))
    >>> with tempfile.TemporaryDirectory() as out:
    ...     write_scores(evaluation, out)
    ...     print((Path(out) / "scores.csv").read_text().splitlines()[1])
    S1,L1,aid,0.400000,0.500000,0.300000,80.000000
    """
    columns = ["utterance", "listener", "condition", "combined", "haspi", "hasqi", "level"]
    scores = _add_combined(evaluation).table[columns].rename(columns={"utterance": "scene"})
    write_atomically(Path(out) / "scores.csv", scores.to_csv(index=False, float_format="%.6f"))


def _add_combined(evaluation: Evaluation) -> Evaluation:
    """Add the column ``combined``, the mean of HASPI and HASQI, to the table of an evaluation."""
    combined = evaluation.table[["haspi", "hasqi"]].mean(axis=1, skipna=False)
    return replace(evaluation, table=evaluation.table.assign(combined=combined))


def scenes_page(evaluation: Evaluation, listen: int = 3) -> Page:
    """Return the page about scenes: verdict, conditions, sounds, details.

    Args:
        evaluation: Evaluation of ``evaluate_scenes``.
        listen: Number of scenes with a player.

    >>> import pandas
    >>> from hlsim.evaluation import Condition
    >>> row = {"item": 0, "name": "S1", "condition": "unaided", "haspi": 0.5, "hasqi": 0.3}
    >>> row |= {"level": 80.0, "clean_level": 65.0, "full_scale_spl": 100.0, "failure": None}
    >>> further = {"settings": {"seed": 0}, "details": {"look_ahead_ms": {"unaided": 0.0}}}
    >>> table, conditions = pandas.DataFrame([row]), [Condition("unaided")]
    >>> scenes_page(Evaluation([], conditions, [], table, **further)).title
    "Clarity's scenes: 1 pairs of scene and listener"
    """
    planned = [c.verdict() for c in evaluation.comparisons if c.planned]
    verdict, *further_verdicts = planned or [f"No pair of aids could be compared with {NAL_R}."]
    played = [UNAIDED, NAL_R, *evaluation.aids]
    texts = [*further_verdicts, _ABOUT_SCENES]
    tables, pictures = [_conditions_table(evaluation)], scores_pictures(evaluation)
    sections = [
        Section("Conditions", texts, tables, pictures),
        *listening_sections(evaluation, listen, played),
        score_details(evaluation),
    ]
    title = f"Clarity's scenes: {evaluation.table['item'].nunique()} pairs of scene and listener"
    return Page(title, verdict, sections)


def _conditions_table(evaluation: Evaluation) -> Table:
    """Return a table with one row per condition.

    The columns are mean scores, the level of the output, and the look-ahead in ms. Only those pairs
    of scene and listener are used for which all conditions have scores, except conditions that have
    no score at all.
    """
    evaluation = _add_combined(evaluation)
    combined = evaluation.wide("combined").dropna(axis=1, how="all")
    scored = combined.notna().all(axis=1)
    table = evaluation.table[evaluation.table["item"].map(scored)]
    scores = {"HASPI": "haspi", "HASQI": "hasqi", "Combined": "combined"}
    columns: Columns = {title: (statistic(score), ".3f") for title, score in scores.items()}
    columns["Level (dB SPL)"] = (statistic("level"), ".1f")
    shared = "" if scored.all() else f"the {scored.sum()} that all conditions have scores of, of "
    caption = f"Means of {shared}{len(scored)} pairs of scene and listener"
    look_ahead = evaluation.details["look_ahead_ms"]
    columns["Look-ahead (ms)"] = (lambda rows: look_ahead[rows["condition"].iloc[0]], ".1f")
    return summary_table(caption, split_rows(table), columns)
