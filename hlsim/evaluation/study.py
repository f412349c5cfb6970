"""Studies: items, conditions and measures in, one table out.

An item is speech for an ear, a condition processes it (no aid, a hearing aid, a simulator), and a
measure scores the output. ``haspi-report``, ``evaluate-compensator``, ``evaluate-simulator``,
``clarity`` and the demo are such studies.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import metadata
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.checks import check_finite, check_waveform, loud_outputs
from hlsim.evaluation.running.fingerprint import code_version, fingerprint, value_hash
from hlsim.evaluation.running.parallel import (
    CRASH,
    Crash,
    Progress,
    check_scheduler,
    describe_error,
    record_warnings,
    run_parallel,
)
from hlsim.evaluation.running.store import ScoreStore
from hlsim.extras import MissingExtraError, require
from hlsim.metrics.pair import common_length
from hlsim.progress import track
from hlsim.torchtools import one_thread

if TYPE_CHECKING:
    from pandas import DataFrame

Values = Mapping[str, float | str]
"""Values that a measure returns for one output: a dict from column of the table to value."""

_Results = dict[tuple[int, str, str], Values | str]
"""Values, or the reason why there are none, under (number of the item, condition, measure)."""

_RESERVED_COLUMNS = (
    *("item", "name", "condition", "failure", "source", "gap", "combined", "level_over_nal_r"),
)
"""Columns of the table that hlsim writes, so that a measure may not return them."""


class ItemSource(Protocol):
    """Protocol of an item whose signals are loaded only when it is measured, such as from files.

    An ``Item``, whose signals are in memory, follows the protocol, too.

    >>> source: ItemSource = Item("item 1", torch.ones(8), torch.ones(8), Audiogram.standard("N3"))
    >>> source.load().name
    'item 1'
    """

    @property
    def name(self) -> str: ...

    @property
    def facts(self) -> Mapping[str, Any]: ...

    @property
    def clean_name(self) -> str:
        """Name of the clean signal. A study measures items with the same name one after another.

        Measures can then prepare this clean signal once for all of these items.
        """

    def digest(self, condition: str) -> str:
        """Return a hash of all data of the item on which its scores under a condition depend.

        The name and the facts are not part of it, because few measures use them.
        """

    def load(self) -> Item: ...


@dataclass(frozen=True)
class Item:
    """Speech for one ear: the input that conditions process, and its clean reference.

    Args:
        name: Name in tables.
        clean: Clean speech, with which measures compare an output. Shape: (time,).
        signal: Input of the conditions, such as noisy speech. Shape: (time,), or (microphones,
            ears, time), with the reference microphone and the ear of the item first.
        ear: Audiogram of the ear.
        sample_rate: Sample rate of both signals in Hz.
        full_scale_spl: Level in dB SPL of a signal whose RMS is 1.0.
        seed: Seed of the random numbers that a measure draws.
        facts: Further columns of the table that describe the item, such as ``listener`` or ``snr``.
        recorded: Function from the name of a condition to the output that was recorded under it;
            None if conditions compute their outputs.

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
    recorded: Callable[[str], Tensor] | None = None
    _computed: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def reference_signal(self) -> Tensor:
        """The input at the reference microphone, (time,)."""
        return self.signal.reshape(-1, self.signal.shape[-1])[0]

    @property
    def clean_name(self) -> str:
        """Empty text for every item, so that a study measures items in their order."""
        return ""

    def load(self) -> Item:
        """Return a copy without the values that ``once`` has stored, which need memory."""
        return replace(self)

    def digest(self, condition: str) -> str:
        """Return a hash of samples, ear, sample rate, full scale and seed.

        If outputs were recorded, that of the condition is part of it. Otherwise, the hash is the
        same under every condition, because the input is.
        """
        settings = [self.sample_rate, self.full_scale_spl, self.seed]
        output = [] if self.recorded is None else [self.recorded(condition)]
        return value_hash([self.clean, self.signal, self.ear.to_dict(), settings, *output])

    def once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Compute a value that is the same under all conditions, or return it from memory.

        Args:
            name: Name of the value, such as ``"reference"``.
            compute: Function without arguments that computes the value. The item stores the result
                for later calls with the name.
        """
        if name not in self._computed:
            self._computed[name] = compute()
        return self._computed[name]


@dataclass(frozen=True)
class Condition:
    """One way of processing items, such as a hearing aid.

    Args:
        name: Name in tables.
        process: Function or module ``(signal, ear) -> output``, for the signal of an item and an
            ``Audiogram``, with an output of shape (time,); None if the outputs were recorded. A
            module is set to evaluation mode, also by each study, because it may have been trained
            further. If the function or module has the attribute
            ``may_crash = True``, its compiled code may end the process, so even a study of one item
            runs in another process, unless ``jobs`` is 1.
        kind: Role in the study, such as ``"unaided"``, ``"prescription"``, ``"aid"`` or
            ``"equaliser"``.
        of: Name of the condition to which this one belongs, such as the aid whose level it has;
            empty if it belongs to none.

    >>> Condition("unaided", lambda signal, ear: signal, "unaided").of
    ''
    """

    name: str
    process: Callable[[Tensor, Any], Tensor] | None = None
    kind: str = "aid"
    of: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.process, nn.Module):
            self.process.eval()

    @property
    def fingerprint(self) -> str | None:
        """Hash of the present code and settings of the processing, or None if unknown.

        For recorded outputs it is the text "recorded". Scores are stored only if it is known.
        """
        return "recorded" if self.process is None else fingerprint(self.process)

    def output(self, item: Item) -> Tensor:
        """Process the input of an item, or read its recorded output.

        Returns:
            The output, (time,). It is not validated here, but by ``cut_output``.

        Raises:
            ValueError: There is neither a function nor a recorded output, or its file is not
                valid. Functions of a user may raise other errors.
        """
        if self.process is None:
            if item.recorded is None:
                raise ValueError(
                    f"expected the condition {self.name} to have a function, or the item "
                    f"{item.name} to have recorded outputs; pass process or recorded"
                )
            return item.recorded(self.name)
        # A function that changes its input in place must not change the item.
        return self.process(item.signal.clone(), item.ear)


@dataclass(frozen=True)
class Measure:
    """A function that scores outputs, with a description of what its values depend on.

    Args:
        name: Name in options and files.
        compute: Function ``(item, output) -> dict from column to value``, for an ``Item`` and an
            output with shape (time,). It raises ValueError if a value is not defined. A module is
            set to evaluation mode by each study.
        packages: Packages on whose installed versions the values depend.
        settings: Text that names all else on which the values depend, such as the hash of a network
            or a version of the function; None if this is unknown. Values are then not stored.
        uses_facts: Whether the values may depend on the name and the facts of an item, such as
            the words that were spoken.
        scores: Columns that are scores, by which conditions are compared; None if all columns are.
            An output that lacks one is a failure. Other columns, such as levels, only describe an
            output, and may be missing.
        may_crash: Whether compiled code of the measure may end its process. Such a measure never
            runs in the process of the caller.

    >>> Measure("peak", lambda item, output: {"peak": float(output.abs().max())}).name
    'peak'
    """

    name: str
    compute: Callable[[Item, Tensor], Values]
    packages: Sequence[str] = ()
    settings: str | None = ""
    uses_facts: bool = True
    scores: Sequence[str] | None = None
    may_crash: bool = False

    @cached_property
    def fingerprint(self) -> str | None:
        """Hash of the packages' versions and of ``settings``, or None if the settings are unknown.

        Values are stored only if it is known.

        Raises:
            MissingExtraError: A package is not installed.
        """
        if self.settings is None:
            return None
        try:
            versions = [metadata.version(name) for name in self.packages]
        except metadata.PackageNotFoundError as error:
            raise MissingExtraError(
                f"the measure {self.name} requires {error.name}, which is not installed; install it"
            ) from error
        return value_hash([versions, self.settings])


class _Task(NamedTuple):
    """One item with those of its scores that the store lacks.

    Attributes:
        number: Number of the item in the study, from 0.
        source: The item.
        missing: Condition, measure and store key of each missing score. The key is empty if the
            score cannot be stored.
    """

    number: int
    source: ItemSource
    missing: list[tuple[Condition, Measure, str]]


def run_study(
    items: Sequence[ItemSource],
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
    error in one item, output or measure does not end the study: only the values that depend on it
    are missing, its text is in the column ``failure``, and a later run tries again.

    Args:
        items: Items, or sources that load them.
        conditions: Conditions that process each item.
        measures: Measures that score each output.
        store: Scores of earlier runs, to which new scores are added. A score is computed again only
            if the item, the condition, the measure or the code of hlsim has changed, or if one of
            them cannot be hashed (``fingerprint`` is None). The name and the facts of an item count
            only for measures that use them. Warnings that a stored score has caused are repeated.
        jobs: Number of processes; all cores by default. With 1, everything runs in this process, as
            debuggers need it, and a crash of your own compiled code ends the process. A study with
            a measure that may crash, such as PESQ, runs in another process even then.
        dask: Address of a Dask scheduler, whose workers replace the processes.
        progress: Function that is called with the number of finished scores and the number of all
            scores. There is one for each combination of an item, a condition and a measure.

    Returns:
        One row per item and condition: ``item`` (its number), ``name``, the item's facts,
        ``condition``, one column per measured value, and ``failure``, the reason why values are
        missing; it is None if every measure has its values.

    Raises:
        ValueError: There are no items, conditions or measures; two conditions or measures have the
            same name; a fact or a measured value has the name of another column or of one that is
            reserved for the report; no scheduler answers; or the store cannot be written.
        MissingExtraError: A package is not installed.

    >>> signal = torch.ones(1600)
    >>> items = [Item("item 1", signal, signal, Audiogram.standard("N3"))]
    >>> conditions = [Condition("unaided", lambda signal, ear: signal)]
    >>> measures = [Measure("peak", lambda item, output: {"peak": float(output.abs().max())})]
    >>> run_study(items, conditions, measures, jobs=1)["peak"].tolist()
    [1.0]
    """
    check_scheduler(dask)
    return run_measures(items, conditions, measures, store, progress, jobs=jobs, dask=dask)[0]


