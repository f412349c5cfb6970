"""Time and memory of a call, what becomes of one that fails, and the machine that it ran on.

``torch.utils.benchmark`` was tried and left: it times one statement until it has enough, where rows are to take turns on
a busy machine; it makes two uncounted calls before each count, waits for the current GPU only, and knows no peak memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import statistics
import time
from collections.abc import Callable, Container, Hashable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hlsim.calibration import set_level

Call = Callable[[], Any]

DIRECTIONS = {"forward": "forward", "both": "forward and backward"}


def finish(call: Call, device: torch.device) -> None:
    """Call, and wait for the device to be done with it."""
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def peak_mib(call: Call, device: torch.device) -> float | None:
    """MiB by which memory grows during a call: on a GPU torch's count, else Linux's of the process, or None."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        finish(call, device)
        return (torch.cuda.max_memory_allocated(device) - held) / 2**20
    gc.collect()  # what was left behind and freed during the call would hide as much of the call's own
    _give_back()
    try:
        # the most that was held so far becomes what is held
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        call()
        return None
    before = _most_held_mib()
    call()
    return _most_held_mib() - before


def _give_back() -> None:
    """Freed memory that glibc keeps for itself goes back: a call that got it again would seem to need none."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # no such library, or not glibc's
        ctypes.CDLL(None).malloc_trim(0)


def _most_held_mib() -> float:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return float(status.split("VmHWM:")[1].split()[0]) / 1024.0


def attempt(what: str, call: Call, device: torch.device, skipped: list[str]) -> bool:
    """Whether a call went through; ``skipped`` is told why not, and a GPU's memory is freed for the next."""
    try:
        call()
        return True
    except Exception as error:  # whatever one model fails with is not to lose what the others took
        skipped.append(f"{what}: {reason(error)}")
    # not before the error is gone, whose traceback holds tensors
    if device.type == "cuda":
        with contextlib.suppress(RuntimeError):  # a broken device fails here again
            torch.cuda.empty_cache()
    return False


def reason(error: Exception) -> str:
    """The error in a line."""
    text = (str(error).splitlines() or [""])[0]
    if isinstance(error, MemoryError) or "memory" in text or "ALLOC_FAILED" in text:
        return "memory ran out"
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class Timings:
    """Milliseconds and peak memory by key, of the calls that did not fail; ``skipped`` gets what failed and why."""

    def __init__(self, device: torch.device, skipped: list[str]) -> None:
        self.device, self.skipped = device, skipped
        self.times: dict[Any, list[float]] = {}
        self.peaks: dict[Any, float | None] = {}
        self.failed: set[Any] = set()

    def attempt(self, key: Hashable, call: Call) -> None:
        """Call unless that failed before; ``str(key)`` names it where it fails."""
        if key not in self.failed and not attempt(str(key), call, self.device, self.skipped):
            self.failed.add(key)

    def take(self, key: Hashable, call: Call, counted: bool = True) -> float:
        """Milliseconds of a call, kept where it counts."""
        start = time.perf_counter()
        finish(call, self.device)
        elapsed = 1000.0 * (time.perf_counter() - start)
        if counted:
            self.times.setdefault(key, []).append(elapsed)
        return elapsed

    def figures(self, key: Hashable) -> dict[str, Any] | None:
        """None of a key that was not timed."""
        if not (times := self.times.get(key)):
            return None
        middle, peak = statistics.median(times), self.peaks.get(key)
        return {
            "median_ms": middle,
            "least_ms": min(times),
            "greatest_ms": max(times),
            "peak_mib": peak,
        }


def rows_by_turns(
    parts: Mapping[str, Callable[[], Tensor]],
    device: torch.device,
    repeats: int,
    forward_only: Container[str] = (),
) -> tuple[list[dict[str, Any]], list[str]]:
    """Time calls that return a scalar, forward and with the backward pass, in turns, so that all see the same machine.

    Returns: rows of name, forward and both, ``figures`` or None; and what failed, with its reason.
    """
    timings = Timings(device, [])

    def take(key: str, call: Call, turn: int) -> None:
        timings.take(key, call, turn > 0)
        # on a CPU the first call leaves memory to the process for the second
        if turn == 0 and device.type == "cuda":
            timings.peaks[key] = peak_mib(call, device)

    for turn in range(repeats + 1):  # the first does not count
        for name, part in parts.items():
            for direction, said in DIRECTIONS.items():
                if direction == "forward" or name not in forward_only:
                    key = f"{name}, {said}"
                    timings.attempt(key, partial(take, key, partial(_run, part, direction), turn))
    rows = []
    for name in parts:
        figures = {
            direction: timings.figures(f"{name}, {said}") for direction, said in DIRECTIONS.items()
        }
        if any(figures.values()):
            rows.append({"name": name, **figures})
    return rows, timings.skipped


def _run(part: Callable[[], Tensor], direction: str) -> None:
    with torch.set_grad_enabled(direction == "both"):
        value = part()
    if direction == "both":
        value.backward()


def clip(rate: int, seconds: float, batch: int) -> Tensor:
    """Noise at 65 dB SPL with the rhythm of syllables, seed 0. Shape: (batch, time)."""
    generator = torch.Generator().manual_seed(0)
    samples = round(rate * seconds)
    syllables = torch.sin(torch.arange(samples) * (2.0 * torch.pi * 4.0 / rate)).clamp_min(0.05)
    return set_level(torch.randn(batch, samples, generator=generator) * syllables, 65.0)


def about(device: str, repeats: int) -> dict[str, Any]:
    """Machine, versions and date; of a GPU its memory, CUDA and cuDNN, and how float32 is multiplied there, too.

    Raises:
        ValueError: there is no such device.
    """
    found = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if device not in (*found, *(["cuda"] if len(found) > 1 else ())):
        raise ValueError(
            f"device {device!r}: there is none that torch can use; allowed: {', '.join(found)}"
        )
    on_gpu = device.startswith("cuda")
    return {
        "device": device,
        "machine": torch.cuda.get_device_name(device) if on_gpu else _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "date": time.strftime("%Y-%m-%d"),
        "repeats": repeats,
        "gpu": _gpu(device) if on_gpu else None,
    }


def _gpu(device: str) -> dict[str, Any]:
    backends: Any = torch.backends  # torch's own types know little of it
    cudnn = backends.cudnn
    kinds = {"products": backends.cuda.matmul, "convolutions": cudnn.conv, "recurrent": cudnn.rnn}
    return {
        "memory_mib": torch.cuda.get_device_properties(device).total_memory / 2**20,
        "cuda": torch.version.cuda,
        "cudnn": cudnn.version(),
        "tf32": {name: kind.fp32_precision == "tf32" for name, kind in kinds.items()},
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
