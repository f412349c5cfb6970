"""Many files scored by several measures, in parallel, each score stored as it is made.

Peak memory does not grow with the audio: a file is read when its turn comes, by the process that scores it. What
remains of an item is its key, its scores and its levels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import check_full_scale, dbfs
from hlsim.evaluation.store import ScoreStore, content_hash, key_of
from hlsim.metrics.pyclarity import Progress, check_seed
from hlsim.metrics.registry import MEASURES, check_measures, versions_of
from hlsim.parallel import check_parallel, run_parallel

EARS = ("left", "right")

_REVISION = 1  # of how hlsim calls the measures: raise it where that changes a score


@dataclass(frozen=True)
class Item:
    """One utterance in one ear, under each condition.

    Args:
        name: what it is called in reports.
        clean: file of the clean speech.
        processed: file of what the ear is given, by condition.
        audiogram: of the ear.
        listener: whose ear; empty where unknown.
        ear: ``"left"``, ``"right"`` or empty. Of a file with two channels it is the channel; others have one.
        snr: of the speech in noise, in dB, where known.
        full_scale_spl: level in dB SPL of a file whose RMS is 1.0.
        spl: or else the level of the clean file in dB SPL; the processed files are on the same scale.
    """

    name: str
    clean: Path
    processed: Mapping[str, Path]
    audiogram: Audiogram
    listener: str = ""
    ear: str = ""
    snr: float | None = None
    full_scale_spl: float = 94.0
    spl: float | None = None

    def full_scale(self, clean_dbfs: float) -> float:
        """Level in dB SPL of RMS 1.0, from that of the clean file relative to RMS 1.0."""
        return self.full_scale_spl if self.spl is None else self.spl - clean_dbfs


class Result(NamedTuple):
    """A score, or None and the reason; levels in dB relative to RMS 1.0, rate in Hz, duration in s."""

    score: float | None
    reason: str | None = None
    seed: int = 0
    sample_rate: int = 0
    seconds: float = 0.0
    clean_dbfs: float = 0.0
    dbfs: float = 0.0


class Task(NamedTuple):
    """A score to make: a measure of an item under a condition."""

    item: Item
    condition: str
    measure: str
    seed: int
    key: str


Results = list[dict[tuple[str, str], Result]]
"""One an item: results by (measure, condition)."""


def score_items(
    items: Sequence[Item],
    measures: Iterable[str] = ("haspi",),
    *,
    store: ScoreStore | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Results:
    """Score every item by every measure under every condition; the same whatever the number of processes.

    A score is known by the contents of both files, the measure, the versions of what computes it and, where they
    matter, the audiogram, the level settings and the seed; known ones are not made again. An item's seed is ``seed``
    plus the first 32 bits of the SHA-256 of its clean file, modulo 2 ** 32: the same under every condition, whatever
    other files there are. Failures have a reason in place of a score; they are not stored, but tried again.

    Args:
        store: scores made earlier, to which new ones go; None keeps nothing.
        jobs, backend, scheduler: as ``run_parallel``.
        progress: called with the number of scores there and of all: first where some were stored, and after each new one.

    Returns: for each item its results by (measure, condition).

    Raises:
        ValueError: an unknown measure or backend, ``jobs`` below 1, a seed that numpy does not take, the store cannot be
            written. What is wrong with an item is its reason, no error.
        MissingExtraError: a measure's package, joblib or distributed is not installed.
    """
    check_seed(seed)
    check_parallel(jobs, backend, scheduler)
    names = check_measures(measures)
    store = ScoreStore() if store is None else store
    results: Results = [{} for _ in items]
    wanted: dict[str, list[tuple[int, str, str]]] = {}  # places by key: the same score may be wanted twice
    tasks: dict[str, Task] = {}
    for index, task in _tasks(items, names, seed):
        place = (index, task.measure, task.condition)
        if isinstance(task, _Unreadable):
            results[index][place[1:]] = Result(None, task.reason)
            continue
        if stored := store.get(task.key):
            results[index][place[1:]] = _stored(stored)._replace(seed=task.seed)  # some measures know none
            continue
        wanted.setdefault(task.key, []).append(place)
        tasks.setdefault(task.key, task)
    total = sum(len(item.processed) for item in items) * len(names)
    done = total - sum(map(len, wanted.values()))
    if progress is not None and done and tasks:
        progress(done, total)
    made = run_parallel(score_task, tasks.values(), jobs=jobs, backend=backend, scheduler=scheduler)
    for task, result in made if tasks else ():
        if result is None:
            result = Result(
                None, "the process that scored it died (a crash in the measure, or memory ran out)"
            )
        elif result.score is not None:
            facts = {"file": task.item.name, "condition": task.condition, "measure": task.measure}
            store.append(task.key, facts | result._asdict())
        for index, measure, condition in wanted[task.key]:
            results[index][measure, condition] = result
            done += 1
            if progress is not None:
                progress(done, total)
    return results


def score_task(task: Task) -> Result:
    """One score; what goes wrong is the result's reason."""
    item, processed = task.item, task.item.processed[task.condition]
    try:
        clean, rate = read_channel(item.clean, item.ear)
        heard, own_rate = read_channel(processed, item.ear)
        if own_rate != rate:
            raise ValueError(
                f"{processed} has {own_rate} Hz and {item.clean} {rate} Hz; allowed: equal rates"
            )
        if len(clean) != len(heard):
            raise ValueError(
                f"{item.clean} has {len(clean)} samples and {processed} {len(heard)}; allowed: equal lengths"
            )
        levels = [float(dbfs(torch.from_numpy(signal))) for signal in (clean, heard)]
        full_scale = check_full_scale(item.full_scale(levels[0]))
        score = MEASURES[task.measure].score(clean, heard, item.audiogram, rate, full_scale, task.seed)
    except Exception as error:  # whatever it is, it is this item's reason, and the others go on
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        return Result(None, kind + " ".join(str(error).split()), task.seed)
    return Result(score, None, task.seed, rate, len(clean) / rate, levels[0], levels[1])


