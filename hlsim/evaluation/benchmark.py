"""How fast simulators are, side by side in one process."""

from __future__ import annotations

import math
import os
import platform
import statistics
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import set_level
from hlsim.evaluation.benchmark_models import Row, rows

EARS = ("N1", "N2", "N3")
"""One ear of each degree of loss: mild, moderate and severe in MSBG's sense."""

# milliseconds: what takes longer is timed in so many rounds only, with the middle ear and no uncounted call
_SLOW, _SLOW_ROUNDS = 400.0, 2

LENGTHS = (1.0, 4.0, 16.0, 60.0)
BATCHES = (1, 8, 64)

Progress = Callable[[int, int, str], None]


def benchmark(
    *,
    device: str = "cpu",
    repeats: int = 7,
    limit: float = 2.0,
    lengths: tuple[float, ...] = LENGTHS,
    batches: tuple[int, ...] = BATCHES,
    simulators: list[str] | None = None,
    only: Sequence[str] = (),
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Time the simulators on noise at 65 dB SPL with the rhythm of syllables.

    One second at batch 1 first, forward (in inference mode) and forward plus backward, with the ears N1, N2 and N3: the
    rows take turns, so that all see the same machine, and each timing follows an uncounted call of the same. Then longer
    clips at batch 1 and larger batches of 1 s, forward, at each row's own rate and with the ear N2.

    Args:
        device: ``"cpu"`` or ``"cuda"``; pyclarity's ``Ear`` always runs on the CPU.
        repeats: counted rounds.
        limit: seconds that one timing of a longer clip or larger batch may take by what shorter ones took; others are
            left out.
        lengths: seconds.
        simulators: the Neuro-MSBGs, by name or folder; by default all that ship.
        only: parts of names: rows with none of them are left out.
        progress: called with cells done, cells in all, and what comes.

    Returns: machine, ``rows`` and ``skipped``. A row has name, parameters and a list of ``cells``, each with sample rate,
        seconds, batch, direction, median, least and greatest milliseconds, peak memory in MiB and, at 1 s and batch 1,
        ``speedup``: the median of pyclarity's ``Ear``, forward, over the row's. It runs at 44.1 kHz only: the same
        second. ``growth`` is the exponent of the time's growth with length and with batch.

    Raises:
        ValueError: there is no such device, or no row of such a name.
    """
    machine = about(device, repeats)
    place = torch.device(device)
    found, skipped = rows(simulators)
    if only:
        names = [row.name for row in found]
        found = [row for row in found if any(part in row.name for part in only)]
        if not found:
            raise ValueError(f"only {' '.join(only)}: no such row; there are {', '.join(names)}")
    cells: dict[tuple[str, int, float, int, str], list[float]] = {}
    memory: dict[tuple[str, int, float, int, str], float | None] = {}
    done, total = 0, _count(found, repeats, lengths, batches)

    def step(text: str) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total, text)

    calls = {
        (row.name, rate, ear): row.prepare(rate, Audiogram.standard(ear), place)
        for row in found
        for rate in row.rates
        for ear in EARS
    }
    probe: dict[tuple[str, int], float] = {}
    for turn in range(repeats + 1):
        for row in found:
            for rate in row.rates:
                step(f"{row.name}, 1 s")
                clip = _clip(rate, 1.0, 1, place)
                slow = probe.get((row.name, rate), math.inf if turn == 0 else 0.0) > _SLOW
                if slow and turn > _SLOW_ROUNDS:
                    continue
                for ear in EARS[1:2] if slow else EARS:
                    for direction in ("forward", "both") if row.differentiable else ("forward",):
                        key = (row.name, rate, 1.0, 1, direction)
                        call = calls[row.name, rate, ear]
                        elapsed = _time(call, clip, direction, place, warm=not slow)
                        if turn == 0 and elapsed > _SLOW:  # a row's first call makes what the later ones find
                            elapsed = _time(call, clip, direction, place, warm=False)
                        if direction == "forward":
                            probe[row.name, rate] = min(probe.get((row.name, rate), math.inf), elapsed)
                        if turn:
                            cells.setdefault(key, []).append(elapsed)
                        elif ear == EARS[1]:
                            memory[key] = _peak(call, clip, direction, place)
    for row in found:
        rate = row.rates[0]
        call, first = calls[row.name, rate, "N2"], statistics.median(cells[row.name, rate, 1.0, 1, "forward"])
        sizes = [(s, 1) for s in lengths if s != 1.0] + [(1.0, b) for b in batches if b != 1]
        line = [(1.0, first)]
        for seconds, batch in sizes:
            step(f"{row.name}, {seconds:g} s, batch {batch}")
            expected = first * batch if batch > 1 else _expected(line, seconds)
            if expected > 1000.0 * limit:
                continue
            clip = _clip(rate, seconds, batch, place)
            key = (row.name, rate, seconds, batch, "forward")
            try:
                memory[key] = _peak(call, clip, "forward", place)
            except RuntimeError as error:  # a GPU's own kind is one of these
                if "memory" not in str(error):
                    raise
                skipped.append(f"{row.name}, {seconds:g} s, batch {batch}: memory ran out")
                continue
            times = max(1, min(repeats, int(3000.0 * limit / max(1.0, expected))))
            cells[key] = [_time(call, clip, "forward", place, warm=False) for _ in range(times)]
            if batch == 1:
                line.append((seconds, statistics.median(cells[key])))
    reference = cells.get(("pyclarity Ear", 44100, 1.0, 1, "forward"))
    return machine | {
        "rows": [_row(row, cells, memory, reference) for row in found],
        "skipped": skipped,
    }


def _row(
    row: Row,
    cells: dict[tuple[str, int, float, int, str], list[float]],
    memory: dict[tuple[str, int, float, int, str], float | None],
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
                "speedup": statistics.median(reference) / median if reference and single else None,
            }
        )
    return {
        "name": row.name,
        "parameters": row.parameters,
        "cells": out,
        "growth": {by: _growth(out, by, row.rates[0]) for by in ("seconds", "batch")},
    }


def _expected(line: list[tuple[float, float]], seconds: float) -> float:
    """Milliseconds of a longer clip, by how the time grew so far: attention's grows with the square of the length."""
    power = 1.0
    if len(line) > 1:
        (low, first), (high, last) = line[-2:]
        # no more than that, for what takes microseconds may look as if, where the machine was busy once
        power = min(2.0, max(1.0, math.log(last / first) / math.log(high / low)))
    return line[-1][1] * (seconds / line[-1][0]) ** power


def _growth(cells: list[dict[str, Any]], by: str, rate: int) -> float | None:
    """Exponent of the time over the largest range measured: 1.0 is proportional."""
    other = "batch" if by == "seconds" else "seconds"
    line = [
        (cell[by], cell["median_ms"])
        for cell in cells
        if cell[other] == 1 and cell["direction"] == "forward" and cell["sample_rate"] == rate
    ]
    (low, first), (high, last) = min(line), max(line)
    return math.log(last / first) / math.log(high / low) if high > low else None


def about(device: str, repeats: int) -> dict[str, Any]:
    """Machine, versions and date.

    Raises:
        ValueError: there is no such device.
    """
    found = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if device not in (*found, *(["cuda"] if len(found) > 1 else ())):
        raise ValueError(f"device {device!r}: there is none that torch can use; allowed: {', '.join(found)}")
    machine = torch.cuda.get_device_name(device) if device.startswith("cuda") else _processor()
    return {
        "device": device,
        "machine": machine,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "date": time.strftime("%Y-%m-%d"),
        "repeats": repeats,
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _count(found: list[Row], repeats: int, lengths: tuple[float, ...], batches: tuple[int, ...]) -> int:
    sizes = sum(s != 1.0 for s in lengths) + sum(b != 1 for b in batches)
    return (repeats + 1) * sum(len(row.rates) for row in found) + len(found) * sizes


def _clip(rate: int, seconds: float, batch: int, device: torch.device) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    samples = round(rate * seconds)
    syllables = torch.sin(torch.arange(samples) * (2.0 * torch.pi * 4.0 / rate)).clamp_min(0.05)
    return set_level(torch.randn(batch, samples, generator=generator) * syllables, 65.0).to(device)


def _run(call: Callable[[Tensor], Tensor], clip: Tensor, direction: str, device: torch.device) -> None:
    if direction == "both":
        call(clip.clone().requires_grad_()).square().sum().backward()
    else:
        with torch.inference_mode():
            call(clip)
    if device.type == "cuda":
        torch.cuda.synchronize()


def _time(
    call: Callable[[Tensor], Tensor], clip: Tensor, direction: str, device: torch.device, warm: bool = True
) -> float:
    """Milliseconds of one call."""
    if warm:
        _run(call, clip, direction, device)  # the one before left its own data in the caches
    start = time.perf_counter()
    _run(call, clip, direction, device)
    return 1000.0 * (time.perf_counter() - start)


def _peak(
    call: Callable[[Tensor], Tensor], clip: Tensor, direction: str, device: torch.device
) -> float | None:
    """MiB by which memory grows during a call: on a GPU torch's count, on a CPU the process's resident memory."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        held = torch.cuda.memory_allocated()
        _run(call, clip, direction, device)
        return (torch.cuda.max_memory_allocated() - held) / 2**20
    statm = Path("/proc/self/statm")
    if not statm.is_file():
        _run(call, clip, direction, device)
        return None

    def resident() -> float:
        return float(statm.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    before = resident()
    highest = before
    over = threading.Event()

    def watch() -> None:
        nonlocal highest
        while not over.wait(0.002):
            highest = max(highest, resident())

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    _run(call, clip, direction, device)
    over.set()
    watcher.join()
    return max(highest, resident()) - before