def run_measures(
    items: Sequence[ItemSource],
    conditions: Sequence[Condition],
    measures: Sequence[Measure],
    store: ScoreStore | None = None,
    progress: Progress | None = None,
    **running: Any,
) -> tuple[DataFrame, list[Measure]]:
    """Run a study, and return its table and which columns of it are scores.

    Args:
        items, conditions, measures, store, progress: See ``run_study``.
        running: Arguments ``jobs`` and ``dask`` of ``run_study``.

    Returns:
        The table of ``run_study``, and the measures. A copy replaces a measure whose ``scores`` is
        None; that of the copy lists all columns that the measure has returned.

    Raises:
        ValueError, MissingExtraError: See ``run_study``.

    >>> speech = 0.02 * torch.ones(16000)
    >>> item = Item("item 0", speech, speech, Audiogram.standard("N3"))
    >>> count = Measure("count", lambda item, output: {"count": len(output)})
    >>> unaided = Condition("unaided", lambda signal, ear: signal)
    >>> table, measures = run_measures([item], [unaided], [count], jobs=1)
    >>> list(measures[0].scores)
    ['count']
    """
    pandas = require("pandas", "eval")
    store = store or ScoreStore()
    report_progress = progress or (lambda finished, total: None)
    columns_of_items = [*_RESERVED_COLUMNS, *{fact for source in items for fact in source.facts}]
    if not items:
        raise ValueError("expected items, got none; add some")
    _check_different("condition", [condition.name for condition in conditions])
    _check_different("measure", [measure.name for measure in measures])
    _check_different("table column", columns_of_items)
    owners = dict.fromkeys(columns_of_items, "")
    results: _Results = {}
    warned: set[str] = set()

    def warn_once(texts: Sequence[str]) -> None:
        for text in texts:
            if text not in warned:
                warned.add(text)
                warnings.warn(text, stacklevel=4)

    for function in (*(c.process for c in conditions), *(m.compute for m in measures)):
        if isinstance(function, nn.Module):
            function.eval()  # It may have been trained since the condition was made.
    fingerprints = {condition.name: condition.fingerprint for condition in conditions}
    tasks = []
    for number, source in track(enumerate(items), "items whose scores are looked up", len(items)):
        task = _Task(number, source, [])
        for condition in conditions:
            keys = _keys(source, condition.name, fingerprints[condition.name], measures)
            for measure, key in zip(measures, keys, strict=True):
                if key in store.scores:
                    warn_once(store.warnings.get(key, ()))
                    _claim_columns(owners, measure, store.scores[key])
                    results[number, condition.name, measure.name] = store.scores[key]
                else:
                    task.missing.append((condition, measure, key))
        if task.missing:
            tasks.append(task)
    tasks.sort(key=lambda task: task.source.clean_name)
    total = len(items) * len(conditions) * len(measures)
    report_progress(len(results), total)
    # Compiled code behind a measure or an aid of a user's own may crash, too; one job keeps it
    # debuggable.
    own_code = [":" in measure.name for measure in measures]
    own_code += [getattr(condition.process, "may_crash", False) for condition in conditions]
    isolates_own = running.get("jobs") != 1 and any(own_code)
    running["in_processes"] = isolates_own or any(measure.may_crash for measure in measures)
    while tasks:
        tasks_of_crashes = []
        for task, measured in run_parallel(_measure_item, tasks, **running):
            if isinstance(measured, Crash):
                running["in_processes"] = True  # The next crash would end this process.
                if len(task.missing) > 1:
                    # Only one score is to blame: each is computed again in a task of its own.
                    tasks_of_crashes += [task._replace(missing=[score]) for score in task.missing]
                    continue
                measured = [(CRASH, [])]
            scores = zip(task.missing, measured, strict=True)
            for (condition, measure, key), (values, texts) in scores:
                warn_once(texts)
                results[task.number, condition.name, measure.name] = values
                if isinstance(values, str):
                    continue
                _claim_columns(owners, measure, values)
                if key:
                    store.append(key, values, texts)
            report_progress(len(results), total)
        tasks = tasks_of_crashes
    measures = [
        replace(m, scores=[column for column, owner in owners.items() if owner == m.name])
        if m.scores is None
        else m
        for m in measures
    ]
    rows = _make_rows(items, conditions, measures, results)
    table = pandas.DataFrame(rows).drop(columns="failure")
    # It is the last column whatever the values are. A column of texts would have NaN for None.
    table["failure"] = pandas.Series([row["failure"] for row in rows], dtype=object)
    return table, measures


