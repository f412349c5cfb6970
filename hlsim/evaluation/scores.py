"""What a comparison of conditions comes to: scores and levels of every item, and what the statistics make of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.audiogram import Audiogram
from hlsim.evaluation.comparison import Comparison, compare_conditions
from hlsim.evaluation.statistics import RESAMPLES, PairedComparison
from hlsim.extras import require
from hlsim.metrics.registry import version_of, versions_of
from hlsim.report.haspi_text import markdown, opening

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class ItemScore:
    """Scores of one utterance in one ear, with the levels (dB SPL) of what was scored.

    Args:
        file: what it is called.
        levels: of what the ear was given, by condition, in their order; None where a file could not be read.
        scores: by measure and condition; what could not be scored is not in it.
        clean_level: of the clean speech.
        full_scale_spl: level in dB SPL that a file of RMS 1.0 was taken to have.
        seed: of the noise that HASPI and HASQI add, the same under every condition.
        listener, ear: whose ear and which; empty where unknown.
        snr: of the speech in noise in dB, where known.
        clean, processed: files, for players and spectrograms; not part of ``report.json``.

    Raises:
        ValueError: a score under a condition without a level.
    """

    file: str
    audiogram: Audiogram
    clean_level: float
    levels: Mapping[str, float | None]
    scores: Mapping[str, Mapping[str, float]]
    sample_rate: int
    seconds: float
    seed: int
    full_scale_spl: float = 94.0
    listener: str = ""
    ear: str = ""
    snr: float | None = None
    clean: Path | None = None
    processed: Mapping[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for condition in {name for own in self.scores.values() for name in own}:
            if self.levels.get(condition) is None:
                raise ValueError(
                    f"{self.file}: a score under {condition!r} without its level; a score needs one"
                )

    @property
    def before(self) -> float | None:
        """The first measure's score under the first condition; None where there is none."""
        return self._first_measure.get(next(iter(self.levels)))

    @property
    def after(self) -> float | None:
        """The first measure's score under the last condition; None where there is none."""
        return self._first_measure.get(list(self.levels)[-1])

    @property
    def before_level(self) -> float | None:
        """Level of the first condition in dB SPL; None where its file could not be read."""
        return next(iter(self.levels.values()))

    @property
    def after_level(self) -> float | None:
        """Level of the last condition in dB SPL; None where its file could not be read."""
        return list(self.levels.values())[-1]

    @property
    def _first_measure(self) -> Mapping[str, float]:
        return next(iter(self.scores.values()), {})

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold."""
        return {
            "file": self.file,
            "listener": self.listener,
            "ear": self.ear,
            "snr": self.snr,
            "before": self.before,
            "after": self.after,
            "clean_level": self.clean_level,
            "before_level": self.before_level,
            "after_level": self.after_level,
            "scores": {measure: dict(own) for measure, own in self.scores.items()},
            "levels": dict(self.levels),
            "full_scale_spl": self.full_scale_spl,
            "audiogram": self.audiogram.to_dict(),
            "severity": self.audiogram.severity,
            "sample_rate": self.sample_rate,
            "seconds": self.seconds,
            "seed": self.seed,
        }


@dataclass(frozen=True)
class Failure:
    """A score that could not be made, and why."""

    file: str
    condition: str
    measure: str
    reason: str


@dataclass(frozen=True)
class HaspiReport:
    """Scores of the same items under two conditions or more.

    Args:
        items: at least one with scores; the headline compares the last condition with the first.
        measures: names of the measures, the headline's first; by default those of the first item's scores.
        seed: of the whole; each item has its own.
        failures: scores that could not be made.
        baseline: the first condition, where all others are to be compared with it alone; by default every later one is
            with every earlier one.
        extra: further keys for ``report.json`` beside the others, such as ``nalr_mean``; what JSON can hold.
        unit: what the items' listeners are called in sentences, such as ``ears``.

    Attributes:
        conditions: their names, in order, from the items' levels.
        comparisons: every pair of conditions by every measure, the headline among them.
        headline: the last condition against the first, by the first measure.
        comparison: the headline's figures over all items.
        clean_level_mean, before_level_mean, after_level_mean: means in dB SPL, before and after of the headline.

    Raises:
        ValueError: no items, or of unlike conditions, or fewer than two; a baseline that is not the first; a score
            that is not finite, no item with both of the headline's scores, or an extra key that the report has itself.
    """

    items: Sequence[ItemScore]
    measures: Sequence[str] = ()
    seed: int = 0
    failures: Sequence[Failure] = ()
    baseline: str | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    unit: str = "listeners"
    conditions: Sequence[str] = field(init=False)
    comparisons: Sequence[Comparison] = field(init=False)
    headline: Comparison = field(init=False)

    def __post_init__(self) -> None:
        if not self.items:
            raise ValueError("no items; a report needs at least one that has scores")
        conditions = tuple(self.items[0].levels)
        measures = tuple(self.measures) or tuple(self.items[0].scores)
        if len(conditions) < 2 or any(tuple(item.levels) != conditions for item in self.items):
            raise ValueError(
                f"conditions {', '.join(conditions)}; allowed: two or more, the same of every item"
            )
        if self.baseline not in (None, conditions[0]):
            raise ValueError(
                f"baseline is {self.baseline!r}; allowed: the first condition, {conditions[0]!r}"
            )
        comparisons = compare_conditions(self.items, measures, conditions, self.baseline, self.unit)
        ends = (measures[0], conditions[0], conditions[-1])
        headline = next((c for c in comparisons if (c.measure, c.before, c.after) == ends), None)
        if headline is None:
            why = f" ({self.failures[0].reason})" if self.failures else ""
            raise ValueError(f"no item has {measures[0]} under both {ends[1]} and {ends[2]}{why}")
        for name, value in (
            ("conditions", conditions),
            ("measures", measures),
            ("comparisons", comparisons),
            ("headline", headline),
        ):
            object.__setattr__(self, name, value)
        taken = sorted(set(self._own()) & set(self.extra))
        if taken:
            raise ValueError(f"extra keys {', '.join(taken)} are the report's own; allowed: other names")

    @property
    def comparison(self) -> PairedComparison:
        """The headline's figures over all items."""
        return self.headline.overall

    @property
    def clean_level_mean(self) -> float:
        """Mean level of the clean speech in dB SPL."""
        return math.fsum(item.clean_level for item in self.items) / len(self.items)

    @property
    def before_level_mean(self) -> float:
        """Mean level of the headline's first condition in dB SPL."""
        return self.headline.level_before_mean

    @property
    def after_level_mean(self) -> float:
        """Mean level of the headline's second condition in dB SPL."""
        return self.headline.level_after_mean

    @property
    def full_scale_spl(self) -> float | None:
        """Level in dB SPL that RMS 1.0 was taken as; None where the items differ, as where ``spl`` was given."""
        levels = {item.full_scale_spl for item in self.items}
        return levels.pop() if len(levels) == 1 else None

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages that the scores depend on."""
        return {"hlsim": version_of("hlsim"), **versions_of(self.measures), "scipy": version_of("scipy")}

    @property
    def table(self) -> pandas.DataFrame:
        """A row an item and condition, with its level (dB SPL) and a column a measure; NaN where there is no score.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        rows = [
            {
                "file": item.file,
                "listener": item.listener,
                "ear": item.ear,
                "condition": condition,
                "severity": item.audiogram.severity,
                "snr": math.nan if item.snr is None else item.snr,
                "clean_level": item.clean_level,
                "level": math.nan if item.levels[condition] is None else item.levels[condition],
                "full_scale_spl": item.full_scale_spl,
                "seconds": item.seconds,
                "seed": item.seed,
                **{name: item.scores.get(name, {}).get(condition, math.nan) for name in self.measures},
            }
            for item in self.items
            for condition in self.conditions
        ]
        frame: pandas.DataFrame = require("pandas", "eval").DataFrame(rows)
        return frame

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold: what ``report.json`` says."""
        return {**self._own(), **self.extra}

    def to_markdown(self) -> str:
        """What ``report.md`` says."""
        return markdown(self)

    def _own(self) -> dict[str, Any]:
        return {
            **self.comparison.to_dict(),
            "in_words": self.headline.in_words(),
            "conditions": list(self.conditions),
            "measures": list(self.measures),
            "wilcoxon_zero_method": "wilcox",
            "bootstrap": {"resamples": RESAMPLES, "method": "expanded percentile", "seed": 0},
            "full_scale_spl": self.full_scale_spl,
            "clean_level_mean": self.clean_level_mean,
            "before_level_mean": self.before_level_mean,
            "after_level_mean": self.after_level_mean,
            "seed": self.seed,
            "versions": self.versions,
            "note": " ".join(opening(self)),
            "comparisons": [c.to_dict() for c in self.comparisons],
            "failures": [vars(failure).copy() for failure in self.failures],
            "items": [item.to_dict() for item in self.items],
        }
