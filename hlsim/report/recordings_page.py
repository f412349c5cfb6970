"""The pages about recordings: those of ``haspi-report`` and of ``clarity``."""

from dataclasses import replace
from pathlib import Path

from hlsim.evaluation.clarity import RULE_MS
from hlsim.evaluation.comparison import ConditionComparison
from hlsim.evaluation.conditions import NAL_R
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation
from hlsim.report.page import Page, Section, Table
from hlsim.report.players import listening_sections
from hlsim.report.plots import means_pictures, scores_pictures
from hlsim.report.tables import (
    GAIN_NOTE,
    HASQI_NOTE,
    Columns,
    comparison_table,
    mean_level,
    score_columns,
    score_details,
    statistic,
    summary_table,
)
from hlsim.report.verdict import describe_means, describe_missing_pairs, limits, verdict
from hlsim.report.writing import write_results

_ABOUT_SCENES = (
    "Scores are those of the better ear, by each measure, and combined is the mean of HASPI and "
    "HASQI, as in Clarity's challenge at ICASSP 2023. HASPI rewards any gain, so that the level "
    "of the better ear stands beside it. The look-ahead is measured; the challenges allow "
    f"{RULE_MS:g} ms."
)


def write_report(evaluation: Evaluation, out: str | Path) -> Path:
    """Write the page of ``haspi_report`` and its data, see ``write_results``.

    Args:
        evaluation: Evaluation of ``haspi_report``.
        out: Folder of the files.

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
    return write_results(report_page(evaluation), evaluation, out)


def report_page(evaluation: Evaluation) -> Page:
    """Return the page of ``haspi-report``: verdict, scores, sounds and details.

    Args:
        evaluation: Evaluation of ``haspi_report``.

    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import haspi_report
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> report_page(evaluation).title
    'STOI: after'
    """
    columns = score_columns(evaluation)
    tables = [summary_table("Means of all items", evaluation.table, columns)]
    texts = [GAIN_NOTE] if "haspi" in evaluation.scores else []
    headline = evaluation.headline
    if headline is None:
        first_sentence = describe_means(evaluation)
    else:
        first_sentence = verdict(headline)
        tables.append(comparison_table([headline], "The comparison of the first sentence"))
        texts = [limits(headline), *texts, *_words(evaluation, headline)]
    texts = [*evaluation.notes, *describe_missing_pairs(evaluation), *texts]
    if "hasqi" in evaluation.scores:
        texts.append(HASQI_NOTE)
    pictures = [*means_pictures(evaluation), *scores_pictures(evaluation)]
    sections = [
        Section("Scores", texts, tables, pictures),
        *listening_sections(evaluation),
        score_details(evaluation),
    ]
    measures = ", ".join(map(column_title, evaluation.scores))
    return Page(f"{measures}: {', '.join(evaluation.names)}", first_sentence, sections)


def _words(evaluation: Evaluation, c: ConditionComparison) -> list[str]:
    """Return two texts that predict the words understood, or [] if ``c`` is not about HASPI."""
    if c.measure != "haspi":
        return []
    words = evaluation.words(c.before, c.after)
    before, after, _, low, high = (round(100.0 * share) for share in words)
    return [
        f"In words: a listener would understand {before} % of the words of these sentences "
        f"under {c.before} and {after} % under {c.after}, a change of {after - before:+d} points. "
        f"For nine of ten listeners the change lies between {low:+d} and {high:+d} points.",
        "Words are predicted from HASPI by a curve that was fitted to 26 listeners with "
        "twelve hearing aids and to HASPI of their better ear (hlsim.metrics.words): for single "
        "ears it extrapolates. HASPI ranks aids well, but says little about single listeners.",
    ]


def scenes_page(evaluation: Evaluation) -> Page:
    """Return the page of ``clarity``: verdict, conditions, sounds and details.

    Args:
        evaluation: Evaluation of ``evaluate_scenes``.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES, Condition
    >>> row = {"item": 0, "name": "S1", "condition": "unaided", "haspi": 0.5, "hasqi": 0.3}
    >>> row |= {"combined": 0.4, "level": 80.0, "clean_level": 65.0, "full_scale_spl": 100.0}
    >>> row |= {"failure": None}
    >>> further = {"settings": {"seed": 0}, "details": {"look_ahead_ms": {"unaided": 0.0}}}
    >>> table, conditions = pandas.DataFrame([row]), [Condition("unaided")]
    >>> measures = [MEASURES["haspi"], MEASURES["hasqi"]]
    >>> scenes_page(Evaluation([], conditions, measures, table, **further)).title
    "Clarity's scenes: 1 pairs of scene and listener"
    """
    planned = [verdict(c) for c in evaluation.comparisons if c.planned]
    first_sentence, *further_verdicts = planned or [
        f"No pair of aids could be compared with {NAL_R}."
    ]
    texts = [*evaluation.notes, *further_verdicts, _ABOUT_SCENES, HASQI_NOTE]
    pictures = [*means_pictures(_shared_pairs(evaluation)), *scores_pictures(evaluation)]
    tables = [_conditions_table(evaluation)]
    sections = [
        Section("Conditions", texts, tables, pictures),
        *listening_sections(evaluation),
        score_details(evaluation),
    ]
    title = f"Clarity's scenes: {evaluation.table['item'].nunique()} pairs of scene and listener"
    return Page(title, first_sentence, sections)


def _conditions_table(evaluation: Evaluation) -> Table:
    """Return a table with one row per condition.

    The columns are mean scores, the output level in dB SPL, and the look-ahead in ms. Means are
    over the pairs of ``_shared_pairs``.
    """
    table = _shared_pairs(evaluation).table
    count, total = table["item"].nunique(), evaluation.table["item"].nunique()
    shared = "" if count == total else f"the {count} that all conditions have scores of, of "
    caption = f"Means of {shared}{total} pairs of scene and listener"
    look_ahead = evaluation.details["look_ahead_ms"]
    columns: Columns = {
        "HASPI": (statistic("haspi"), ".3f"),
        "HASQI": (statistic("hasqi"), ".3f"),
        "Combined": (statistic("combined"), ".3f"),
        "Level (dB SPL)": (mean_level("combined"), ".1f"),
        "Look-ahead (ms)": (lambda rows: look_ahead[rows["condition"].iloc[0]], ".1f"),
    }
    return summary_table(caption, table, columns)


def _shared_pairs(evaluation: Evaluation) -> Evaluation:
    """Return the evaluation of the pairs of scene and listener with scores under all conditions.

    A condition without any score does not count for this.
    """
    combined = evaluation.wide("combined").dropna(axis=1, how="all")
    scored = combined.notna().all(axis=1)
    return replace(evaluation, table=evaluation.table[evaluation.table["item"].map(scored)])
