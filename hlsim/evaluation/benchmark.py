"""How fast simulators are, side by side in one process."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import set_level
from hlsim.extras import MissingExtraError, require
from hlsim.msbg import MSBG
from hlsim.msbg.ear import RATE as MSBG_RATE
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import load_pretrained

EARS = ("N1", "N2", "N3")
"""One ear of each degree of loss: mild, moderate and severe in MSBG's sense."""


def benchmark(
    *,
    device: str = "cpu",
    seconds: float = 1.0,
    repeats: int = 9,
    simulator: str = "neuro-msbg",
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Time one clip at batch 1 through pyclarity's MSBG, the exact MSBG and a Neuro-MSBG, in turn.

    The clip is noise at 65 dB SPL with the rhythm of syllables, the ears N1, N2 and N3. Rows take turns, so that all see
    the same machine; the first round does not count, and each timing follows an uncounted call of the same.

    Args:
        device: ``"cpu"`` or ``"cuda"``; pyclarity always runs on the CPU.
        seconds: length of the clip.
        repeats: counted rounds.
        simulator: name or folder of the Neuro-MSBG.
        progress: called with a line a round.

    Returns: machine, and rows of name, sample rate, median, least and greatest milliseconds forward and forward plus
    backward, and ``speedup``, the time of pyclarity's MSBG over the row's, both medians over all ears and rounds.
    pyclarity runs at 44.1 kHz only: the same second.
    """
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device {device}: there is no GPU that torch can use; allowed: cpu")
    runs: list[tuple[str, int, Any]] = []
    for rate in (MSBG_RATE, NEURO_RATE):
        runs.append(("MSBG (exact)", rate, MSBG(sample_rate=rate).to(device)))
        runs.append(
            (f"Neuro-MSBG ({simulator})", rate, load_pretrained(simulator, sample_rate=rate).to(device))
        )
    skipped = []
    try:
        reference = _reference()
    except MissingExtraError as error:
        reference = None
        skipped.append(f"pyclarity MSBG: {error}")
    clips = {rate: _clip(rate, seconds) for rate in (MSBG_RATE, NEURO_RATE)}
    times: dict[tuple[str, int, str], list[float]] = {}
    for turn in range(repeats + 1):
        if progress is not None:
            progress(f"round {turn} of {repeats}")
        for ear in map(Audiogram.standard, EARS):
            if reference is not None:
                process = partial(reference(ear).process, clips[MSBG_RATE].double().numpy())
                _time(times, ("MSBG (pyclarity)", MSBG_RATE, "forward"), turn, "cpu", process)
            for name, rate, model in runs:
                clip = clips[rate].to(device)
                _time(times, (name, rate, "forward"), turn, device, partial(_forward, model, clip, ear))
                _time(times, (name, rate, "both"), turn, device, partial(_both, model, clip, ear))
    baseline = times.get(("MSBG (pyclarity)", MSBG_RATE, "forward"))
    rows = []
    for name, rate in dict.fromkeys((key[0], key[1]) for key in times):
        forward, both = times[(name, rate, "forward")], times.get((name, rate, "both"))
        rows.append(
            {
                "name": name,
                "sample_rate": rate,
                "forward_ms": _spread(forward),
                "forward_backward_ms": _spread(both) if both else None,
                "speedup": statistics.median(baseline) / statistics.median(forward) if baseline else None,
            }
        )
    machine = platform.processor() or platform.machine()
    if device.startswith("cuda"):
        machine = torch.cuda.get_device_name(device)
    about = {
        "device": device,
        "machine": machine,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }
    return about | {
        "torch": torch.__version__,
        "seconds": seconds,
        "repeats": repeats,
        "rows": rows,
        "skipped": skipped,
    }


def benchmark_markdown(result: dict[str, Any]) -> str:
    """The rows as a table."""
    lines = [
        f"{result['seconds']:g} s, batch 1, {result['device']} ({result['machine']}, {result['threads']} threads), torch "
        f"{result['torch']}; median (least to greatest) of {result['repeats']} rounds on {len(EARS)} ears.",
        "",
        "| simulator | rate (Hz) | forward (ms) | forward + backward (ms) | times pyclarity's speed |",
        "|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        both = row["forward_backward_ms"]
        speedup = f"{row['speedup']:.1f}" if row["speedup"] else "-"
        cells = (
            row["name"],
            row["sample_rate"],
            _cell(row["forward_ms"]),
            _cell(both) if both else "-",
            speedup,
        )
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join([*lines, *(f"\nskipped: {reason}" for reason in result["skipped"])]) + "\n"


def _reference() -> Callable[[Audiogram], Any]:
    module = require("clarity.evaluator.msbg.msbg", "eval")

    def prepare(audiogram: Audiogram) -> Any:
        ear = module.Ear(equiv_0db_spl=74.0)  # plus 20: RMS 1.0 is 94 dB SPL
        ear.set_audiogram(audiogram.to_clarity())
        return ear

    return prepare


def _clip(rate: int, seconds: float) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    samples = round(rate * seconds)
    syllables = torch.sin(torch.arange(samples) * (2.0 * torch.pi * 4.0 / rate)).clamp_min(0.05)
    return set_level(torch.randn(samples, generator=generator) * syllables, 65.0)


def _time(
    times: dict[tuple[str, int, str], list[float]],
    key: tuple[str, int, str],
    turn: int,
    device: str,
    call: Callable[[], Any],
) -> None:
    call()  # the one before left its own data in the caches
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    start = time.perf_counter()
    call()
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    elapsed = 1000.0 * (time.perf_counter() - start)
    if turn:
        times.setdefault(key, []).append(elapsed)


def _forward(model: torch.nn.Module, clip: Tensor, ear: Audiogram) -> None:
    with torch.no_grad():
        model(clip, ear)


def _both(model: torch.nn.Module, clip: Tensor, ear: Audiogram) -> None:
    model(clip.clone().requires_grad_(), ear).square().sum().backward()


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "least": min(values), "greatest": max(values)}


def _cell(spread: dict[str, float]) -> str:
    return f"{spread['median']:.1f} ({spread['least']:.1f} to {spread['greatest']:.1f})"
