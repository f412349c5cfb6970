"""Comparisons of two conditions by one measure, over the items of a study."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from hlsim.evaluation.measures import column_title
from hlsim.evaluation.statistics import PairedComparison, holm, paired_comparison

if TYPE_CHECKING:
    from pandas import DataFrame, Series

PlannedComparison = tuple[str, str, str]
"""A comparison that was planned before the scores were known: measure and both conditions.

The order of the conditions does not matter.
"""


@dataclass(frozen=True)
class ConditionComparison:
    """Comparison of two conditions by one measure, over the items that have both scores.

    Attributes:
        measure: Column of the score, such as ``"haspi"``.
        before, after: Names of the two conditions. A change is the score of the second minus that
            of the first.
        overall: Statistics over all items, with p values that are not adjusted.
        level_change: Change of the mean output level of the same items in dB; NaN if levels are
            not known.
        unit: Column of the table that several items share, such as ``"listener"``.
        unit_means: The same statistics over the mean scores of each unit, because items of one
            listener are not independent; None if an item has no unit (an empty text, None or NaN),
            or with fewer than two units.
        left_out: Number of items that lack at least one of the two scores.
        p_t, p_w: P values of the t-test and of Wilcoxon's test that reports state, adjusted by Holm
            unless the comparison is planned; None if a test is not defined.
        planned: Whether the comparison was planned before the scores were known, so that its p
            values are not adjusted. False if it is the only one by this measure, where an
            adjustment changes nothing.
        family: Number of comparisons by the same measure for which the p values are adjusted; 1 for
            a planned comparison.

    >>> import pandas
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> round(compare(table, ["haspi"])[0].overall.delta, 3)
    0.1
    """

    measure: str
    before: str
    after: str
    overall: PairedComparison
    level_change: float
    unit: str
    unit_means: PairedComparison | None
    left_out: int
    p_t: float | None
    p_w: float | None
    planned: bool = False
    family: int = 1

    @property
    def title(self) -> str:
        """Name of the measure in tables."""
        return column_title(self.measure)


def compare(
    table: DataFrame,
    measures: Sequence[str],
    *,
    baseline: str | None = None,
    planned: Collection[PlannedComparison] = (),
    unit: str = "listener",
) -> list[ConditionComparison]:
    """Compare the conditions of a study in pairs, by one or more scores.

    Args:
        table: Table of ``run_study``, with one row per item and condition.
        measures: Columns of scores.
        baseline: Name of the condition with which all others are compared. None compares each
            condition with every earlier one.
        planned: Comparisons that were planned before the scores were known. The p values of all
            other comparisons by the same measure are adjusted by Holm.
        unit: Column that groups items, such as ``"listener"``. The group means are tested as well.

    Returns:
        All comparisons by the first measure, then all by the second one, and so on. A pair is left
        out if no item has both scores.

    Raises:
        KeyError: The table lacks a measure, or the condition ``baseline``.

    >>> import pandas
    >>> rows = [(i, c, 0.1 * i + 0.2 * (c == "b")) for i in range(6) for c in "ab"]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> (comparison,) = compare(table, ["haspi"])
    >>> comparison.before, comparison.after, round(comparison.overall.delta, 3)
    ('a', 'b', 0.2)
    """
    conditions = list(dict.fromkeys(table["condition"]))
    pairs = list(combinations(conditions, 2))
    if baseline is not None:
        pairs = [(baseline, other) for other in conditions if other != baseline]
    comparisons = []
    for measure in measures:
        candidates = [_compare_pair(table, measure, *pair, unit) for pair in pairs]
        defined = [comparison for comparison in candidates if comparison is not None]
        comparisons += _adjust(defined, planned)
    return comparisons


def _adjust(
    comparisons: Sequence[ConditionComparison], planned: Collection[PlannedComparison]
) -> list[ConditionComparison]:
    """Mark the planned comparisons of a measure, and adjust the p values of all others by Holm.

    The number of the others becomes their ``family``. A single comparison is not marked, because
    its p value needs no adjustment.

    Args:
        comparisons: All comparisons by one measure, with p values that are not adjusted.
        planned: See ``compare``.

    Returns: Changed copies, in the same order.
    """
    planned_pairs = {(measure, frozenset(pair)) for measure, *pair in planned}
    marked = []
    for c in comparisons:
        is_planned = (c.measure, frozenset((c.before, c.after))) in planned_pairs
        marked.append(replace(c, planned=len(comparisons) > 1 and is_planned))
    family = [index for index, comparison in enumerate(marked) if not comparison.planned]
    adjusted_t = holm(marked[index].p_t for index in family)
    adjusted_w = holm(marked[index].p_w for index in family)
    for index, p_t, p_w in zip(family, adjusted_t, adjusted_w, strict=True):
        marked[index] = replace(marked[index], p_t=p_t, p_w=p_w, family=len(family))
    return marked


def _compare_pair(
    table: DataFrame, measure: str, before: str, after: str, unit: str
) -> ConditionComparison | None:
    """Compare ``after`` with ``before`` over the items that have both scores; None if none has.

    The p values are not adjusted.

    Args:
        table: Table with the columns ``item``, ``condition`` and the measure, and perhaps ``level``
            and the unit.
        measure: Column of the score.
        before, after: Names of the conditions.
        unit: Column that groups items.
    """
    scores = table.pivot(index="item", columns="condition", values=measure)[[before, after]]
    pairs = scores.dropna()
    if pairs.empty:
        return None
    first, second = pairs.to_numpy(float).T
    rows = table.drop_duplicates("item").set_index("item").loc[pairs.index]
    level_change = math.nan
    if "level" in table:
        levels = table.pivot(index="item", columns="condition", values="level").loc[pairs.index]
        level_change = float((levels[after] - levels[before]).mean())
    overall = paired_comparison(first, second)
    return ConditionComparison(
        measure=measure,
        before=before,
        after=after,
        overall=overall,
        level_change=level_change,
        unit=unit,
        unit_means=_compare_units(rows.reindex(columns=[unit])[unit], first, second),
        left_out=len(scores) - len(pairs),
        p_t=overall.p_t,
        p_w=overall.p_w,
    )


def _compare_units(units: Series, first: np.ndarray, second: np.ndarray) -> PairedComparison | None:
    """Compare the mean scores of each unit, second minus first, where a unit is a group of items.

    Args:
        units: Name of the unit of each item; an empty text, None or NaN if it is unknown. Shape:
            (items,).
        first, second: Scores under both conditions. Shape: (items,).

    Returns:
        The comparison; None if an item has no unit, or if there are fewer than two units.
    """
    names = units.unique()
    if (units.isna() | (units == "")).any() or len(names) < 2:
        return None
    means = [[scores[units == name].mean() for name in names] for scores in (first, second)]
    return paired_comparison(*means)
