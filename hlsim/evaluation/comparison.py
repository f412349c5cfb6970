"""Comparisons of two conditions by one measure, over the items of a study, and in sentences."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.statistics import PairedComparison, holm, paired_comparison

if TYPE_CHECKING:
    from pandas import DataFrame

_ALPHA = 0.05
"""p value below which a change is called significant."""

_LEVEL_TOLERANCE_DB = 1.0
"""Change of the level in dB that is too small to explain a change of a score."""

PlannedComparison = tuple[str, str, str]
"""A comparison that was planned before the scores were known: measure and both conditions."""


@dataclass(frozen=True)
class Comparison:
    """Comparison of two conditions by one measure, over the items that have both scores.

    Attributes:
        measure: Column of the score, such as ``"haspi"``.
        before, after: Names of the two conditions. A change is the score of the second minus that
            of the first.
        overall: Statistics over all items, with p values that are not adjusted.
        level_change: Change of the mean output level of the same items in dB; NaN if levels are
            not known.
        by_severity: The same statistics for the items of each degree of hearing loss that occurs,
            under its name, such as ``"mild"``.
        unit: Column of the table that several items share, such as ``"listener"``.
        unit_means: The same statistics over one mean score per unit, because items of one listener
            are not independent; None unless there are two units or more.
        left_out: Number of items that lack one of the two scores.
        p_t, p_w: P values of the t-test and of Wilcoxon's test that reports state, adjusted by Holm
            unless the comparison is planned; None if a test is not defined.
        planned: Whether the comparison was planned before the scores were known, so that its p
            values are not adjusted.
        family: Number of comparisons by the same measure for which the p values are adjusted.

    >>> import pandas
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> compare(table, ["haspi"])[0].verdict()[:52]
    'b cannot be distinguished from a: HASPI 0.400 agains'
    """

    measure: str
    before: str
    after: str
    overall: PairedComparison
    level_change: float
    by_severity: Mapping[str, PairedComparison]
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

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes, and ``verdict`` and ``limits`` as text, for ``report.json``."""
        level_change = None if math.isnan(self.level_change) else self.level_change
        words = f"{self.verdict()} {self.limits()}"
        return asdict(self) | {"level_change": level_change, "in_words": words}

    def verdict(self, subject: str = "", rival: str = "") -> str:
        """Return a sentence that says which condition is better, with scores and p values.

        A higher score is called better only at equal level, because HASPI rewards gain.

        Args:
            subject: Other words for the condition ``after``, which begin the sentence.
            rival: Other words for the condition ``before``.
        """
        c = self.overall
        rises = c.delta > 0
        significant = self._significant_tests()
        if not any(significant):
            verb = "cannot be distinguished from"
        elif abs(self.level_change) < _LEVEL_TOLERANCE_DB:
            verb = "is" if all(significant) else "may be"
            verb += " better than" if rises else " worse than"
        else:
            verb = "scores" if all(significant) else "may score"
            verb += " higher than" if rises else " lower than"
        text = f"{subject or self.after} {verb} {rival or self.before}"
        if abs(self.level_change) >= _LEVEL_TOLERANCE_DB:
            direction = "softer" if self.level_change > 0 else "louder"
            text += f", which is {abs(self.level_change):.1f} dB {direction}"
        facts = f"{_count_items(c.n)}, change {c.delta:+.3f}"
        if c.ci_low is not None:
            facts += f", 95 % interval {c.ci_low:+.3f} to {c.ci_high:+.3f}"
        means = f"{self.title} {c.after_mean:.3f} against {c.before_mean:.3f}"
        return f"{text}: {means} ({facts}; {self._describe_tests()})."

    def limits(self) -> str:
        """Return sentences on output levels, dependent items and other limits of the verdict."""
        sentences = []
        change, delta = self.level_change, self.overall.delta
        if not math.isnan(change):
            sentences.append(f"The mean level changed by {change:+.1f} dB.")
        may_be_gain = change * delta > 0 and abs(change) >= _LEVEL_TOLERANCE_DB
        if self.measure == "haspi" and may_be_gain and any(self._significant_tests()):
            sentences.append("HASPI rewards gain, which alone may explain the change.")
        sentences.append(self._describe_units())
        if self.left_out:
            sentences.append(f"{_count_items(self.left_out)} without both scores are left out.")
        sentences.append(
            f"{self.title} is the prediction of a model: no listener was asked, and other speech "
            "and other ears may give other results."
        )
        return " ".join(sentences)

    def _describe_tests(self) -> str:
        """State the p values, which are the same wherever the comparison appears."""
        tests = {"t-test": self.p_t, "Wilcoxon": self.p_w}
        stated = [f"{name} {format_p(p)}" for name, p in tests.items() if p is not None]
        if not stated:
            return "neither test is defined"
        if self.planned:
            stated.append("planned comparison, not adjusted")
        elif self.family > 1:
            stated.append(f"adjusted by Holm for {self.family} comparisons")
        return ", ".join(stated)

    def _significant_tests(self) -> list[bool]:
        """Return for each test that can decide whether its p value is below ``_ALPHA``.

        With few items, Wilcoxon's p exceeds ``_ALPHA`` even if all pairs change alike.
        """
        decisions = [] if self.p_t is None else [self.p_t < _ALPHA]
        lowest_p = self.family * 2.0 ** (1 - (self.overall.n - self.overall.zeros))
        if self.p_w is not None and (self.p_w < _ALPHA or lowest_p < _ALPHA):
            decisions.append(self.p_w < _ALPHA)
        return decisions

    def _describe_units(self) -> str:
        means = self.unit_means
        if means is None:
            return (
                "The tests treat items as independent. If several share a talker or a listener, p "
                "is too small and the interval too narrow."
            )
        result = "is not defined" if means.p_t is None else f"gives {format_p(means.p_t)}"
        return (
            "The interval and the tests treat items as independent, although several share one "
            f"{self.unit}; the t-test over the means of the {means.n} {self.unit}s {result}."
        )


