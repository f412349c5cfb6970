"""Two conditions compared by one measure: overall, by degree of loss, by listener, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.evaluation.statistics import PairedComparison, holm, paired_comparison
from hlsim.metrics.registry import MEASURES

ALPHA = 0.05
"""Below which a p value is said to speak against chance."""

EQUAL_DB = 1.0
"""A smaller change of level is not held to explain a score."""


@dataclass(frozen=True)
class Comparison:
    """A measure under two conditions, of the items that have both.

    Attributes:
        overall: over all items.
        level_before_mean, level_after_mean: dB SPL of what the ear was given, of the same items.
        by_severity: by degree of loss, those that occur.
        listeners: the same tests of the means of each listener; None unless two or more are named.
        p_t_holm, p_w_holm: p values adjusted by Holm over the comparisons of this measure, as many as ``comparisons``.
        unit: what ``listeners`` are called.
        left_out: how many items lack a score under one of the conditions or both.
    """

    measure: str
    before: str
    after: str
    overall: PairedComparison
    level_before_mean: float
    level_after_mean: float
    by_severity: Mapping[str, PairedComparison]
    listeners: PairedComparison | None
    p_t_holm: float | None
    p_w_holm: float | None
    comparisons: int = 1
    unit: str = "listeners"
    left_out: int = 0

    @property
    def title(self) -> str:
        """The measure's name as a table writes it."""
        return MEASURES[self.measure].title

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold."""
        record = asdict(self)
        del record["unit"]
        listeners = record.pop("listeners")
        return {
            **record.pop("overall"),
            **record,
            "listener_means": listeners,
            "in_words": self.in_words(),
        }

    def in_words(self) -> str:
        """What the figures show, and what they do not, in plain sentences."""
        return f"{self.in_short()} {self.limits()}"

    def limits(self) -> str:
        """What the figures do not show."""
        return " ".join((self._level(), self._nesting(), self._reach()))

    def in_short(self) -> str:
        """The change, and whether chance explains it."""
        return f"{self._change()} {self._chance()}"

    def _change(self) -> str:
        c = self.overall
        verb = f"{'rose' if c.delta > 0 else 'fell'} by {abs(c.delta):.3f}"
        if abs(c.delta) < 0.0005:
            verb = "did not change" if c.delta == 0.0 else "changed by less than 0.001"
        facts = "one item" if c.n == 1 else f"{c.n} items"
        if c.ci_low is not None:
            facts += f", 95 % bootstrap interval of the change {c.ci_low:+.3f} to {c.ci_high:+.3f}"
        text = f"From {self.before} to {self.after}, {self.title} {verb} on average ({facts})."
        if self.left_out:
            text += f" Items that lack {self.title} under {self.before} or {self.after} do not count: {self.left_out}."
        return text

    def _chance(self) -> str:
        defined = [
            (n, p)
            for n, p in (("t-test", self.p_t_holm), ("Wilcoxon", self.p_w_holm))
            if p is not None
        ]
        if not defined:
            return "Neither test is defined for these figures, so they do not tell a change from chance."
        named = ", ".join(f"{name} {p_text(p)}" for name, p in defined)
        if self.comparisons > 1:
            named += f", Holm-adjusted for {self.comparisons} comparisons"
        against = [p < ALPHA for name, p in defined if name == "t-test" or self._wilcoxon_can()]
        few = (
            "" if self._wilcoxon_can() else f"; with so few Wilcoxon's cannot fall below {ALPHA:g}"
        )
        if against and all(against):
            return f"Chance alone hardly explains it ({named}{few})."
        if any(against):
            return f"The tests disagree on whether chance explains it ({named})."
        return f"It cannot be told from chance ({named}{few}), which does not show that there is no change."

    @property
    def level_alike(self) -> bool:
        """Whether the mean levels differ by less than what is held to explain a score."""
        return abs(self.level_after_mean - self.level_before_mean) < EQUAL_DB

    def _wilcoxon_can(self) -> bool:
        """Whether its adjusted p is below ``ALPHA``, or would be if all pairs changed the same way."""
        c = self.overall
        if c.p_w is None or (self.p_w_holm is not None and self.p_w_holm < ALPHA):
            return True  # the number of comparisons is only the largest of Holm's factors
        return self.comparisons * 2.0 ** (1 - (c.n - c.zeros)) < ALPHA

    def _level(self) -> str:
        measure, change = MEASURES[self.measure], self.overall.delta
        if not measure.of_an_ear:
            return f"{self.title} knows neither loss nor level: it rates the signal at the ear, not what is heard."
        louder = self.level_after_mean - self.level_before_mean
        if self.level_alike:
            return f"The mean level changed by {louder:+.1f} dB only, so that gain overall does not explain it."
        moved = f"The level {'rose' if louder > 0 else 'fell'} by {abs(louder):.1f} dB"
        if not measure.rewards_gain:
            return f"{moved}, on which {self.title} depends too: the figures do not tell gain from the rest."
        if change and (change > 0) != (louder > 0):
            return f"{moved}, so that gain does not explain a {'rise' if change > 0 else 'fall'}."
        alone = "amplification" if louder > 0 else "attenuation"
        return (
            f"{moved}, and {self.title} rewards gain: the figures do not show how much of the change {alone} alone "
            "would have brought."
        )

    def _nesting(self) -> str:
        if self.listeners is None:
            return (
                "Items are taken as independent: where several share a talker or a listener, p is too small and the "
                "interval too narrow."
            )
        c = self.listeners
        if c.p_t is None:
            return f"Over the means of {c.n} {self.unit} no t-test is defined."
        adjusted = ", not adjusted" if self.comparisons > 1 else ""
        return (
            f"The interval and p take items as independent; over the means of the {c.n} {self.unit} the t-test has "
            f"{p_text(c.p_t)}{adjusted}."
        )

    def _reach(self) -> str:
        return f"{self.title} is a model's prediction: no listener was asked, and other speech and ears may differ."


def compare_conditions(
    items: Sequence[ItemScore],
    measures: Sequence[str],
    conditions: Sequence[str],
    baseline: str | None = None,
    unit: str = "listeners",
) -> list[Comparison]:
    """Every later condition against every earlier one (or against ``baseline`` only) by every measure.

    P values are adjusted by Holm over the comparisons of a measure. A pair that no item has scores of is left out.
    """
    pairs = list(combinations(conditions, 2))
    if baseline is not None:
        pairs = [(baseline, other) for other in conditions if other != baseline]
    out = []
    for measure in measures:
        found = [c for pair in pairs if (c := _compare(items, measure, *pair)) is not None]
        p_t, p_w = holm(c.overall.p_t for c in found), holm(c.overall.p_w for c in found)
        out += [
            replace(c, p_t_holm=t, p_w_holm=w, comparisons=len(found), unit=unit)
            for c, t, w in zip(found, p_t, p_w, strict=True)
        ]
    return out


def p_text(p: float) -> str:
    """A p value as text, with five places."""
    return "p < 0.00001" if p < 1e-5 else f"p = {p:.5f}"


def _compare(
    items: Sequence[ItemScore], measure: str, before: str, after: str
) -> Comparison | None:
    both = [item for item in items if {before, after} <= item.scores.get(measure, {}).keys()]
    if not both:
        return None
    first, second = (
        np.array([item.scores[measure][condition] for item in both])
        for condition in (before, after)
    )
    severities = np.array([item.severity for item in both])
    listeners, means = np.array([item.listener for item in both]), None
    if all(listeners) and len(names := dict.fromkeys(listeners)) > 1:
        means = paired_comparison(
            *([x[listeners == name].mean() for name in names] for x in (first, second))
        )
    return Comparison(
        measure=measure,
        before=before,
        after=after,
        overall=paired_comparison(first, second),
        # what has a score has a level
        level_before_mean=math.fsum(item.levels[before] or 0.0 for item in both) / len(both),
        level_after_mean=math.fsum(item.levels[after] or 0.0 for item in both) / len(both),
        by_severity={
            name: paired_comparison(first[severities == name], second[severities == name])
            for name in SEVERITIES
            if name in severities
        },
        listeners=means,
        p_t_holm=None,
        p_w_holm=None,
        left_out=len(items) - len(both),
    )
