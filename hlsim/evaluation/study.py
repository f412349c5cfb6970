"""A study: items, conditions and measures in, one table out.

Every evaluation in hlsim is a study. ``haspi-report``, ``evaluate-compensator``,
``evaluate-simulator``, ``clarity`` and the demo differ in their items (files, drawn clips, scenes),
their conditions (recorded files, hearing aids, simulators) and their measures, and in nothing else.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import metadata
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_waveform, loud_outputs
from hlsim.evaluation.fingerprint import combined_fingerprint, fingerprint, samples_hash
from hlsim.evaluation.parallel import Progress, describe_error, one_thread, run_parallel
from hlsim.evaluation.store import ScoreStore, settings_hash
from hlsim.extras import require
from hlsim.metrics.pair import common_length
from hlsim.neuro.config import NEURO_RATE
from hlsim.version import __version__

if TYPE_CHECKING:
    from pandas import DataFrame

Values = Mapping[str, float | str]
"""Values by the name of their column."""

DEAD_PROCESS = "its process ended (after a crash in compiled code, or because memory ran out)"


class Source(Protocol):
    """Source of an item: memory, as ``Item`` itself, or files.

    >>> source: Source = Item("item 1", torch.ones(8), torch.ones(8), Audiogram.standard("N3"))
    >>> source.load().name
    'item 1'
    """

    @property
    def name(self) -> str: ...

    @property
    def facts(self) -> Mapping[str, Any]: ...

    def digest(self, condition: str) -> str:
        """Return a SHA-256 of the item and of a condition's output, if that is recorded."""

    def load(self) -> Item: ...


@dataclass(frozen=True)
class Item:
    """One signal for one ear.

    Args:
        name: Name in tables.
        clean: Clean speech, the reference of measures.
        signal: Input of the conditions.
        ear: The audiogram.
        sample_rate: Rate in Hz.
        full_scale_spl: Level in dB SPL of a signal with RMS 1.0.
        seed: Seed of random numbers that a measure draws.
        facts: Columns of the table, such as ``listener`` or ``snr``.
        recorded: Functions that read recorded outputs, by the name of their condition.

    Shape: (time,).

    >>> clean = torch.ones(8)
    >>> Item("item 1", clean, clean, Audiogram.standard("N3")).sample_rate
    16000
    """

    name: str
    clean: Tensor
    signal: Tensor
    ear: Audiogram
    sample_rate: int = NEURO_RATE
    full_scale_spl: float = PASCAL_SPL
    seed: int = 0
    facts: Mapping[str, Any] = field(default_factory=dict)
    recorded: Mapping[str, Callable[[], Tensor]] = field(default_factory=dict)
    _computed: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def load(self) -> Item:
        """Return a copy of the item without the values that ``once`` has computed for it."""
        return replace(self)

    def digest(self, condition: str) -> str:
        """Return the SHA-256 of samples, ear, rate, level and seed."""
        samples = samples_hash(self.clean, self.signal)
        settings = [self.sample_rate, self.full_scale_spl, self.seed]
        return settings_hash({"samples": samples, "ear": self.ear.to_dict(), "settings": settings})

    def once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return the result of ``compute``, which runs once per item.

        All conditions share such a result, for example a reference.
        """
        if name not in self._computed:
            self._computed[name] = compute()
        return self._computed[name]


@dataclass(frozen=True)
class Condition:
    """One way of processing an item.

    Args:
        name: Name in tables.
        process: Function of an input and an ear that returns an output of the same shape; None if
            the outputs were recorded.
        kind: Role in the study, such as ``"unaided"``, ``"aid"`` or ``"equaliser"``.
        of: Name of the condition to which this one belongs, such as the aid whose level it has.
        rivals: Names of the conditions with which this one is compared, most important first.

    >>> Condition("unaided", lambda signal, ear: signal, "unaided").of
    ''
    """

    name: str
    process: Callable[[Tensor, Any], Tensor] | None = None
    kind: str = "aid"
    of: str = ""
    rivals: Sequence[str] = ()

    @cached_property
    def fingerprint(self) -> str | None:
        """Fingerprint of the processing. If it is None, unknown, scores are not stored."""
        return "recorded" if self.process is None else fingerprint(self.process)

    def output(self, item: Item) -> Tensor:
        """Process an item, or read its recorded output."""
        if self.process is not None:
            return self.process(item.signal, item.ear)
        if self.name not in item.recorded:
            raise ValueError(f"no output of {item.name} is recorded under {self.name}")
        return item.recorded[self.name]()


@dataclass(frozen=True)
class Measure:
    """A function of an item and an output, and its properties.

    Args:
        name: Name in options and files. The column of a score has the same name.
        compute: Function that returns values by column, or raises ValueError if there are none.
        title: Name in tables and plots.
        packages: Packages whose versions decide the values.
        revision: Number to be increased when a change of hlsim changes a value.
        settings: Fingerprint of other settings that decide the values, such as a teacher; None if
            it is unknown.
        knows_hearing: Whether the values depend on audiogram and level.
        rewards_gain: Whether a higher level alone increases the score.
        ends: Lowest and highest score, for the axes of plots.

    >>> Measure("peak", lambda item, output: {"peak": float(output.abs().max())}).revision
    1
    """

    name: str
    compute: Callable[[Item, Tensor], Values]
    title: str = ""
    packages: Sequence[str] = ()
    revision: int = 1
    settings: str | None = ""
    knows_hearing: bool = False
    rewards_gain: bool = False
    ends: tuple[float, float] | None = None

    @cached_property
    def fingerprint(self) -> str | None:
        """Fingerprint of revision, versions and settings; None if the settings are unknown."""
        versions = str(installed_versions(self.packages))
        return combined_fingerprint(str(self.revision), versions, self.settings)


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the installed version of each package.

    >>> sorted(installed_versions(["hlsim", "no-such-package"]))
    ['hlsim', 'no-such-package']
    """
    versions = {}
    for package in dict.fromkeys(packages):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
        if package == "hlsim":  # which may run from its sources
            versions[package] = __version__
    return versions