def read_channel(path: str | Path, ear: str = "") -> tuple[np.ndarray, int]:
    """Samples of what one ear is given, as they are: (time,) in float64, and the rate in Hz.

    Args:
        ear: ``"left"`` or ``"right"`` takes that channel of a file with two, the first or the second.

    Raises:
        ValueError: as ``read_audio``, or the file has several channels and no ear is named, or more than two.
    """
    waveform, rate = read_audio(path)
    if waveform.shape[0] != 1 and not (ear and waveform.shape[0] == 2):
        allowed = "1, or 2 for left and right" if ear else "1, for one file is what one ear is given"
        raise ValueError(f"{path}: {waveform.shape[0]} channels; allowed: {allowed}")
    channel = EARS.index(ear) if waveform.shape[0] == 2 else 0
    if not bool(waveform[channel].any()):
        raise ValueError(f"{path}: silent, every sample of the {ear} channel is zero")
    return waveform[channel].double().numpy(), rate


class _Unreadable(NamedTuple):
    condition: str
    measure: str
    reason: str


def _tasks(items: Sequence[Item], measures: Sequence[str], seed: int) -> Iterable[tuple[int, Any]]:
    hashes = _Remembered(content_hash)
    versions = {name: versions_of([name]) for name in measures}
    for index, item in enumerate(items):
        for condition, path in item.processed.items():
            try:
                clean, processed = hashes[item.clean], hashes[path]
            except ValueError as error:
                for name in measures:
                    yield index, _Unreadable(condition, name, str(error))
                continue
            own_seed = (seed + int(clean[:8], 16)) % 2**32
            for name in measures:
                settings: dict[str, Any] = {
                    "revision": _REVISION,
                    "measure": name,
                    "versions": versions[name],
                    "clean": clean,
                    "processed": processed,
                    "ear": item.ear,
                }
                if MEASURES[name].of_an_ear:
                    settings["audiogram"] = list(item.audiogram.thresholds)
                    settings["full_scale_spl"] = item.full_scale_spl if item.spl is None else None
                    settings["spl"] = item.spl
                    settings["seed"] = own_seed
                yield index, Task(item, condition, name, own_seed, key_of(settings))


class _Remembered(dict[Path, str]):
    """A function of a path, called once a path."""

    def __init__(self, function: Callable[[Path], str]) -> None:
        self._function = function

    def __missing__(self, path: Path) -> str:
        self[path] = self._function(path)
        return self[path]


def _stored(record: Mapping[str, Any]) -> Result:
    return Result(**{name: record[name] for name in Result._fields})
