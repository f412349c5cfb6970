"""A study: items, conditions and measures in, one table out.

Every evaluation in hlsim is a study. ``haspi-report``, ``evaluate-compensator``, ``evaluate-simulator``,
``clarity`` and the demo differ in their items (files, drawn clips, scenes), their conditions (recorded files,
hearing aids, simulators) and their measures, and in nothing else.
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
from hlsim.evaluation.fingerprint import combined_fingerprint, fingerprint, samples_hash
from hlsim.evaluation.store import ScoreStore, key_of
from hlsim.extras import require
from hlsim.metrics.pair import common_length
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Progress, one_thread, reason_of, run_parallel
from hlsim.version import __version__

if TYPE_CHECKING:
    from pandas import DataFrame

Values = Mapping[str, float | str]
"""Values by the name of their column."""


class Source(Protocol):
    """Where an item comes from: memory, as with ``Item`` itself, or files."""

    @property
    def name(self) -> str: ...

    @property
    def facts(self) -> Mapping[str, Any]: ...

    def digest(self, condition: str) -> str:
        """Return a SHA-256 of all that decides the item's values, but for condition and measure."""

    def load(self) -> Item: ...


@dataclass(frozen=True)
class Item:
    """One signal for one ear.

    Args:
        name: name in tables.
        clean: clean speech, the reference of measures.
        signal: input of the conditions.
        ear: the audiogram.
        sample_rate: rate in Hz.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0.
        seed: seed of random numbers that a measure draws.
        facts: columns of the table, such as ``listener`` or ``snr``.
        recorded: functions that read the outputs of conditions that were recorded, by their names.

    Shape: (time,).
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
        """Return the item, without what ``once`` has computed."""
        return replace(self)

    def digest(self, condition: str) -> str:
        """Return the SHA-256 of samples, ear, rate, level and seed; it is the same for all conditions."""
        samples = samples_hash(self.clean, self.signal)
        settings = [self.sample_rate, self.full_scale_spl, self.seed]
        return key_of({"samples": samples, "ear": self.ear.to_dict(), "settings": settings})

    def once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return what ``compute`` returns, computed once per item: a reference that all conditions share."""
        if name not in self._computed:
            self._computed[name] = compute()
        return self._computed[name]


@dataclass(frozen=True)
class Condition:
    """One way of processing an item, as a record: nothing has to be read from its name.

    Args:
        name: name in tables.
        process: function of an input and an ear that returns an output of the same shape; None if the outputs
            were recorded.
        kind: role in the study, such as ``"unaided"``, ``"aid"`` or ``"equaliser"``.
        of: name of the condition that this one belongs to, such as the aid whose level it has.
        rivals: names of the conditions that this one is compared with, most important first.
    """

    name: str
    process: Callable[[Tensor, Any], Tensor] | None = None
    kind: str = "aid"
    of: str = ""
    rivals: Sequence[str] = ()

    @cached_property
    def fingerprint(self) -> str | None:
        """Fingerprint of the processing; None if it is unknown, and then no score is stored."""
        return "recorded" if self.process is None else fingerprint(self.process)

    def output(self, item: Item) -> Tensor:
        """Process an item, or read its recorded output."""
        if self.process is None:
            if self.name not in item.recorded:
                raise ValueError(f"no output of {item.name} is recorded under {self.name}")
            return item.recorded[self.name]()
        return self.process(item.signal, item.ear)

    def record(self) -> dict[str, Any]:
        """Return name, kind, of and rivals, for JSON."""
        fields = ("name", "kind", "of", "rivals")
        return {name: getattr(self, name) for name in fields}


