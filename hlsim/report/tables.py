"""Tables and sections that the pages of several studies share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import methodcaller
from typing import TYPE_CHECKING, Any

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.comparison import ConditionComparison
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.statistics import RESAMPLES, PairedComparison
from hlsim.report.page import Section, Table
from hlsim.report.verdict import format_p

if TYPE_CHECKING:
    from pandas import DataFrame, Series

GAIN_NOTE = (
    "HASPI rewards any gain, however loud: compare conditions at equal level, and read the level "
    "beside every score."
)

STATISTICS_NOTE = (
    "A change is the later condition minus the earlier one. Standard deviations divide by n - 1; "
    "the tests are two-sided; d is the mean change over the standard deviation of the changes. "
    f"Intervals are percentiles of {RESAMPLES} bootstrap resamples, expanded for few items "
    "(Hesterberg 2015); there is none for fewer than six. Wilcoxon's test leaves out items that "
    "did not change; W is the smaller rank sum."
)

HASQI_NOTE = (
    "HASQI compares with clean speech amplified by NAL-R, which is therefore its ceiling: an "
    "output that is closer to normal hearing than NAL-R's has a lower HASQI."
)

SEVERITY_NOTE = (
    "Degrees of loss are MSBG's four groups by the mean loss from 2 to 8 kHz, which ends at 15, 35 "
    "and 56 dB HL. They are not the grades of the WHO, which follow from the pure-tone average."
)

VERSION_NOTE = "HASPI and HASQI are computed in version 2, as by pyclarity 0.9."

Columns = dict[str, tuple[Callable[["DataFrame"], Any], str]]
"""Columns of a page's table: a dict from title to a pair of a function and a format.

