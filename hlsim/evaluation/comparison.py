"""Two conditions compared by one measure: overall, by degree of loss, by listener, and in words."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.measures import MEASURES, title_of
from hlsim.evaluation.statistics import PairedComparison, holm, paired_comparison

if TYPE_CHECKING:
    from pandas import DataFrame

ALPHA = 0.05
"""p value below which chance is called an unlikely explanation."""

EQUAL_DB = 1.0
"""Change of level in dB that is too small to explain a change of a score."""

Pair = tuple[str, str, str]
"""Measure, condition before and condition after."""


@dataclass(frozen=True)
class Comparison:
    """One measure under two conditions, for the items that have both scores.

    Attributes:
        overall: comparison over all items, with p values that are not adjusted.
        level_before_mean, level_after_mean: mean output levels of the same items in dB SPL; NaN if
            they are not known.
        by_severity: comparison for each degree of loss that occurs.
        unit: column within which the items are nested, such as ``"listener"``.
        unit_means: comparison of the means of each unit; None unless there are two units or more.
        planned: whether the comparison was planned before the scores were known. Its p values are
            not adjusted; those of all others are adjusted by Holm over the family of the measure.
        p_t, p_w: p values of the t-test and of Wilcoxon's test to be stated.
        family: number of comparisons that the p values are adjusted for.
        left_out: number of items that lack one of the two scores.
    """

    measure: str
    before: str
    after: str
    overall: PairedComparison
    level_before_mean: float
    level_after_mean: float
    by_severity: Mapping[str, PairedComparison]
    unit: str
    unit_means: PairedComparison | None
    left_out: int
    planned: bool = False
    p_t: float | None = None
    p_w: float | None = None
    family: int = 1

    @property
    def title(self) -> str:
        """Name of the measure in tables."""
        return title_of(self.measure)

    @property
    def level_change(self) -> float:
        """Change of the mean output level in dB; NaN if levels are not known."""
        return self.level_after_mean - self.level_before_mean

    @property
    def equal_level(self) -> bool:
        """Whether the mean levels are too close to explain a change of the score."""
        return abs(self.level_change) < EQUAL_DB

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON."""
        return asdict(self) | {"in_words": f"{self.in_short()} {self.limits()}"}

    def verdict(self, subject: str = "", rival: str = "") -> str:
        """Say in one sentence how the second condition does against the first.

        Only at equal level is a higher score called better: HASPI rewards gain.

        Args:
            subject, rival: names of the second and the first condition at the start of a sentence
                and in it; by default the conditions' own.
        """
        subject, rival = subject or self.after, rival or self.before
        c = self.overall
        higher = c.delta > 0
        significant = self._significant()
        if not any(significant):
            text = f"{subject} cannot be distinguished from {rival}"
        elif self.equal_level:
            verb = "is" if all(significant) else "may be"
            text = f"{subject} {verb} {'better' if higher else 'worse'} than {rival}"
        else:
            verb = "scores" if all(significant) else "may score"
            text = f"{subject} {verb} {'higher' if higher else 'lower'} than {rival}"
        if abs(self.level_change) >= EQUAL_DB:
            direction = "softer" if self.level_change > 0 else "louder"
            text += f", which is {abs(self.level_change):.1f} dB {direction}"
        return f"{text}: {self.title} {c.after_mean:.3f} against {c.before_mean:.3f} ({self._facts()})."

    def in_short(self) -> str:
        """Say how much the score changed, and whether chance explains it."""
        return f"{self._change()} {self._chance()}"

    def limits(self) -> str:
        """Say what the scores do not show."""
        return f"{self._about_level()} {self._about_units()} {self._about_reach()}"

    def _facts(self) -> str:
        c = self.overall
        facts = [_items(c.n), f"change {c.delta:+.3f}"]
        if c.ci_low is not None:
            facts.append(f"95 % interval {c.ci_low:+.3f} to {c.ci_high:+.3f}")
        return f"{', '.join(facts)}; {self._tests()}"

    def _tests(self) -> str:
        """State the p values, the same ones wherever the comparison appears."""
        tests = {"t-test": self.p_t, "Wilcoxon": self.p_w}
        stated = [f"{name} {p_text(p)}" for name, p in tests.items() if p is not None]
        if not stated:
            return "neither test is defined"
        if self.planned:
            stated.append("planned comparison, not adjusted")
        elif self.family > 1:
            stated.append(f"adjusted by Holm for {self.family} comparisons")
        return ", ".join(stated)

    def _change(self) -> str:
        c = self.overall
        change = f"{'rose' if c.delta > 0 else 'fell'} by {abs(c.delta):.3f}"
        if c.delta == 0.0:
            change = "did not change"
        elif abs(c.delta) < 0.0005:
            change = "changed by less than 0.001"
        facts = _items(c.n)
        if c.ci_low is not None:
            facts += f"; 95 % bootstrap interval of the change: {c.ci_low:+.3f} to {c.ci_high:+.3f}"
        text = f"From {self.before} to {self.after}, mean {self.title} {change} ({facts})."
        if self.left_out:
            text += f" {_items(self.left_out)} without both scores are left out."
        return text

    def _chance(self) -> str:
        significant = self._significant()
        if self.p_t is None and self.p_w is None:
            return "Neither test is defined for these scores, so this may be chance."
        if significant and all(significant):
            return f"Chance is an unlikely explanation ({self._tests()})."
        if any(significant):
            return f"The tests disagree on whether this may be chance ({self._tests()})."
        few = "" if self._wilcoxon_can() else " With so few items Wilcoxon's test cannot decide."
        return f"This may be chance ({self._tests()}), which does not show that the two are equal.{few}"

    def _significant(self) -> list[bool]:
        """Return for each test that can decide whether its p value is below ``ALPHA``."""
        decisions = [] if self.p_t is None else [self.p_t < ALPHA]
        if self.p_w is not None and self._wilcoxon_can():
            decisions.append(self.p_w < ALPHA)
        return decisions

    def _wilcoxon_can(self) -> bool:
        """Return whether Wilcoxon's p is below ``ALPHA``, or would be if all pairs changed alike."""
        c = self.overall
        if c.p_w is None or (self.p_w is not None and self.p_w < ALPHA):
            return True
        lowest = 2.0 ** (1 - (c.n - c.zeros))
        return self.family * lowest < ALPHA

    def _about_level(self) -> str:
        measure, change = MEASURES.get(self.measure), self.overall.delta
        if measure is None or not measure.knows_hearing:
            return f"{self.title} rates the output itself and does not know the hearing loss."
        if self.equal_level:
            return (
                f"The mean level changed by only {self.level_change:+.1f} dB, so that gain does not "
                "explain it."
            )
        louder = self.level_change > 0
        moved = f"The level {'rose' if louder else 'fell'} by {abs(self.level_change):.1f} dB"
        if not measure.rewards_gain:
            return f"{moved}, which changes {self.title} too: how much is not known."
        if change and (change > 0) != louder:
            return f"{moved}, so that gain does not explain a {'rise' if change > 0 else 'fall'}."
        alone = "more" if louder else "less"
        return f"{moved}, and {self.title} rewards gain: {alone} gain alone may explain the change."

    def _about_units(self) -> str:
        means = self.unit_means
        if means is None:
            return (
                "The tests treat items as independent. If several share a talker or a listener, p is "
                "too small and the interval too narrow."
            )
        return (
            "The interval and the tests treat items as independent, although several share one "
            f"{self.unit}; the t-test over the means of the {means.n} {self.unit}s "
            + ("is not defined." if means.p_t is None else f"gives {p_text(means.p_t)}.")
        )

    def _about_reach(self) -> str:
        return (
            f"{self.title} is the prediction of a model: no listener was asked, and other speech and "
            "other ears may give other results."
        )


