"""How fast simulators are, side by side in one process."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.benchmark.models import Row, rows
from hlsim.benchmark.timing import DIRECTIONS, Timings, about, attempt, clip, finish, peak_mib
from hlsim.neuro.config import NEURO_RATE

LENGTHS = (1.0, 4.0, 16.0, 60.0)
BATCHES = (1, 8, 64)

TRAINING = (4.0, 64)  # seconds and clips of a batch that the default network is trained with

EARS = ("N1", "N2", "N3")
"""One ear of each degree of loss: mild, moderate and severe in MSBG's sense."""

# milliseconds: what takes longer is timed in so many rounds only, with the middle ear and no uncounted call
_SLOW, _SLOW_ROUNDS = 400.0, 2

Progress = Callable[[int, int, str], None]


def benchmark(
    *,
    device: str = "cpu",
    repeats: int = 7,
    limit: float = 2.0,
    lengths: tuple[float, ...] = LENGTHS,
    batches: tuple[int, ...] = BATCHES,
    training: tuple[float, int] | None = TRAINING,
    simulators: list[str] | None = None,
    only: Sequence[str] = (),
    progress: Progress | None = None,
    keep: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Time the simulators on noise at 65 dB SPL with the rhythm of syllables.

    One second at batch 1 first, forward (in inference mode) and forward plus backward, with the ears N1, N2 and N3: the
    rows take turns, so that all see the same machine, and each timing follows an uncounted call of the same. Then longer
    clips at batch 1 and larger batches of 1 s, forward, at each row's own rate and with the ear N2; and of the default
    network at 16 kHz a batch to train on, forward plus backward. A row, or a size of one, that fails is left out.

    Args:
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:1"``; pyclarity's ``Ear`` always runs on the CPU.
        repeats: counted rounds.
        limit: seconds that one timing of a longer clip or larger batch may take by what shorter ones took; others are
            left out.
        training: seconds and clips of the batch to train on, left out on a CPU that would take longer than ``limit``.
        simulators, only: Neuro-MSBGs as ``rows`` takes them; parts of names: rows with none of them are left out.
        progress: called with timings done, timings in all, and what comes; ``keep`` with the result so far after each.

    Returns: machine, ``rows`` and ``skipped``, what failed and why. A row has name, parameters and a list of ``cells``,
        each with sample rate, seconds, batch, direction, median, least and greatest milliseconds, peak memory in MiB,
        seconds of sound in a second of time and, at 1 s and batch 1, ``speedup``: the median of pyclarity's ``Ear``,
        forward, over the row's. It runs at 44.1 kHz only: the same second.

    Raises:
        ValueError: there is no such device, or no row of such a name.
    """
    machine = about(device, repeats)
    found, skipped = rows(simulators)
    if only:
        names = [row.name for row in found]
        found = [row for row in found if any(part in row.name for part in only)]
        if not found:
            raise ValueError(f"only {' '.join(only)}: no such row; there are {', '.join(names)}")
    timings = _Simulators(torch.device(device), repeats, limit, skipped)
    for row in found:
        for rate in row.rates:
            what = f"{row.name}, {rate} Hz"
            attempt(what, partial(timings.prepare, row, rate), timings.device, skipped)
    steps: list[tuple[str, Callable[[], None]]] = [
        (f"{row.name}, 1 s", partial(timings.second, row, rate, turn))
        for turn in range(repeats + 1)
        for row in found
        for rate in row.rates
    ]
    sizes = [(s, 1) for s in lengths if s != 1.0] + [(1.0, b) for b in batches if b != 1]
    for row in found:
        for s, b in sizes:
            steps.append((f"{row.name}, {s:g} s, batch {b}", partial(timings.size, row, s, b)))
        if row.default and training is not None:
            what = f"{row.name}, {training[0]:g} s, batch {training[1]}, forward and backward"
            steps.append((what, partial(timings.training, row, *training)))
    for done, (what, take) in enumerate([*steps, ("", lambda: None)]):
        if progress is not None:
            progress(done, len(steps), what)
        take()
        result = machine | timings.result(found)
        if keep is not None:
            keep(result)
    return result


class _Key(NamedTuple):
    name: str
    sample_rate: int
    seconds: float
    batch: int
    direction: str

    def __str__(self) -> str:
        size = f"{self.seconds:g} s, batch {self.batch}"
        return f"{self.name}, {self.sample_rate} Hz, {size}, {DIRECTIONS[self.direction]}"


class _Simulators(Timings):
    """What is timed of each row."""

    def __init__(
        self, device: torch.device, repeats: int, limit: float, skipped: list[str]
    ) -> None:
        super().__init__(device, skipped)
        self.repeats, self.limit = repeats, limit
        self.calls: dict[tuple[str, int, str], Callable[[Tensor], Tensor]] = {}
        self.fastest: dict[tuple[str, int], float] = {}

    def prepare(self, row: Row, rate: int) -> None:
        made = {ear: row.prepare(rate, Audiogram.standard(ear), self.device) for ear in EARS}
        self.calls |= {(row.name, rate, ear): call for ear, call in made.items()}

    def second(self, row: Row, rate: int, turn: int) -> None:
        """One second at batch 1: with every ear in both directions, in round ``turn``, of which 0 does not count."""
        slow = turn == 0 or self.fastest.get((row.name, rate), 0.0) > _SLOW
        if (row.name, rate, EARS[1]) not in self.calls or (slow and turn > _SLOW_ROUNDS):
            return
        forward = _Key(row.name, rate, 1.0, 1, "forward")
        both = forward._replace(direction="both")
        for ear in EARS[1:2] if slow else EARS:
            for key in (forward, both) if row.differentiable else (forward,):
                if forward not in self.failed:
                    self.attempt(key, partial(self._round, key, ear, turn, slow))

    def _round(self, key: _Key, ear: str, turn: int, slow: bool) -> None:
        call = self._call(key, ear)
        if not slow:
            finish(call, self.device)  # the one before left its own data in the caches
        elapsed = self.take(key, call, turn > 0)
        if turn == 0:
            if elapsed > _SLOW:  # a row's first call makes what the later ones find
                elapsed = self.take(key, call, False)
            self.peaks[key] = peak_mib(call, self.device)
        if key.direction == "forward":
            place = (key.name, key.sample_rate)
            self.fastest[place] = min(self.fastest.get(place, math.inf), elapsed)

    def size(self, row: Row, seconds: float, batch: int) -> None:
        """Another length or batch, forward at the row's own rate, where it does not take too long."""
        key = _Key(row.name, row.rates[0], seconds, batch, "forward")
        alone = key._replace(batch=1)
        same = {
            k.seconds: median(t)
            for k, t in self.times.items()
            if k._replace(seconds=seconds) == alone
        }
        if 1.0 in same:
            self._repeat(
                key, same[1.0] * batch if batch > 1 else _expected(list(same.items()), seconds)
            )

    def training(self, row: Row, seconds: float, batch: int) -> None:
        """A batch to train on, forward plus backward at the network's own rate, where a CPU does not take too long."""
        key = _Key(row.name, NEURO_RATE, seconds, batch, "both")
        if second := self.times.get(key._replace(seconds=1.0, batch=1)):
            # a GPU takes much less than what one second tells
            self._repeat(
                key, median(second) * seconds * batch if self.device.type == "cpu" else 0.0
            )

    def _repeat(self, key: _Key, expected: float) -> None:
        def take() -> None:
            call = self._call(key, EARS[1])
            self.peaks[key] = peak_mib(call, self.device)
            first = self.take(key, call)
            for _ in range(min(self.repeats, int(3000.0 * self.limit / max(1.0, first))) - 1):
                self.take(key, call)

        if expected <= 1000.0 * self.limit:
            self.attempt(key, take)

    def _call(self, key: _Key, ear: str) -> Callable[[], None]:
        sound = clip(key.sample_rate, key.seconds, key.batch).to(self.device)
        return partial(_run, self.calls[key.name, key.sample_rate, ear], sound, key.direction)

    def result(self, found: list[Row]) -> dict[str, Any]:
        out = []
        for row in found:
            cells = [self._cell(key) for key in self.times if key.name == row.name]
            if cells:
                out.append({"name": row.name, "parameters": row.parameters, "cells": cells})
        return {"rows": out, "skipped": list(self.skipped)}

    def _cell(self, key: _Key) -> dict[str, Any]:
        cell = key._asdict() | (self.figures(key) or {})
        del cell["name"]
        reference = self.figures(_Key("pyclarity Ear", 44100, 1.0, 1, "forward"))
        single = key.seconds == 1.0 and key.batch == 1
        return cell | {
            "counted": len(self.times[key]),
            "times_real_time": 1000.0 * key.seconds * key.batch / cell["median_ms"],
            "speedup": reference["median_ms"] / cell["median_ms"] if reference and single else None,
        }


def _expected(line: list[tuple[float, float]], seconds: float) -> float:
    """Milliseconds of a longer clip, by how the time grew so far: attention's grows with the square of the length."""
    power = 1.0
    if len(line) > 1:
        (short, low), (long, high) = line[-2:]
        # no more than that, for what takes microseconds may look as if, where the machine was busy once
        power = min(2.0, max(1.0, math.log(high / low) / math.log(long / short)))
    return line[-1][1] * (seconds / line[-1][0]) ** power


def _run(call: Callable[[Tensor], Tensor], clip: Tensor, direction: str) -> None:
    if direction == "both":
        call(clip.clone().requires_grad_()).square().sum().backward()
    else:
        with torch.inference_mode():
            call(clip)