def _check_different(noun: str, names: Sequence[str]) -> None:
    """Raise ValueError if there are no names, or two equal ones; ``noun`` is what they name."""
    if not names:
        raise ValueError(f"expected the name of a {noun}, got none; add one")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two of the {noun}s are called {name}; rename one of them")


def _claim_columns(owners: dict[str, str], measure: Measure, values: Values) -> None:
    """Add the columns that a measure has returned to ``owners``.

    Args:
        owners: Name of the measure that returns each column; empty for the columns of items and of
            hlsim. It is changed in place.
        measure: The measure.
        values: Values that the measure has returned, by column.

    Raises:
        ValueError: A column belongs to another measure, to the items or to hlsim, or differs from
            another one only in case.
    """
    # Tables write the names of some columns in capitals.
    spellings = {column.casefold(): column for column in owners}
    for column in values:
        spelling = spellings.setdefault(column.casefold(), column)
        if owners.setdefault(spelling, measure.name) != measure.name or spelling != column:
            raise ValueError(
                f"{measure.name} returns {column}, a column that exists already; rename it in "
                "the measure"
            )


def _keys(
    source: ItemSource, condition: str, processing: str | None, measures: Sequence[Measure]
) -> list[str]:
    """Return the keys under which the values of an item under a condition are stored.

    Args:
        source: The item.
        condition: Name of the condition.
        processing: Fingerprint of the condition, or None if it is unknown.
        measures: The measures.

    Returns:
        One key per measure; an empty text if the values of this measure cannot be stored.
    """
    try:
        digest = source.digest(condition)
    except Exception:  # The output fails for the same reason, or a function computes it.
        return [""] * len(measures)
    keys = []
    for measure in measures:
        parts = [digest, processing, measure.fingerprint]
        if None in parts:
            keys.append("")
            continue
        facts = [source.name, source.facts] if measure.uses_facts else []
        try:
            keys.append(value_hash([*parts, measure.name, facts, code_version()]))
        except TypeError:  # A fact cannot be described.
            keys.append("")
    return keys


