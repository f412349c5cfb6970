"""Time and memory of a call, and what becomes of one that fails."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

Call = Callable[[], Any]


def finish(call: Call, device: torch.device) -> None:
    """Call, and wait for the device to be done with it."""
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(call: Call, device: torch.device) -> float:
    start = time.perf_counter()
    finish(call, device)
    return 1000.0 * (time.perf_counter() - start)


def peak_mib(call: Call, device: torch.device) -> float | None:
    """MiB by which memory grows during a call: on a GPU torch's count, on a CPU the process's resident memory."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        held = torch.cuda.memory_allocated(device)
        finish(call, device)
        return (torch.cuda.max_memory_allocated(device) - held) / 2**20
    statm = Path("/proc/self/statm")
    if not statm.is_file():
        finish(call, device)
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
    try:
        finish(call, device)
    finally:
        over.set()
        watcher.join()
    return max(highest, resident()) - before


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