class _Task(NamedTuple):
    """One item with the conditions and measures that are still missing."""

    number: int
    source: Source
    missing: list[tuple[Condition, Measure]]


def run_study(
    items: Sequence[Source],
    conditions: Sequence[Condition],
    measures: Sequence[Measure],
    *,
    store: ScoreStore | None = None,
    jobs: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> DataFrame:
    """Measure the output of every condition for every item.

    Items are measured in parallel, and the values do not depend on the number of processes. An
    error ends only the measure, output or item in which it occurs. It becomes the reason in the
    column ``failure``, and a later run tries again.

    Args:
        items: Items, or sources that load them.
        conditions: Conditions.
        measures: Measures.
        store: Values of earlier runs, to which new ones are added. A value is computed again only
            if samples, ear, condition or measure have changed.
        jobs: Number of processes; all cores by default.
        dask: Address of a Dask scheduler, whose workers replace the processes.
        progress: Function that is called with the number of finished values and of all values.

    Returns:
        One row per item and condition: ``item`` (its number), ``name``, the item's facts,
        ``condition``, one column per measured value, and ``failure``, which is missing if every
        measure has its values.

    Raises:
        ValueError: No scheduler answers, or the store cannot be written.
        MissingExtraError: A package is not installed.

    >>> signal = torch.ones(1600)
    >>> items = [Item("item 1", signal, signal, Audiogram.standard("N3"))]
    >>> conditions = [Condition("unaided", lambda signal, ear: signal)]
    >>> measures = [Measure("peak", lambda item, output: {"peak": float(output.abs().max())})]
    >>> with warnings.catch_warnings(action="ignore"):  # a lambda has no fingerprint
    ...     table = run_study(items, conditions, measures, jobs=1)
    >>> table["peak"].tolist()
    [1.0]
    """
    store = ScoreStore() if store is None else store
    show = progress or (lambda done, total: None)
    _warn_of_unknown_fingerprints([*conditions, *measures])
    results: dict[tuple[int, str, str], Values | str] = {}
    keys: dict[tuple[int, str, str], str] = {}
    tasks = []
    for number, source in enumerate(items):
        missing = []
        for condition in conditions:
            digest = _digest(source, condition)
            for measure in measures:
                key = _key(digest, condition, measure)
                record = store.get(key)
                if record is None:
                    missing.append((condition, measure))
                    keys[number, condition.name, measure.name] = key
                else:
                    results[number, condition.name, measure.name] = record["values"]
        if missing:
            tasks.append(_Task(number, source, missing))
    total = len(items) * len(conditions) * len(measures)
    show(len(results), total)
    for task, measured in run_parallel(_measure_item, tasks, jobs=jobs, dask=dask):
        if measured is None:
            measured = [DEAD_PROCESS] * len(task.missing)
        for (condition, measure), values in zip(task.missing, measured, strict=True):
            place = task.number, condition.name, measure.name
            results[place] = values
            if keys[place] and not isinstance(values, str):
                names = {"item": task.source.name, "condition": place[1], "measure": place[2]}
                store.append(keys[place], {**names, "values": values})
        show(len(results), total)
    return _make_table(items, conditions, measures, results)


def _digest(source: Source, condition: Condition) -> str | None:
    try:
        return source.digest(condition.name)
    except ValueError:  # Loading the item or its output fails later for the same reason.
        return None


def _key(digest: str | None, condition: Condition, measure: Measure) -> str:
    """Return the key of stored values, which is empty if they cannot be stored."""
    parts = (digest, condition.fingerprint, measure.fingerprint)
    return "" if None in parts else settings_hash({"value": [*parts, measure.name]})


def _warn_of_unknown_fingerprints(parts: Sequence[Condition | Measure]) -> None:
    unknown = [part.name for part in parts if part.fingerprint is None]
    if unknown:
        warnings.warn(
            f"scores with {', '.join(unknown)} are not stored and will be computed again by the "
            "next run; to store them, add an attribute fingerprint, such as a version, to the "
            "object that computes them",
            stacklevel=3,
        )


@one_thread()
@torch.no_grad()
def _measure_item(task: _Task) -> list[Values | str]:
    """Compute the missing values of one item; a failure gives its reason instead."""
    try:
        item = task.source.load()
        check_waveform(item.clean, "clean speech", full_scale_spl=item.full_scale_spl)
    except Exception as error:  # A failure must not end the study.
        return [describe_error(error)] * len(task.missing)
    results: list[Values | str] = []
    pairs: dict[str, tuple[Item, Tensor]] = {}
    for condition, measure in task.missing:
        try:
            if condition.name not in pairs:
                pairs[condition.name] = _item_and_output(condition, item)
            with loud_outputs():
                values = measure.compute(*pairs[condition.name])
            _check_finite(values)
            results.append(values)
        except Exception as error:
            results.append(describe_error(error))
    return results


def _item_and_output(condition: Condition, item: Item) -> tuple[Item, Tensor]:
    """Process an item, and cut the item and its output to the shorter length."""
    output = condition.output(item)
    if not output.isfinite().all():
        raise ValueError("the output has samples that are NaN or infinite")
    lengths = item.clean.shape[-1], output.shape[-1]
    samples = common_length(lengths, item.sample_rate, (item.name, f"its output {condition.name}"))
    if samples < lengths[0]:
        item = replace(item, clean=item.clean[:samples], signal=item.signal[:samples])
    return item, output[:samples]


def _check_finite(values: Values) -> None:
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} is {value}, not a finite number")


def _make_table(
    items: Sequence[Source],
    conditions: Sequence[Condition],
    measures: Sequence[Measure],
    results: Mapping[tuple[int, str, str], Values | str],
) -> DataFrame:
    rows = []
    for (number, source), condition in product(enumerate(items), conditions):
        row = {"item": number, "name": source.name, **source.facts, "condition": condition.name}
        reasons = []
        for measure in measures:
            values = results[number, condition.name, measure.name]
            if isinstance(values, str):
                reasons.append(values)
                continue
            for column in row.keys() & values.keys():
                raise ValueError(f"{measure.name} returns {column}, a column that exists already")
            row |= values
        rows.append({**row, "failure": "; ".join(dict.fromkeys(reasons)) or None})
    table = require("pandas", "eval").DataFrame(rows)
    table["failure"] = table.pop("failure")  # The order of columns does not depend on the values.
    return table