@one_thread()
@torch.no_grad()
def _measure_item(task: _Task) -> list[tuple[Values | str, list[str]]]:
    """Compute the missing values of one item.

    Returns:
        For each member of ``task.missing``, the values by column, or the text of the error because
        of which there are none; and the texts of the warnings for users, of which those of the item
        and of the condition's output belong to each of their scores.
    """
    texts_of_item: list[str] = []
    try:
        with record_warnings(texts_of_item):
            item = task.source.load()
            check_waveform(item.clean, "clean speech", full_scale_spl=item.full_scale_spl)
    except Exception as error:  # A failure must not end the study.
        return [(describe_error(error), texts_of_item)] * len(task.missing)
    results: list[tuple[Values | str, list[str]]] = []
    pairs: dict[str, tuple[Item, Tensor]] = {}
    texts_of_pairs: dict[str, list[str]] = {}
    for condition, measure, _ in task.missing:
        texts = texts_of_pairs.setdefault(condition.name, [*texts_of_item])
        texts_of_measure: list[str] = []
        try:
            if condition.name not in pairs:
                with record_warnings(texts):
                    pairs[condition.name] = _item_and_output(condition, item)
            item_of_output, output = pairs[condition.name]
            with loud_outputs(), record_warnings(texts_of_measure):
                # A measure that changes the output in place must not change that of the next one.
                values = dict(measure.compute(item_of_output, output.clone()))
            outcome: Values | str = _check_values(measure, values)
        except Exception as error:
            outcome = describe_error(error)
        results.append((outcome, [*texts, *texts_of_measure]))
    return results