The function computes the cell, a number, None or a text, from the rows of a study's table for one
condition. The format is that of Python's f-strings, such as ``".1f"``.
"""

_STATISTICS: dict[str, Callable[[Series], Any]] = {
    "mean absolute": lambda values: values.abs().mean(),
    "median absolute": lambda values: values.abs().median(),
    "worst tenth": lambda values: values.quantile(0.1),
    "mean ± std": lambda values: _mean_and_deviation(values.mean(), values.std()),
}


def statistic(column: str, name: str = "mean") -> Callable[[DataFrame], Any]:
    """Return a function that computes a statistic of a column of a study's table.

    Args:
        column: Name of the column.
        name: ``"mean absolute"``, ``"median absolute"``, ``"worst tenth"`` (the 10th percentile),
            ``"mean ± std"`` (as text), or a method of a pandas series, such as ``"median"``.

    >>> import pandas
    >>> float(statistic("haspi", "median")(pandas.DataFrame({"haspi": [0.2, 0.4, 0.9]})))
    0.4
    """
    compute = _STATISTICS.get(name) or methodcaller(name)
    return lambda rows: compute(rows[column])


def mean_level(score: str) -> Callable[[DataFrame], Any]:
    """Return a function that computes the mean output level of the rows that have a score.

    Args:
        score: Column of the score.

    >>> import pandas
    >>> rows = pandas.DataFrame({"haspi": [0.2, None], "level": [65.0, 95.0]})
    >>> float(mean_level("haspi")(rows))
    65.0
    """
    return lambda rows: rows.loc[rows[score].notna(), "level"].mean()


def score_columns(evaluation: Evaluation) -> Columns:
    """Return the columns of a table of scores, for ``summary_table``.

    They are the number of items, mean and standard deviation of each score, and the mean output
    level in dB SPL. Number and level are those of the items that have the first score.

    Args:
        evaluation: Evaluation with the scores.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES, Condition
    >>> table = pandas.DataFrame({"item": [0], "condition": ["aid"], "haspi": [0.5]})
    >>> evaluation = Evaluation([], [Condition("aid")], [MEASURES["haspi"]], table)
    >>> list(score_columns(evaluation))
    ['n', 'HASPI (mean ± std)', 'Output level (dB SPL)']
    """
    first, means = evaluation.scores[0], {}
    for score in evaluation.scores:
        means[f"{column_title(score)} (mean ± std)"] = (statistic(score, "mean ± std"), "")
    return {
        "n": (statistic(first, "count"), "d"),
        **means,
        "Output level (dB SPL)": (mean_level(first), ".1f"),
    }


def split_rows(table: DataFrame, fact: str = "") -> dict[str, DataFrame]:
    """Split a study's table into the rows of each condition, and optionally of each value.

    Args:
        table: Table of the study.
        fact: Column with a property of the items, such as ``"snr"`` or ``"severity"``, by whose
            values, rounded to six digits, the rows are split, too, in ascending order; rows without
            a value, None or NaN, are left out. Empty for conditions alone.

    Returns:
        Rows of the table by the name of the condition, such as "aid", or with ``fact`` by value
        and name, such as "5, aid".

    >>> import pandas
    >>> rows = [("unaided", 5.0), ("aid", 5.0), ("unaided", 0.0), ("aid", 0.0)]
    >>> list(split_rows(pandas.DataFrame(rows, columns=["condition", "snr"]), "snr"))
    ['0, unaided', '0, aid', '5, unaided', '5, aid']
    """
    if not fact:
        return dict(iter(table.groupby("condition", sort=False)))
    known = table.dropna(subset=fact)
    # Values that differ only by rounding have one heading, and are one part.
    headings = known[fact].map(lambda value: value if isinstance(value, str) else f"{value:g}")
    places = {name: place for place, name in enumerate(SEVERITIES)}
    parts = [(part[fact].iloc[0], heading, part) for heading, part in known.groupby(headings)]
    rows = {}
    for _, heading, part in sorted(parts, key=lambda entry: places.get(entry[0], entry[0])):
        for name, rows_of_condition in split_rows(part).items():
            rows[f"{heading}, {name}"] = rows_of_condition
    return rows


def summary_table(
    caption: str, table: DataFrame, columns: Columns, fact: str = "", first: str = "Condition"
) -> Table:
    """Return a table with one row of statistics for each condition of a study.

    Args:
        caption: Caption of the table.
        table: Table of the study.
        columns: Functions that compute the cells, see ``Columns``.
        fact: Column by whose values the rows are split, too, see ``split_rows``.
        first: Title of the first column, which contains the names.

    >>> import pandas
    >>> rows = pandas.DataFrame({"condition": ["unaided"] * 2, "haspi": [0.2, 0.4]})
    >>> summary_table("Means", rows, {"HASPI": (statistic("haspi"), ".2f")}).rows
    [['unaided', '0.30']]
    """
    cells = []
    for name, part in split_rows(table, fact).items():
        values = {
            title: format_number(compute(part), form) for title, (compute, form) in columns.items()
        }
        cells.append({first: name, **values})
    return Table.from_rows(caption, cells)


def fact_tables(table: DataFrame, columns: Columns, captions: Mapping[str, str]) -> list[Table]:
    """Return one table of statistics for each property of the items that has several values.

    A table has one row per value and condition.

    Args:
        table: Table of the study.
        columns: Functions that compute the cells, see ``Columns``.
        captions: Captions of the tables by the column with the property, such as ``"snr"``.

    >>> import pandas
    >>> rows = [("aid", 5.0, 0.2), ("aid", 0.0, 0.4)]
    >>> table = pandas.DataFrame(rows, columns=["condition", "snr", "haspi"])
    >>> captions, columns = {"snr": "By SNR", "ear": "By ear"}, {"HASPI": (statistic("haspi"), "")}
    >>> [part.caption for part in fact_tables(table, columns, captions)]
    ['By SNR']
    """
    return [
        summary_table(caption, table, columns, fact, "Items")
        for fact, caption in captions.items()
        if fact in table and table[fact].nunique() > 1
    ]


def format_number(value: Any, form: str) -> str:
    """Format a number; return a text as it is, and "n/a" for None and for NaN.

    Args:
        value: Number, text or None.
        form: Format in the notation of f-strings, such as ``".1f"``.

    >>> format_number(0.25, ".0%"), format_number(None, ".1f")
    ('25%', 'n/a')
    """
    if isinstance(value, str):
        return value
    if value is None or math.isnan(value):
        return "n/a"
    return f"{value:{form}}"


def _mean_and_deviation(mean: float, deviation: float | None) -> str:
    """Format a mean, and its standard deviation unless it is None or NaN, as 0.500 ± 0.100."""
    text = format_number(mean, ".3f")
    return text if deviation is None or math.isnan(deviation) else f"{text} ± {deviation:.3f}"


def comparison_table(
    comparisons: Sequence[ConditionComparison], caption: str = "Comparisons"
) -> Table:
    """Return a table with one row per comparison of two conditions by one measure.

    The columns are the measure with the two conditions, the change of the output level in dB, the
    number of pairs n, the means under both conditions, their change with its 95 % interval, the
    t-test, Wilcoxon's test, Cohen's d, and the p value of the t-test over the means of listeners or
    another unit. The other p values are those of the sentences on the page: adjusted by Holm's
    method unless the comparison was planned. Columns that are "n/a" in all rows are left out.

    Args:
        comparisons: Comparisons, one per row.
        caption: Caption of the table.

    >>> import pandas
    >>> from hlsim.evaluation import compare
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> comparison_table(compare(table, ["haspi"])).rows[0][:2]
    ['HASPI: a to b', '2']
    """
    rows = []
    for c in comparisons:
        planned = " (planned)" if c.planned else ""
        means_p = None if c.unit_means is None else c.unit_means.p_t
        rows.append(
            {
                "Comparison": f"{c.title}: {c.before} to {c.after}{planned}",
                "Level change (dB)": format_number(c.level_change, "+.1f"),
                **_paired_cells(c.overall, c.p_t, c.p_w),
                f"t-test of {c.unit} means": "n/a" if means_p is None else format_p(means_p),
            }
        )
    return Table.from_rows(caption, rows)


def _paired_cells(c: PairedComparison, p_t: float | None, p_w: float | None) -> dict[str, str]:
    """Return the cells of a paired comparison by the title of their column.

    Args:
        c: Statistics over the items.
        p_t, p_w: P values of the t-test and of Wilcoxon's test to show, adjusted or not; for None,
            the cell of the test is n/a.
    """
    interval = "" if c.ci_low is None else f" [{c.ci_low:+.3f}, {c.ci_high:+.3f}]"
    return {
        "n": str(c.n),
        "From (mean ± std)": _mean_and_deviation(c.before_mean, c.before_std),
        "To (mean ± std)": _mean_and_deviation(c.after_mean, c.after_std),
        "Change [95 % interval]": f"{c.delta:+.3f}{interval}",
        "t-test (paired)": "n/a"
        if p_t is None
        else f"t = {format_number(c.t, '+.3f')}, {format_p(p_t)}",
        "Wilcoxon": "n/a" if p_w is None else f"W = {format_number(c.w, '.1f')}, {format_p(p_w)}",
        "d": format_number(c.cohens_d, "+.3f"),
    }


def _comparison_sections(evaluation: Evaluation) -> list[Section]:
    """Return sections with all comparisons, and with the headline comparison by unit.

    The first section is a table of all comparisons, if there is more than one. The second one has
    the headline comparison over all items and over the means of a unit, such as listeners, if these
    were tested. Without comparisons, there are no sections.
    """
    headline, sections = evaluation.headline, []
    if headline is None:
        return []
    pair = f"{headline.title}, {headline.before} to {headline.after}"
    if len(evaluation.comparisons) > 1:
        plan = [f"Planned before the scores were known: {pair}. Its p values are not adjusted."]
        caption = "All comparisons; other p values are adjusted by Holm within each measure"
        table = comparison_table(evaluation.comparisons, caption)
        sections.append(Section("All comparisons", plan if headline.planned else [], [table]))
    if headline.unit_means is not None:
        parts = {"all items": headline.overall, f"{headline.unit} means": headline.unit_means}
        rows = [{"Items": name, **_paired_cells(c, c.p_t, c.p_w)} for name, c in parts.items()]
        table = Table.from_rows(f"{pair}; p not adjusted", rows)
        sections.append(Section(f"Items and {headline.unit}s", tables=[table]))
    return sections


def detail_section(
    evaluation: Evaluation, sections: Sequence[Section], notes: Sequence[str]
) -> Section:
    """Return the folded section "Details" at the end of a page.

    It contains the passed sections, a table of failures if there are any, and the section "How the
    values were computed" with the notes, the seed and the versions of packages.

    Args:
        evaluation: Evaluation of the page, whose ``settings`` contain ``seed``.
        sections: Sections at the beginning.
        notes: Sentences about how the values were computed.

    >>> import pandas
    >>> from hlsim.evaluation import Condition
    >>> rows = [(0, "s01", "aid", "the file is silent")]
    >>> table = pandas.DataFrame(rows, columns=["item", "name", "condition", "failure"])
    >>> evaluation = Evaluation([], [Condition("aid")], [], table, settings={"seed": 0})
    >>> [section.title for section in detail_section(evaluation, [], []).sections]
    ['Failures', 'How the values were computed']
    """
    further = list(sections)
    failures = evaluation.failures[["name", "condition", "failure"]].to_numpy().tolist()
    if failures:
        table = Table("Outputs without all values", ("Item", "Condition", "Reason"), failures)
        further.append(Section("Failures", ["The other items have all values."], [table]))
    versions = ", ".join(f"{name} {v}" for name, v in evaluation.versions.items())
    origin = f"Seed {evaluation.settings['seed']}. Versions: {versions}."
    further.append(Section("How the values were computed", [*notes, origin]))
    return Section("Details", sections=further, folded=True)


def score_details(evaluation: Evaluation) -> Section:
    """Return the section "Details" of a page about scores.

    It has all comparisons, the headline comparison by unit, means by SNR and by degree of loss, and
    failures, as far as there are any, and the notes on how the values were computed.

    Args:
        evaluation: Evaluation of the page.

    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import haspi_report
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> evaluation = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> [section.title for section in score_details(evaluation).sections]
    ['How the values were computed']
    """
    clean, scale = (evaluation.table[name].dropna() for name in ("clean_level", "full_scale_spl"))
    scales = " to ".join(f"{level:.1f}" for level in sorted({scale.min(), scale.max()}))
    notes = [
        VERSION_NOTE,
        f"The clean speech has {clean.mean():.1f} dB SPL on average; RMS 1.0 stands for {scales} "
        "dB SPL.",
        STATISTICS_NOTE,
    ]
    if evaluation.settings.get("better_ear"):
        notes.append("Each score is that of the better ear, by each measure.")
    sections = _comparison_sections(evaluation)
    captions = {"snr": "Means by SNR (dB)", "severity": "Means by degree of loss"}
    tables = fact_tables(evaluation.table, score_columns(evaluation), captions)
    if tables:
        sections.append(Section("Parts of the items", [SEVERITY_NOTE], tables))
    return detail_section(evaluation, sections, notes)
