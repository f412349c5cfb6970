"""How fast simulators are, side by side in one process."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch

from hlsim.benchmark.machine import about
from hlsim.benchmark.measuring import Key, Measuring
from hlsim.benchmark.models import Row, rows

LENGTHS = (1.0, 4.0, 16.0, 60.0)
BATCHES = (1, 8, 64)

TRAINING = (4.0, 64)
"""Seconds and clips of a batch that the default network is trained or trained through with."""

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
        lengths: seconds.
        training: seconds and clips of the batch to train on, left out on a CPU that would take longer than ``limit``.
        simulators: the Neuro-MSBGs, by name or folder; by default all that ship.
        only: parts of names: rows with none of them are left out.
        progress: called with cells done, cells in all, and what comes.
        keep: called with the result so far after each round and each row's sizes.

    Returns: machine, ``rows`` and ``skipped``, what failed and why. A row has name, parameters and a list of ``cells``,
        each with sample rate, seconds, batch, direction, median, least and greatest milliseconds, peak memory in MiB,
        seconds of sound in a second of time and, at 1 s and batch 1, ``speedup``: the median of pyclarity's ``Ear``,
        forward, over the row's. It runs at 44.1 kHz only: the same second. ``growth`` is the exponent of the time's
        growth with length and with batch.

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
    measured = Measuring(torch.device(device), repeats, limit, skipped)
    done, total = 0, _count(found, repeats, lengths, batches, training)

    def step(text: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total, text)

    def so_far() -> dict[str, Any]:
        result = machine | _result(found, measured)
        if keep is not None:
            keep(result)
        return result

    for row in found:
        measured.prepare(row)
    for turn in range(repeats + 1):
        for row in found:
            for rate in row.rates:
                step(f"{row.name}, 1 s")
                measured.second(row, rate, turn)
        so_far()
    for row in found:
        for seconds, batch in _sizes(lengths, batches):
            step(f"{row.name}, {seconds:g} s, batch {batch}")
            measured.size(row, seconds, batch)
        if row.default and training is not None:
            step(f"{row.name}, {training[0]:g} s, batch {training[1]}, forward and backward")
            measured.training(row, *training)
        so_far()
    return so_far()


def _result(found: list[Row], measured: Measuring) -> dict[str, Any]:
    reference = measured.times.get(("pyclarity Ear", 44100, 1.0, 1, "forward"))
    timed = {key[0] for key in measured.times}
    return {
        "rows": [_row(row, measured.times, measured.memory, reference) for row in found if row.name in timed],
        "skipped": list(measured.skipped),
    }


def _row(
    row: Row,
    cells: dict[Key, list[float]],
    memory: dict[Key, float | None],
    reference: list[float] | None,
) -> dict[str, Any]:
    out: list[dict[str, Any]] = []
    for key, times in cells.items():
        name, rate, seconds, batch, direction = key
        if name != row.name:
            continue
        single = seconds == 1.0 and batch == 1
        median = statistics.median(times)
        out.append(
            {
                "sample_rate": rate,
                "seconds": seconds,
                "batch": batch,
                "direction": direction,
                "median_ms": median,
                "least_ms": min(times),
                "greatest_ms": max(times),
                "counted": len(times),
                "peak_mib": memory.get(key),
                "times_real_time": 1000.0 * seconds * batch / median,
                "speedup": statistics.median(reference) / median if reference and single else None,
            }
        )
    return {
        "name": row.name,
        "parameters": row.parameters,
        "cells": out,
        "growth": {by: _growth(out, by, row.rates[0]) for by in ("seconds", "batch")},
    }


def _growth(cells: list[dict[str, Any]], by: str, rate: int) -> float | None:
    """Exponent of the time over the largest range measured: 1.0 is proportional."""
    other = "batch" if by == "seconds" else "seconds"
    line = [
        (cell[by], cell["median_ms"])
        for cell in cells
        if cell[other] == 1 and cell["direction"] == "forward" and cell["sample_rate"] == rate
    ]
    (low, first), (high, last) = min(line, default=(1, 0.0)), max(line, default=(1, 0.0))
    return math.log(last / first) / math.log(high / low) if high > low else None


def _sizes(lengths: tuple[float, ...], batches: tuple[int, ...]) -> list[tuple[float, int]]:
    return [(s, 1) for s in lengths if s != 1.0] + [(1.0, b) for b in batches if b != 1]


def _count(
    found: list[Row],
    repeats: int,
    lengths: tuple[float, ...],
    batches: tuple[int, ...],
    training: tuple[float, int] | None,
) -> int:
    sizes = len(found) * len(_sizes(lengths, batches))
    steps = sum(row.default for row in found) if training is not None else 0
    return (repeats + 1) * sum(len(row.rates) for row in found) + sizes + steps
