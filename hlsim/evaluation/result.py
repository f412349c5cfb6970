"""An evaluation: results of a study, with its table, comparisons and settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.evaluation.comparison import ConditionComparison
from hlsim.evaluation.running.store import ScoreStore
from hlsim.evaluation.study import Condition, ItemSource, Measure, run_measures
from hlsim.metrics.words import WordsChange, words_change

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True)
class ItemSounds:
    """Sounds of one item, in pascals.

    Attributes:
        name: Name of the item, with facts for the heading of its player.
        ear: Audiogram of the ear.
        sample_rate: Sample rate in Hz.
        groups: Signals as a dict from the heading of a group, which may be empty, to a dict from
            label to signal. Shape of each signal: (time,).
        failures: Reason why there is no sound, by label.

    >>> import torch
    >>> signals = {"tone": torch.ones(8)}
    >>> ItemSounds("s01", Audiogram.standard("N3"), 16000, {"": signals}).failures
    {}
    """

    name: str
    ear: Audiogram
    sample_rate: int
    groups: Mapping[str, Mapping[str, Tensor]]
    failures: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Evaluation:
    """Results of a study, with all that a page or a JSON file shows.

    Attributes:
        items: Items of the study: speech, the input of the aid, and an audiogram each.
        conditions: Conditions that process every item, such as hearing aids.
        measures: Measures that score every output.
        table: Table with one row per item and condition, see ``run_study``.
        comparisons: Comparisons of two conditions by one measure each, see ``compare``.
        settings: Settings of the study, such as the seed, each under its name. They are written to
            ``report.json``.
        notes: Sentences for the first section of the page.
        details: Further results for ``report.json`` and the page, such as gain curves, each under
            its name.
        groups: Evaluations of parts of the items, such as noisy speech, by the name of the part.
        sounds: Sounds of some items, for the players of a page.

    >>> import pandas
    >>> table = pandas.DataFrame({"item": [0], "condition": ["aid"], "haspi": [0.5]})
    >>> Evaluation([], [Condition("aid")], [], table).wide("haspi")["aid"].tolist()
    [0.5]
    """

    items: Sequence[ItemSource]
    conditions: Sequence[Condition]
    measures: Sequence[Measure]
    table: DataFrame
    comparisons: Sequence[ConditionComparison] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    groups: Mapping[str, Evaluation] = field(default_factory=dict)
    sounds: Sequence[ItemSounds] = ()

    @classmethod
    def run(
        cls,
        items: Sequence[ItemSource],
        conditions: Sequence[Condition],
        measures: Sequence[Measure],
        *,
        store: str | Path | None,
        settings: Mapping[str, Any],
        required: Sequence[str] = (),
        **running: Any,
    ) -> Evaluation:
        """Score every output of a study, and return its evaluation without statistical tests.

        Args:
            items: Items of the study: speech, the input of the aid, and an audiogram each.
            conditions: Conditions that process every item, such as hearing aids.
            measures: Measures that score every output.
            store: File to which scores are written as they become known, and from which a repeated
                run reads them; None stores nothing.
            settings: Settings to record in the evaluation, such as the seed, each under its name.
                This method does not use them.
            required: Columns of the table without which the study has no result.
            running: Arguments ``jobs``, ``dask`` and ``progress`` of ``run_study``.

        Raises:
            ValueError: No output could be scored, a required column has no value, or an argument is
                not valid, see ``run_study``.
            OSError: The store cannot be read.
            MissingExtraError: A package is not installed.
        """
        table, measures = run_measures(items, conditions, measures, ScoreStore(store), **running)
        evaluation = cls(items, conditions, measures, table, settings=settings)
        for column in required:
            evaluation.check_values([column], f"has a value of {column}")
        evaluation.check_values(evaluation.scores)
        return evaluation

    def check_values(self, columns: Sequence[str], predicate: str = "could be scored") -> None:
        """Raise ValueError if the table has not a single value in the listed columns.

        Args:
            columns: Names of the columns. A column that the table lacks has no values.
            predicate: Predicate of the sentence that begins with "none of 5 items", if there are
                failures. The message also has the reason of the first one.
        """
        if not self.table.reindex(columns=columns).isna().all(axis=None):
            return
        if self.failures.empty:
            raise ValueError("the measures returned no score; return one or more numbers")
        first = self.failures.iloc[0]
        raise ValueError(
            f"none of {self.table['item'].nunique()} items {predicate}; the first, "
            f"{first['name']} under {first['condition']}: {first['failure']}"
        )

    @property
    def names(self) -> list[str]:
        """Names of the conditions, in their order."""
        return [condition.name for condition in self.conditions]

    @property
    def aids(self) -> list[str]:
        """Names of the conditions of the kind ``aid``: the aids under test.

        Conditions of other kinds, such as ``unaided``, are those that the aids are compared with.
        """
        return [condition.name for condition in self.conditions if condition.kind == "aid"]

    @property
    def scores(self) -> list[str]:
        """Names of the table's columns with scores, in the order of the measures."""
        columns = [column for measure in self.measures for column in measure.scores or ()]
        return [column for column in columns if column in self.table]

    @property
    def headline(self) -> ConditionComparison | None:
        """Comparison with which a page begins: the first planned one, or else the first one.

        It is None if there is no comparison.
        """
        planned = [comparison for comparison in self.comparisons if comparison.planned]
        return next(iter([*planned, *self.comparisons]), None)

    @property
    def failures(self) -> DataFrame:
        """Rows of the table that lack values; the column ``failure`` has the reason."""
        return self.table[self.table["failure"].notna()]

    @property
    def versions(self) -> dict[str, str]:
        """Installed versions of hlsim, SciPy and the packages that the measures use, by name."""
        packages = {package for measure in self.measures for package in measure.packages}
        names = ["hlsim", *sorted(packages | {"scipy"})]
        return {name: metadata.version(name) for name in names}

    def wide(self, column: str) -> DataFrame:
        """Return a column of the table, such as ``"haspi"``, with one column per condition.

        The result has one row per item, and NaN where a value is missing.

        Raises:
            KeyError: There is no such column.
        """
        table = self.table.pivot(index="item", columns="condition", values=column)
        return table.reindex(columns=self.names)

    def words(self, before: str, after: str) -> WordsChange:
        """Predict from HASPI which share of words a new listener understands under two conditions.

        Only items with HASPI under both conditions are used.

        Args:
            before, after: Names of the conditions, which may be the same.

        Returns:
            Mean shares of words, 0 to 1, and their difference, with the interval in which it lies
            for 90 % of new listeners.

        Raises:
            ValueError: No item has both scores.
            KeyError: The table lacks HASPI, or there is no such condition.
        """
        scores = self.wide("haspi").dropna(subset=[before, after]).clip(0.0, 1.0)
        return words_change(scores[before].to_numpy(), scores[after].to_numpy())

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``report.json``, with None in place of NaN and infinity.

        The keys are ``settings``, ``versions`` and ``notes`` (the attributes), ``conditions``,
        ``comparisons``, ``groups`` (a list of comparisons for each part of the items), the keys of
        ``details``, and ``rows``, one dict per row of ``table``.
        """
        fields = ("name", "kind", "of")
        conditions = [{name: getattr(c, name) for name in fields} for c in self.conditions]
        groups = {name: list(map(asdict, group.comparisons)) for name, group in self.groups.items()}
        contents = {
            "settings": self.settings,
            "versions": self.versions,
            "notes": self.notes,
            "conditions": conditions,
            "comparisons": list(map(asdict, self.comparisons)),
            "groups": groups,
            **self.details,
            "rows": self.table.to_dict("records"),
        }
        return _replace_nonfinite(contents)


def _replace_nonfinite(value: Any) -> Any:
    """Return a copy of nested dicts and lists with None in place of Python's NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: _replace_nonfinite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_replace_nonfinite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