def compare(
    table: DataFrame,
    measures: Sequence[str],
    *,
    baseline: str | None = None,
    planned: Collection[PlannedComparison] = (),
    unit: str = "listener",
) -> list[Comparison]:
    """Compare the conditions of a study in pairs, by one or more scores.

    Args:
        table: Table of ``run_study``, with one row per item and condition.
        measures: Columns of scores.
        baseline: Name of the condition with which all others are compared. None compares each
            condition with every earlier one.
        planned: Comparisons that were planned before the scores were known. The p values of all
            other comparisons by the same measure are adjusted by Holm.
        unit: Column that several items share, such as ``"listener"``; their means are compared too.

    Returns:
        The comparisons of each measure in turn. A pair is left out if no item has both scores.

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
    comparisons: Sequence[Comparison], planned: Collection[PlannedComparison]
) -> list[Comparison]:
    """Mark the planned comparisons of a measure, and adjust the p values of all others."""
    marked = [
        replace(c, planned=len(comparisons) > 1 and (c.measure, c.before, c.after) in planned)
        for c in comparisons
    ]
    family = [index for index, comparison in enumerate(marked) if not comparison.planned]
    adjusted_t = holm(marked[index].p_t for index in family)
    adjusted_w = holm(marked[index].p_w for index in family)
    for index, p_t, p_w in zip(family, adjusted_t, adjusted_w, strict=True):
        marked[index] = replace(marked[index], p_t=p_t, p_w=p_w, family=len(family))
    return marked


def _compare_pair(
    table: DataFrame, measure: str, before: str, after: str, unit: str
) -> Comparison | None:
    """Compare two conditions, or return None if no item has both scores."""
    scores = table.pivot(index="item", columns="condition", values=measure)[[before, after]]
    pairs = scores.dropna()
    if pairs.empty:
        return None
    first, second = pairs.to_numpy(float).T
    rows = table.drop_duplicates("item").set_index("item").loc[pairs.index]
    degrees, units = (np.array(rows.get(column, [])) for column in ("severity", unit))
    level_change = math.nan
    if "level" in table:
        levels = table.pivot(index="item", columns="condition", values="level").loc[pairs.index]
        level_change = float((levels[after] - levels[before]).mean())
    by_severity = {
        name: paired_comparison(first[degrees == name], second[degrees == name])
        for name in SEVERITIES
        if name in degrees
    }
    overall = paired_comparison(first, second)
    return Comparison(
        measure=measure,
        before=before,
        after=after,
        overall=overall,
        level_change=level_change,
        by_severity=by_severity,
        unit=unit,
        unit_means=_compare_units(units, first, second),
        left_out=len(scores) - len(pairs),
        p_t=overall.p_t,
        p_w=overall.p_w,
    )


def _compare_units(
    units: np.ndarray, first: np.ndarray, second: np.ndarray
) -> PairedComparison | None:
    """Compare the means of each unit, or return None unless two units or more have names."""
    names = list(dict.fromkeys(units))
    if not all(units) or len(names) < 2:
        return None
    means = [[scores[units == name].mean() for name in names] for scores in (first, second)]
    return paired_comparison(*means)


def format_p(p: float) -> str:
    """Return a p value as reports state it: with five decimals, or as ``p < 0.00001``.

    >>> format_p(0.0125)
    'p = 0.01250'
    """
    return "p < 0.00001" if p < 1e-5 else f"p = {p:.5f}"


def _count_items(count: int) -> str:
    return "1 item" if count == 1 else f"{count} items"
