"""Many files scored by several measures, in parallel, each score stored as it is made.

Peak memory does not grow with the audio: a file is read when its turn comes, by the process that scores it. What
remains of an item is its key, its scores and its levels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EARS
from hlsim.calibration import check_full_scale, dbfs
from hlsim.evaluation.store import ScoreStore, content_hash, key_of
from hlsim.metrics.pair import check_seed
from hlsim.metrics.registry import MEASURES, MeasureName, check_measures, versions_of
from hlsim.parallel import (
    Backend,
    Failed,
    Progress,
    check_parallel,
    make_missing,
    one_thread,
    reason_of,
)


@dataclass(frozen=True)
class FileItem:
    """One utterance in one ear, under each condition.

    Args:
        name: what it is called in reports.
        processed: file of what the ear is given, by condition.
        listener: whose ear; empty where unknown.
        ear: ``"left"``, ``"right"`` or empty. Of a file with two channels it is the channel; others have one.
        snr: of the speech in noise, in dB, where known.
        full_scale_spl: level in dB SPL of a file whose RMS is 1.0.
        spl: or else the level of the clean file in dB SPL; the processed files are on the same scale.

    Raises:
        ValueError: a name, condition or listener with characters that do not print: reports in LaTeX, Markdown and HTML
            would take line breaks and changes of direction for more than text.
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

    def __post_init__(self) -> None:
        for text in (self.name, self.listener, *self.processed):
            if not text.isprintable():
                raise ValueError(
                    f"{text!r} holds characters that do not print; allowed: names of one line that do"
                )

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


class FileTask(NamedTuple):
    """A score to make: a measure of an item under a condition, and what it is stored under."""

    item: FileItem
    condition: str
    measure: str
    seed: int
    key: str


Results = list[dict[tuple[str, str], Result]]
"""One an item: results by (measure, condition)."""


def score_items(
    items: Sequence[FileItem],
    measures: Iterable[MeasureName] = ("haspi",),
    *,
    store: ScoreStore | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: Backend = "loky",
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Results:
    """Score every item by every measure under every condition; the same whatever the number of processes.

    A score is known by the contents of both files, the measure, what computes it in which version and, where they
    matter, the audiogram, the level settings and the seed; known ones are not made again. An item's seed is ``seed``
    plus the first 32 bits of the SHA-256 of its clean file, modulo 2 ** 32: the same under every condition, whatever
    other files there are. What is wrong with an item is its reason in place of a score, no error; that is not stored, but
    tried again.

    Args:
        store: scores made earlier, to which new ones go; None keeps nothing.
        jobs, backend, scheduler: as ``run_parallel``, which raises what is wrong with them.
        progress: called with the number of scores there and of all: first where some were stored, and after each new one.

    Raises:
        ValueError: an unknown measure, a seed that numpy does not take, or the store cannot be written.
        MissingExtraError: a measure's package is not installed.
    """
    check_seed(seed)
    check_parallel(jobs, backend, scheduler)
    names = check_measures(measures)
    store = ScoreStore() if store is None else store
    results: Results = [{} for _ in items]
    places: list[tuple[int, FileTask]] = []
    hashes = cache(content_hash)
    about_measures = {name: _about(name) for name in names}
    for index, item in enumerate(items):
        scale = {
            "full_scale_spl": item.full_scale_spl if item.spl is None else None,
            "spl": item.spl,
        }
        for condition, path in item.processed.items():
            try:
                files = {"clean": hashes(item.clean), "processed": hashes(path), "ear": item.ear}
            except ValueError as error:
                results[index] |= {(name, condition): Result(None, str(error)) for name in names}
                continue
            item_seed = (seed + int(files["clean"][:8], 16)) % 2**32
            of_an_ear = {"audiogram": list(item.audiogram.thresholds), **scale, "seed": item_seed}
            for name in names:
                about = about_measures[name] | files
                key = key_of(about | (of_an_ear if MEASURES[name].of_an_ear else {}))
                places.append((index, FileTask(item, condition, name, item_seed, key)))
    counts = Counter(task.key for _, task in places)  # the same score may be wanted twice
    failed = make_missing(
        score_task,
        [*{task.key: task for _, task in places}.values()],
        lambda task: [task.key] * counts[task.key],
        store,
        jobs=jobs,
        backend=backend,
        scheduler=scheduler,
        progress=progress,
    )
    for index, task in places:
        known = store.get(task.key) or {"score": None, "reason": failed.get(task.key)}
        result = Result(**{name: known[name] for name in Result._fields if name in known})
        # some measures know no seed: the stored one may be of another run
        results[index][task.measure, task.condition] = result._replace(seed=task.seed)
    return results


def _about(name: str) -> dict[str, Any]:
    """What computes a measure, for its scores' keys."""
    about = {"revision": MEASURES[name].revision, "measure": name}
    return {**about, "versions": versions_of([name])}


@one_thread()
def score_task(task: FileTask, _: Sequence[str] = ()) -> dict[str, dict[str, Any] | Failed]:
    """One score by its key; what goes wrong is the reason."""
    item, processed = task.item, task.item.processed[task.condition]
    measure = MEASURES[task.measure]
    try:
        (clean, rate), (heard, other) = (
            read_channel(path, item.ear) for path in (item.clean, processed)
        )
        if other != rate:
            raise ValueError(
                f"{processed} has {other} Hz and {item.clean} {rate} Hz; allowed: equal rates"
            )
        if len(clean) != len(heard):
            raise ValueError(
                f"{item.clean} has {len(clean)} samples and {processed} {len(heard)}; allowed: equal lengths"
            )
        levels = [float(dbfs(torch.from_numpy(signal))) for signal in (clean, heard)]
        full_scale = check_full_scale(item.full_scale(levels[0]))
        score = measure.score(clean, heard, item.audiogram, rate, full_scale, task.seed)
    except Exception as error:  # whatever it is, it is this item's reason, and the others go on
        return {task.key: Failed(reason_of(error))}
    result = Result(score, None, task.seed, rate, len(clean) / rate, *levels)
    about = {"file": item.name, "condition": task.condition, "measure": task.measure}
    return {task.key: about | result._asdict()}


def read_channel(path: str | Path, ear: str = "") -> tuple[np.ndarray, int]:
    """Samples of what one ear is given, as they are: (time,) in float64, and the rate in Hz.

    Of a file with two channels, ``ear`` takes the first for ``"left"`` or the second for ``"right"``. ValueError as
    ``read_audio``, or where it is silent, or has several channels and no ear is named, or more than two.
    """
    waveform, rate = read_audio(path)
    if waveform.shape[0] != 1 and not (ear and waveform.shape[0] == 2):
        allowed = (
            "1, or 2 for left and right" if ear else "1, for one file is what one ear is given"
        )
        raise ValueError(f"{path}: {waveform.shape[0]} channels; allowed: {allowed}")
    channel = EARS.index(ear) if waveform.shape[0] == 2 else 0
    if not bool(waveform[channel].any()):
        raise ValueError(f"{path}: silent, every sample of the {ear} channel is zero")
    return waveform[channel].double().numpy(), rate