@dataclass(frozen=True)
class Measure:
    """A function of an item and an output, and what readers of its values have to know.

    Args:
        name: name in options and files; a score's column has the same name.
        compute: function that returns values by column, or raises ValueError if there are none.
        title: name in tables and plots.
        packages: packages whose versions decide the values.
        revision: raise it when a change of hlsim changes a value.
        settings: fingerprint of what else decides the values, such as a teacher; None if it is unknown.
        knows_hearing: whether the values depend on audiogram and level.
        rewards_gain: whether more level alone brings a higher score.
        ends: lowest and highest score, for the axes of plots.
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
        return combined_fingerprint(
            str(self.revision), str(versions_of(self.packages)), self.settings
        )


def versions_of(packages: Iterable[str]) -> dict[str, str]:
    """Return the installed version of each package, that of hlsim also if it runs from its sources."""
    versions = {}
    for package in dict.fromkeys(packages):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
        if package == "hlsim":
            versions[package] = __version__
    return versions


Place = tuple[str, str]
"""Names of condition and measure."""


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

    Items are measured in parallel, and the values do not depend on how many at a time. An error ends only the
    measure, output or item that it occurs in: it becomes the reason in the column ``failure``, and a later
    run tries again.

    Args:
        store: values of earlier runs, to which new ones are added. A value is computed again only if samples,
            ear, condition or measure have changed.
        jobs: number of processes; None takes all cores.
        dask: address of a Dask scheduler whose workers take the place of processes.
        progress: called with the number of finished values and of all.

    Returns: one row per item and condition: ``item`` (its number), ``name``, the item's facts, ``condition``,
        one column per measured value, and ``failure``, missing where every measure has its values.

    Raises:
        ValueError: no scheduler answers, or the store cannot be written.
        MissingExtraError: a package is not installed.
    """
    store = ScoreStore() if store is None else store
    _warn_of_unknown([*conditions, *measures])
    keys = [_keys(source, conditions, measures) for source in items]
    results: list[dict[Place, Values | str]] = [{} for _ in items]
    tasks = []
    for number, source in enumerate(items):
        missing = []
        for condition, measure in product(conditions, measures):
            place = condition.name, measure.name
            record = store.get(keys[number][place])
            if record is None:
                missing.append((condition, measure))
            else:
                results[number][place] = record["values"]
        if missing:
            tasks.append(_Task(number, source, missing))
    total = len(items) * len(conditions) * len(measures)
    done = total - sum(len(task.missing) for task in tasks)
    show = progress or (lambda done, total: None)
    show(done, total)
    for task, measured in run_parallel(_measure_item, tasks, jobs=jobs, dask=dask):
        for place, values in (measured or _all_failed(task, _DIED)).items():
            results[task.number][place] = values
            key = keys[task.number][place]
            if key and not isinstance(values, str):
                about = {"item": task.source.name, "condition": place[0], "measure": place[1]}
                store.append(key, {**about, "values": values})
        done += len(task.missing)
        show(done, total)
    return _table(items, conditions, measures, results)


_DIED = "the process that computed it ended (a crash in compiled code, or no memory was left)"


def _keys(
    source: Source, conditions: Sequence[Condition], measures: Sequence[Measure]
) -> dict[Place, str]:
    """Return the keys of an item's values; empty where nothing is stored."""
    keys = {}
    for condition in conditions:
        try:
            digest: str | None = source.digest(condition.name)
        except ValueError:  # loading the item or its output will fail for the same reason
            digest = None
        for measure in measures:
            parts = (digest, condition.fingerprint, measure.fingerprint)
            known = None not in parts
            place = condition.name, measure.name
            keys[place] = key_of({"value": [*parts, measure.name]}) if known else ""
    return keys


def _warn_of_unknown(parts: Sequence[Condition | Measure]) -> None:
    unknown = [part.name for part in parts if part.fingerprint is None]
    if unknown:
        warnings.warn(
            f"scores with {', '.join(unknown)} are not stored and will be computed again by the next run; "
            "to store them, give what computes them an attribute fingerprint, such as a version",
            stacklevel=3,
        )


@one_thread()
@torch.no_grad()
def _measure_item(task: _Task) -> dict[Place, Values | str]:
    """Compute the missing values of one item; what fails becomes its reason."""
    try:
        item = task.source.load()
    except Exception as error:  # whatever it is, the other items go on
        return _all_failed(task, reason_of(error))
    results: dict[Place, Values | str] = {}
    pairs: dict[str, tuple[Item, Tensor]] = {}
    for condition, measure in task.missing:
        try:
            if condition.name not in pairs:
                pairs[condition.name] = _item_and_output(condition, item)
            values: Values | str = measure.compute(*pairs[condition.name])
            _check_finite(values)
        except Exception as error:
            values = reason_of(error)
        results[condition.name, measure.name] = values
    return results


def _all_failed(task: _Task, reason: str) -> dict[Place, Values | str]:
    return {(condition.name, measure.name): reason for condition, measure in task.missing}


def _item_and_output(condition: Condition, item: Item) -> tuple[Item, Tensor]:
    """Process an item; both are cut to the shorter one if they differ by 0.1 s at most."""
    output = condition.output(item)
    if not output.isfinite().all():
        raise ValueError("the output has samples that are NaN or infinite")
    lengths = item.clean.shape[-1], output.shape[-1]
    samples = common_length(lengths, item.sample_rate, (item.name, f"its output {condition.name}"))
    if samples < lengths[0]:
        item = replace(item, clean=item.clean[:samples], signal=item.signal[:samples])
    return item, output[:samples]


def _check_finite(values: Any) -> None:
    for name, value in values.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{name} is {value}, not a finite number")


def _table(
    items: Sequence[Source],
    conditions: Sequence[Condition],
    measures: Sequence[Measure],
    results: Sequence[Mapping[Place, Values | str]],
) -> DataFrame:
    rows = []
    for (number, source), condition in product(enumerate(items), conditions):
        row = {"item": number, "name": source.name, **source.facts, "condition": condition.name}
        reasons = []
        for measure in measures:
            values = results[number][condition.name, measure.name]
            if isinstance(values, str):
                reasons.append(values)
            elif both := row.keys() & values.keys():
                raise ValueError(
                    f"{measure.name} returns {both.pop()}, a column that exists already"
                )
            else:
                row |= values
        rows.append({**row, "failure": "; ".join(dict.fromkeys(reasons)) or None})
    table = require("pandas", "eval").DataFrame(rows)
    table["failure"] = table.pop("failure")  # last, whichever row has which values
    return table
