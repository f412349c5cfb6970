"""The command ``benchmark``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from hlsim.cli.options import Commands, add_command, count, positive
from hlsim.files import write_whole

WHAT = ("simulators", "training", "scan")


def add(commands: Commands) -> None:
    sub = add_command(
        commands, "benchmark", _benchmark, "time simulators, a training step and the scan side by side"
    )
    sub.add_argument(
        "--device", default="cpu", help="cpu, cuda or cuda:1; pyclarity's Ear runs on the CPU always"
    )
    sub.add_argument(
        "--what",
        nargs="+",
        choices=WHAT,
        default=["simulators"],
        help="simulators: all, at 1 s, longer and in batches, and the default network on a batch to train on; training: "
        "where the time of a step on 8 clips of 2 s goes; scan: the selective scan against other ways to run it",
    )
    sub.add_argument("--repeats", type=count, default=7, help="counted rounds")
    sub.add_argument(
        "--limit",
        type=positive,
        default=2.0,
        help="seconds that one timing of a longer clip or larger batch may take; those that would take more are left out",
    )
    sub.add_argument(
        "--simulator", action="append", help="a Neuro-MSBG, by name or folder; by default all that ship"
    )
    sub.add_argument(
        "--only", nargs="+", default=[], metavar="NAME", help="rows whose names hold one of these words"
    )
    sub.add_argument(
        "--brief", action="store_true", help="one second at batch 1 alone: no longer clips, no larger batches"
    )
    sub.add_argument("--json", type=Path, help="also write the figures to this file, as they come")


def _benchmark(options: argparse.Namespace) -> None:
    from compensators import MappingCompensator
    from hlsim.benchmark.machine import about
    from hlsim.benchmark.run import BATCHES, LENGTHS, TRAINING, benchmark
    from hlsim.benchmark.tables import benchmark_markdown
    from hlsim.benchmark.timing import attempt
    from hlsim.benchmark.training import scan_rows, training_step

    device, repeats = options.device, options.repeats
    result = about(device, repeats) | {"skipped": []}

    def keep(more: dict[str, Any]) -> None:
        result.update(more)
        if options.json is not None:  # what is measured is not to wait for what may yet fail
            write_whole(options.json, json.dumps(result, indent=2) + "\n")

    def table(name: str, measure: Callable[[], tuple[list[dict[str, Any]], list[str]]]) -> None:
        rows, skipped = measure()
        result[name] = rows
        result["skipped"] += skipped

    if "simulators" in options.what:
        benchmark(
            device=device,
            repeats=repeats,
            limit=options.limit,
            simulators=options.simulator,
            only=options.only,
            lengths=() if options.brief else LENGTHS,
            batches=() if options.brief else BATCHES,
            training=None if options.brief else TRAINING,
            progress=_Progress(),
            keep=keep,
        )
        print(file=sys.stderr)
    tables = {
        "training": (
            "a training step",
            lambda: training_step(MappingCompensator(), device=device, repeats=repeats),
        ),
        "scan": ("the selective scan", lambda: scan_rows(device=device, repeats=repeats)),
    }
    for name, (title, measure) in tables.items():
        if name in options.what:
            print(f"{title} ...", file=sys.stderr)
            attempt(title, partial(table, name, measure), torch.device(device), result["skipped"])
            keep({})
    print(benchmark_markdown(result))


class _Progress:
    """A line on standard error, with the time that is left by how long the cells so far took."""

    def __init__(self) -> None:
        self.start = time.monotonic()

    def __call__(self, done: int, total: int, text: str) -> None:
        elapsed = time.monotonic() - self.start
        left = f", about {elapsed / (done - 1) * (total - done + 1):.0f} s left" if done > 1 else ""
        print(f"\r{done} of {total}{left}: {text}".ljust(100)[:100], end="", file=sys.stderr, flush=True)