def _check_values(measure: Measure, values: dict[str, Any]) -> Values:
    """Convert the numbers among the values of a measure to floats, in place, and return them.

    Raises:
        ValueError: A number is NaN or infinite.
        TypeError: A value is neither a text nor a number.
    """
    for name, value in values.items():
        if isinstance(value, str):
            continue
        number = float(value)  # of a number of NumPy or torch, for example
        if not math.isfinite(number):
            raise ValueError(
                f"expected a finite number for {name} from {measure.name}, got {value}"
            )
        values[name] = number
    return values


def _item_and_output(condition: Condition, item: Item) -> tuple[Item, Tensor]:
    """Process an item, and cut its signals and the output to the length of the shorter one.

    Returns:
        The item with its cut signals, and the output, (time,).

    Raises:
        ValueError: The output has another type or shape, differs in length by more than 0.1 s, or
            is not finite.
    """
    output = cut_output(condition.output(item), item.clean, item.sample_rate)
    samples = output.shape[-1]
    if samples < item.clean.shape[-1]:
        item = replace(item, clean=item.clean[:samples], signal=item.signal[..., :samples])
    return item, output


def cut_output(output: Tensor, signal: Tensor, sample_rate: int) -> Tensor:
    """Validate the output of an aid, and cut it to the length of its input if it is longer.

    A shorter output is returned whole. A difference in length causes a warning.

    Args:
        output: The output. Shape: (..., time), where ``time`` may differ by 0.1 s.
        signal: The input. Shape: (..., time).
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: The output is no floating-point tensor, has other leading dimensions, differs
            in length by more than 0.1 s, or has samples that are not finite.

    >>> cut_output(torch.ones(1601), torch.ones(1600), 16000).shape
    torch.Size([1600])
    """
    is_real = isinstance(output, Tensor) and output.is_floating_point()
    if not is_real or output.shape[:-1] != signal.shape[:-1]:
        kind = output.dtype if isinstance(output, Tensor) else type(output).__name__
        raise ValueError(
            f"expected a floating-point output of shape {tuple(signal.shape)}, got {kind} of shape "
            f"{tuple(getattr(output, 'shape', ()))}; return a tensor of the input's shape and type"
        )
    check_finite(output, "the output")
    lengths = signal.shape[-1], output.shape[-1]
    return output[..., : common_length(lengths, sample_rate, ("the input", "the output"))]


def _make_rows(
    items: Sequence[ItemSource],
    conditions: Sequence[Condition],
    measures: Sequence[Measure],
    results: _Results,
) -> list[dict[str, Any]]:
    """Return the rows of the table of ``run_study``, one dict per item and condition."""
    rows = []
    for (number, source), condition in product(enumerate(items), conditions):
        row = {"item": number, "name": source.name, **source.facts, "condition": condition.name}
        reasons = []
        for measure in measures:
            values = results[number, condition.name, measure.name]
            if isinstance(values, str):
                reasons.append(values)
                continue
            row |= values
            # A mean over the other items would look like one over all.
            missing = [column for column in measure.scores or () if column not in values]
            if missing:
                reasons.append(f"{measure.name} has returned no {', '.join(missing)}")
        rows.append({**row, "failure": "; ".join(dict.fromkeys(reasons)) or None})
    return rows
