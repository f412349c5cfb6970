"""Items from folders or a manifest, scored under two conditions or more, and what the scores come to."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hlsim.audiogram import Audiogram
from hlsim.calibration import check_full_scale
from hlsim.evaluation.previous.comparison import Comparison, compare_conditions
from hlsim.evaluation.previous.inputs import read_folders, read_manifest
from hlsim.evaluation.previous.scores import Failure, ItemScore, better_ears, check_both_ears
from hlsim.evaluation.previous.scoring import FileItem, Result, score_items
from hlsim.evaluation.statistics import RESAMPLES, PairedComparison
from hlsim.evaluation.store import ScoreStore
from hlsim.extras import require
from hlsim.metrics.registry import MeasureName, check_measures, version_of, versions_of
from hlsim.metrics.words import WordsChange, words_change

_OF_ITEM = ("audiogram", "listener", "ear", "snr", "clean", "processed")

GAIN_NOTE = (
    "HASPI rewards any gain, however loud, so the output level stands beside it: a higher score at a much higher level "
    "may be no more than amplification."
)


@dataclass(frozen=True)
class HaspiReport:
    """Scores of the same items under two conditions or more; the headline compares the last condition with the first.

    Args:
        items: at least one with scores.
        measures: their names, the headline's first; by default those of the first item's scores.
        seed: of the whole; each item has its own.
        failures: scores that could not be made.
        baseline: the first condition, where all others are to be compared with it alone; by default every later one is
            with every earlier one.
        extra: further keys for ``report.json`` beside the others, such as ``nalr_mean``; what JSON can hold.
        unit: what the items' listeners are called in sentences, such as ``ears``.
        ears: where the items are the better ears', each ear's.

    Attributes:
        conditions: their names, in order, from the items' levels.
        comparisons: every pair of conditions by every measure, the headline among them.
        comparison: the headline's figures over all items.
        clean_level_mean, before_level_mean, after_level_mean: in dB SPL, before and after of the headline.
        full_scale_spl: level in dB SPL that RMS 1.0 was taken as; None where the items differ, as by ``spl``.
        note: what is to be known before the figures: that HASPI rewards gain, where it is among the measures.
        severities: each item's degree of loss.
        words: where the headline is HASPI's, what it says of the words that a listener would understand; else None.

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
    ears: Sequence[ItemScore] = ()
    conditions: Sequence[str] = field(init=False)
    comparisons: Sequence[Comparison] = field(init=False)
    headline: Comparison = field(init=False)
    comparison: PairedComparison = field(init=False)
    clean_level_mean: float = field(init=False)
    before_level_mean: float = field(init=False)
    after_level_mean: float = field(init=False)
    full_scale_spl: float | None = field(init=False)
    note: str = field(init=False)
    severities: Sequence[str] = field(init=False)
    words: WordsChange | None = field(init=False)

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
        scales = {item.full_scale_spl for item in self.items}
        vars(self).update(  # of a frozen dataclass
            conditions=conditions,
            measures=measures,
            comparisons=comparisons,
            headline=headline,
            comparison=headline.overall,
            clean_level_mean=math.fsum(item.clean_level for item in self.items) / len(self.items),
            before_level_mean=headline.level_before_mean,
            after_level_mean=headline.level_after_mean,
            full_scale_spl=scales.pop() if len(scales) == 1 else None,
            note=GAIN_NOTE if "haspi" in measures else "",
            severities=[item.severity for item in self.items],
            words=self._words(*ends),
        )
        taken = sorted(set(self._own()) & set(self.extra))
        if taken:
            raise ValueError(
                f"extra keys {', '.join(taken)} are the report's own; allowed: other names"
            )

    def _words(self, measure: str, before: str, after: str) -> WordsChange | None:
        if measure != "haspi":
            return None
        scores = [item.scores.get(measure, {}) for item in self.items]
        both = [found for found in scores if {before, after} <= found.keys()]
        # a score may end a little above 1
        first, second = (
            np.clip([found[name] for found in both], 0.0, 1.0) for name in (before, after)
        )
        return words_change(first, second)

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages that the scores depend on."""
        used = versions_of(self.measures)
        return {"hlsim": version_of("hlsim"), **used, "scipy": version_of("scipy")}

    def scores(self, measure: str, conditions: Sequence[str] | None = None) -> np.ndarray:
        """Scores by item and condition (all of them by default), NaN where there is none. Shape: (items, conditions)."""
        return self._array([item.scores.get(measure, {}) for item in self.items], conditions)

    def levels(self, conditions: Sequence[str] | None = None) -> np.ndarray:
        """Levels in dB SPL, as ``scores``."""
        return self._array([item.levels for item in self.items], conditions)

    def _array(
        self, rows: Sequence[Mapping[str, Any]], conditions: Sequence[str] | None
    ) -> np.ndarray:
        names = self.conditions if conditions is None else conditions
        # None becomes NaN
        return np.array([[row.get(name) for name in names] for row in rows], dtype=np.float64)

    @property
    def table(self) -> Any:
        """For pandas: a row an item and condition, its level (dB SPL) and a column a measure; NaN without a score."""
        facts = (
            "file",
            "listener",
            "ear",
            "severity",
            "snr",
            "clean_level",
            "full_scale_spl",
            "seconds",
            "seed",
        )
        rows = [
            {**{name: getattr(item, name) for name in facts}, "condition": condition}
            for item in self.items
            for condition in self.conditions
        ]
        frame = require("pandas", "eval").DataFrame(rows).astype({"snr": float})
        scores = {measure: self.scores(measure).ravel() for measure in self.measures}
        return frame.assign(level=self.levels().ravel(), **scores)

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold: what ``report.json`` says."""
        return {**self._own(), **self.extra}

    def _own(self) -> dict[str, Any]:
        facts = (
            "full_scale_spl",
            "clean_level_mean",
            "before_level_mean",
            "after_level_mean",
            "seed",
        )
        return {
            **self.comparison.to_dict(),
            "in_words": self.headline.in_words(),
            "words": None if self.words is None else self.words._asdict(),
            "conditions": list(self.conditions),
            "measures": list(self.measures),
            "wilcoxon_zero_method": "wilcox",
            "bootstrap": {"resamples": RESAMPLES, "method": "expanded percentile", "seed": 0},
            **{name: getattr(self, name) for name in (*facts, "versions", "note")},
            "comparisons": [c.to_dict() for c in self.comparisons],
            "failures": [vars(failure).copy() for failure in self.failures],
            "items": [item.to_dict() for item in self.items],
            "ears": [item.to_dict() for item in self.ears],
        }


