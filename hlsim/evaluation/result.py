"""Result of an evaluation: the table of its study, the comparisons, and the settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.measures import OTHER_COLUMNS
from hlsim.evaluation.store import ScoreStore
from hlsim.evaluation.study import Condition, Measure, Source, run_study, versions_of

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True)
class Evaluation:
    """A finished study.

    Attributes:
        items, conditions, measures: the three inputs of ``run_study``.
        table: one row per item and condition, see ``run_study``.
        comparisons: comparisons of the conditions, see ``compare``.
        settings: settings on which the values depend, such as the seed.
        notes: sentences that the report begins with.
        details: further results for JSON, such as gain curves.
        groups: the same evaluation of a part of the items, by the name of the part.
    """

    items: Sequence[Source]
    conditions: Sequence[Condition]
    measures: Sequence[Measure]
    table: DataFrame
    comparisons: Sequence[Comparison] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    details: Mapping[str, Any] = field(default_factory=dict)
    groups: Mapping[str, Evaluation] = field(default_factory=dict)

    @classmethod
    def run(
        cls,
        items: Sequence[Source],
        conditions: Sequence[Condition],
        measures: Sequence[Measure],
        *,
        store: str | Path | None,
        settings: Mapping[str, Any],
        **running: Any,
    ) -> Evaluation:
        """Run a study, see ``run_study``; ValueError if nothing could be scored."""
        table = run_study(items, conditions, measures, store=ScoreStore(store), **running)
        evaluation = cls(items, conditions, measures, table, settings=settings)
        if table.reindex(columns=evaluation.scores).isna().all(axis=None):
            first = evaluation.failures.iloc[0]
            raise ValueError(
                f"none of {len(items)} items could be scored; the first, {first['name']} under "
                f"{first['condition']}: {first['failure']}"
            )
        return evaluation

    @property
    def names(self) -> list[str]:
        """Names of the conditions."""
        return [condition.name for condition in self.conditions]

    def of_kind(self, *kinds: str) -> list[str]:
        """Return the names of the conditions of some kinds."""
        return [condition.name for condition in self.conditions if condition.kind in kinds]

    @property
    def scores(self) -> list[str]:
        """Columns of the scores: those of the measures, the first one first, and of plug-ins."""
        named = [measure.name for measure in self.measures if measure.name in self.table]
        facts = self.items[0].facts
        others = {"item", "name", "condition", "failure", *facts, *OTHER_COLUMNS, *named}
        return named + [column for column in self.table.columns if column not in others]

    @property
    def headline(self) -> Comparison | None:
        """The first planned comparison, or the first of all; None if there is none."""
        planned = [c for c in self.comparisons if c.planned]
        return next(iter([*planned, *self.comparisons]), None)

    @property
    def failures(self) -> DataFrame:
        """Rows of the table that lack values."""
        return self.table[self.table["failure"].notna()]

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the packages that the values depend on."""
        packages = [package for measure in self.measures for package in measure.packages]
        return versions_of(["hlsim", *packages, "scipy"])

    def wide(self, column: str) -> DataFrame:
        """Return one column with a row per item and a column per condition."""
        table = self.table.pivot(index="item", columns="condition", values=column)
        return table.reindex(columns=self.names)

    def to_dict(self) -> dict[str, Any]:
        """Return a plain dictionary for JSON, with None for a missing value."""
        groups = {name: group.comparisons for name, group in self.groups.items()}
        values = {
            "settings": self.settings,
            "versions": self.versions,
            "notes": self.notes,
            "conditions": [condition.record() for condition in self.conditions],
            "comparisons": [c.to_dict() for c in self.comparisons],
            "groups": {name: [c.to_dict() for c in found] for name, found in groups.items()},
            **self.details,
            "rows": self.table.to_dict("records"),
        }
        return {name: _without_nan(value) for name, value in values.items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and math.isnan(value) else value