def compare(
    table: DataFrame,
    measures: Sequence[str],
    *,
    baseline: str | None = None,
    planned: Collection[Pair] = (),
    unit: str = "listener",
) -> list[Comparison]:
    """Compare the conditions of a study, each with every earlier one.

    Args:
        table: table that ``run_study`` returns.
        measures: columns of scores.
        baseline: the condition that all others are compared with, in place of every earlier one.
        planned: comparisons that were planned before the scores were known. They stay outside the
            family of a measure, whose p values are adjusted by Holm.
        unit: column that says what items are nested in.

    Returns: the comparisons of each measure; a pair of conditions that no item has both scores of is
        left out.
    """
    conditions = list(dict.fromkeys(table["condition"]))
    pairs = list(combinations(conditions, 2))
    if baseline is not None:
        pairs = [(baseline, other) for other in conditions if other != baseline]
    comparisons = []
    for measure in measures:
        columns = [column for column in (measure, "level") if column in table]
        if measure not in columns:
            continue
        wide = table.pivot(index="item", columns="condition", values=columns)
        units = table.drop_duplicates("item").set_index("item")
        found = [_compare_pair(wide, units, measure, *pair, unit) for pair in pairs]
        comparisons += _with_p_values([c for c in found if c is not None], planned)
    return comparisons