def haspi_report(
    clean: str | Path | None = None,
    before: str | Path | None = None,
    after: str | Path | None = None,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    manifest: str | Path | None = None,
    root: str | Path | None = None,
    measures: Iterable[MeasureName] = ("haspi",),
    baseline: str | None = None,
    better_ear: bool = False,
    store: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
    seed: int = 0,
    **running: Any,
) -> HaspiReport:
    """HASPI v2 (and HASQI, STOI, PESQ) of speech under two conditions or more, with paired tests and levels.

    Files are taken as they are: one channel for one ear, no change of level, delay or length. Each score is stored as
    it is made, and a run that was stopped goes on where it was. A score that cannot be made (a broken, silent or short
    file) is listed in the report with its reason, and the rest go on.

    Args:
        clean, before, after: folders, see ``read_folders``. Of one name, the three files have one rate and one length.
        audiogram, audiograms: the ear of all files or a CSV file of ears, as in ``read_folders`` and ``read_manifest``.
        manifest, root: in place of the folders, a CSV file with a row a file, see ``hlsim.evaluation.previous.inputs``.
        measures: of ``haspi``, ``hasqi``, ``stoi``, ``pesq``; the first is the headline's.
        baseline: the condition that comes first and that all others are compared with; by default the manifest's first
            comes first, and all are compared with each other.
        better_ear: of a manifest with both ears of each utterance, the better ear's scores are the items'.
        store: file of scores, made where there is none; None keeps them nowhere.
        full_scale_spl: level in dB SPL of a file with RMS 1.0.
        spl: or else the level in dB SPL of every clean file, or of a manifest's rows that bring none; the processed ones
            are on the same scale.
        seed: of the noise that HASPI and HASQI add; each item has one from it.
        running: ``jobs``, ``backend``, ``scheduler`` and ``progress``, as of ``score_items``.

    Raises:
        ValueError: names differ between the folders, a manifest's row is wrong, a file has no audiogram, settings
            contradict each other, an ear lacks, or no item could be scored.
        MissingExtraError: a measure's package, joblib or distributed is not installed.
    """
    names = check_measures(measures)
    check_full_scale(full_scale_spl if spl is None else spl)
    if audiogram is not None and not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; allowed: an Audiogram, one ear of all files"
        )
    ears_and_levels: dict[str, Any] = {
        "audiogram": audiogram,
        "audiograms": audiograms,
        "full_scale_spl": full_scale_spl,
        "spl": spl,
    }
    if manifest is not None and clean is None and before is None and after is None:
        items = read_manifest(manifest, root, **ears_and_levels)
    elif (
        manifest is None
        and root is None
        and clean is not None
        and before is not None
        and after is not None
    ):
        items = read_folders(clean, before, after, **ears_and_levels)
    else:
        raise ValueError(
            "give either the folders clean, before and after, or a manifest (and its root)"
        )
    own: dict[str, Any] = {
        "baseline": baseline,
        "better_ear": better_ear,
        "store": store,
        "seed": seed,
    }
    return report_items(items, names, **own, **running)


