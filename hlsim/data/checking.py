"""Checking a corpus: what there is, and every file of it read."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from hlsim.audio import read_audio
from hlsim.data.corpora import Fault, Found, walk_audio
from hlsim.data.manifest import inside
from hlsim.data.plan_settings import PlanSettings
from hlsim.dsp.active_level import active_level_db
from hlsim.parallel import run_parallel

_SILENT = 10.0 ** (-150.0 / 20.0)  # a peak below the steps of 24 bits


class Listing:
    """What a first look at the corpus tells: its speakers, and a digest of names, sizes and times of change."""

    def __init__(self) -> None:
        self.speakers: dict[str, set[str]] = {}
        self.paired = self.total = 0
        self._digest = hashlib.sha256()

    def add(self, root: Path, found: Found) -> None:
        self.total += 1
        if isinstance(found, Fault):
            self._digest.update(f"{found}\n".encode())
            return
        self.speakers.setdefault(found.speaker, set()).add(found.split)
        self.paired += bool(found.noisy)
        noisy = _state(root / found.noisy) if found.noisy else None
        self._digest.update(f"{found} {_state(root / found.clean)} {noisy}\n".encode())

    def digest(self, noise: Path, settings: PlanSettings) -> str:
        if settings.noise is not None:
            for path in walk_audio(noise):
                self._digest.update(
                    f"{path} {_state(noise / path)}\n".encode(errors="backslashreplace")
                )
        for table in (settings.audiograms, settings.test_audiograms):
            self._digest.update(f"{table and _state(table)}\n".encode())
        return self._digest.hexdigest()


def _state(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns


def read_sound(root: Path, path: str, *, any_rate: bool = False) -> tuple[Tensor, int]:
    """As ``read_audio``, of a path below the root. Raises ValueError where its first channel has nothing to hear, too."""
    waveform, rate = read_audio(inside(root, path), any_rate=any_rate)
    peak = float(waveform[0].abs().max())
    if peak == 0.0:
        raise ValueError("silent first channel")
    if peak <= _SILENT:
        raise ValueError(f"first channel as good as silent, its peak is {peak:.1g}")
    return waveform, rate


def fault_of(root: Path, path: str, error: ValueError) -> Fault:
    return Fault(path, str(error).removeprefix(f"{root / path}: "))


def examine(root: Path, shortest: float, pairs: bool, task: tuple[int, Found]) -> Found:
    """The utterance of a numbered task with rate, seconds and active level, or what is at fault with its files, which are
    read whole."""
    found = task[1]
    if isinstance(found, Fault):
        return found
    path = found.clean
    try:
        clean, rate = read_sound(root, path)
        samples = clean.shape[-1]
        if samples / rate < shortest:
            raise ValueError(f"{samples / rate:.3g} s; {shortest:g} s or more are asked for")
        if pairs and not found.noisy:
            raise ValueError("no noisy counterpart, and others have one")
        if found.noisy:
            path = found.noisy
            noisy, noisy_rate = read_sound(root, path)
            if noisy_rate != rate:
                raise ValueError(f"{noisy_rate} Hz, its clean speech has {rate} Hz")
            if (found_samples := noisy.shape[-1]) != samples:
                raise ValueError(
                    f"{found_samples} samples, its clean speech has {samples}: unequal lengths"
                )
    except ValueError as error:
        return fault_of(root, path, error)
    return replace(
        found, rate=rate, seconds=samples / rate, active_level=active_level_db(clean[0], rate)
    )


def examine_all(
    items: Iterable[Found], root: Path, shortest: float, pairs: bool, **parallel: Any
) -> Iterator[Found]:
    """``examine`` of each item, in order, by ``run_parallel``; a process that dies is a fault of its file."""
    waiting: dict[int, Found] = {}
    wanted = 0
    task = partial(examine, root, shortest, pairs)
    for (number, item), found in run_parallel(task, enumerate(items), **parallel):
        path = item.path if isinstance(item, Fault) else item.clean
        waiting[number] = found or Fault(path, "the process that read it died")
        while wanted in waiting:
            yield waiting.pop(wanted)
            wanted += 1