def _with_p_values(found: Sequence[Comparison], planned: Collection[Pair]) -> list[Comparison]:
    """Add the p values to be stated: as they are for planned comparisons, adjusted for all others."""
    family = [c for c in found if (c.measure, c.before, c.after) not in planned]
    p_t = holm(c.overall.p_t for c in family)
    p_w = holm(c.overall.p_w for c in family)
    adjusted = {
        (c.before, c.after): replace(c, p_t=t, p_w=w, family=len(family))
        for c, t, w in zip(family, p_t, p_w, strict=True)
    }
    return [
        adjusted.get((c.before, c.after))
        or replace(c, p_t=c.overall.p_t, p_w=c.overall.p_w, planned=len(found) > 1)
        for c in found
    ]


def _compare_pair(
    wide: DataFrame, units: DataFrame, measure: str, before: str, after: str, unit: str
) -> Comparison | None:
    scores = wide[measure].reindex(columns=[before, after])
    both = scores.dropna()
    if both.empty:
        return None
    first, second = both[before].to_numpy(float), both[after].to_numpy(float)
    facts = units.loc[both.index]
    levels = [float("nan")] * 2
    if "level" in wide:
        of_both = wide["level"].loc[both.index]
        levels = [math.fsum(of_both[name]) / len(both) for name in (before, after)]
    by_severity = {}
    if "severity" in facts:
        severities = facts["severity"].to_numpy()
        by_severity = {
            name: paired_comparison(first[severities == name], second[severities == name])
            for name in SEVERITIES
            if name in severities
        }
    return Comparison(
        measure=measure,
        before=before,
        after=after,
        overall=paired_comparison(first, second),
        level_before_mean=levels[0],
        level_after_mean=levels[1],
        by_severity=by_severity,
        unit=unit,
        unit_means=_compare_units(facts[unit].to_numpy(), first, second) if unit in facts else None,
        left_out=len(scores) - len(both),
    )


def _compare_units(
    units: np.ndarray, first: np.ndarray, second: np.ndarray
) -> PairedComparison | None:
    """Compare the means of each unit; None if some have no name, or there are fewer than two."""
    names = list(dict.fromkeys(units))
    if not all(units) or len(names) < 2:
        return None
    means = [[scores[units == name].mean() for name in names] for scores in (first, second)]
    return paired_comparison(*means)


def p_text(p: float) -> str:
    """Return a p value as text, with five decimals."""
    return "p < 0.00001" if p < 1e-5 else f"p = {p:.5f}"


def _items(count: int) -> str:
    return "1 item" if count == 1 else f"{count} items"