def report_items(
    items: Sequence[FileItem],
    measures: Sequence[MeasureName],
    *,
    conditions: Sequence[str] = (),
    baseline: str | None = None,
    better_ear: bool = False,
    store: str | Path | None = None,
    seed: int = 0,
    failures: Sequence[Failure] = (),
    extra: Mapping[str, Any] | None = None,
    **running: Any,
) -> HaspiReport:
    """The report of items that are known already; ``failures`` are told with its own. All else as ``haspi_report``.

    Args:
        conditions: their order, those that no item has included; by default the items' own.
    """
    conditions = list(
        conditions or dict.fromkeys(name for item in items for name in item.processed)
    )
    if len(conditions) < 2:
        raise ValueError(f"one condition only, {conditions[0]}; allowed: two or more to compare")
    if baseline is not None:
        if baseline not in conditions:
            raise ValueError(f"no condition {baseline!r}; allowed: {', '.join(conditions)}")
        conditions = [baseline, *(name for name in conditions if name != baseline)]
    if better_ear:
        check_both_ears((item.name, item.listener, item.ear) for item in items)
    scored = score_items(items, measures, store=ScoreStore(store), seed=seed, **running)
    pairs = [*zip(items, scored, strict=True)]
    unscored = [
        *failures,
        *(
            Failure(item.name, condition, measure, str(result.reason))
            for item, results in pairs
            for (measure, condition), result in results.items()
            if result.score is None
        ),
    ]
    scores = [made for pair in pairs if (made := _item_score(*pair, conditions, measures))]
    if not scores:
        reasons = f"; the first, {unscored[0].file}: {unscored[0].reason}" if unscored else ""
        raise ValueError(f"none of {len(items)} items could be scored{reasons}")
    ears = scores if better_ear else []
    scores = better_ears(scores) if better_ear else scores
    return HaspiReport(scores, measures, seed, unscored, baseline, extra or {}, ears=ears)


def _item_score(
    item: FileItem,
    results: Mapping[tuple[str, str], Result],
    conditions: Sequence[str],
    measures: Sequence[str],
) -> ItemScore | None:
    """None where nothing could be scored."""
    known: dict[tuple[str, str], Any] = {
        key: result for key, result in results.items() if result.score is not None
    }
    if not known:
        return None
    fact = next(iter(known.values()))
    full_scale = item.full_scale(fact.clean_dbfs)
    levels = {condition: result.dbfs + full_scale for (_, condition), result in known.items()}
    return ItemScore(
        file=item.name,
        clean_level=fact.clean_dbfs + full_scale,
        levels=dict.fromkeys(conditions) | levels,
        scores={
            measure: {
                name: known[measure, name].score for name in conditions if (measure, name) in known
            }
            for measure in measures
        },
        full_scale_spl=full_scale,
        **{name: getattr(fact, name) for name in ("sample_rate", "seconds", "seed")},
        **{name: getattr(item, name) for name in _OF_ITEM},
    )
