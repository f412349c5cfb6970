"""The command ``benchmark``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from hlsim.cli.options import Parser, count, positive
from hlsim.cli.progress import show_progress
from hlsim.files import write_whole

Measure = Callable[..., tuple[list[dict[str, Any]], list[str]]]


def benchmark(parser: Parser) -> None:
    parser.runs(
        _benchmark,
        "--brief",
        "--what training metrics --json figures.json",
    )
    option = parser.option
    option("--device", str, "cpu, cuda or cuda:1; pyclarity's Ear runs on the CPU always", "cpu")
    text = (
        "simulators: all, at 1 s, longer and in batches, and the default network on a batch to train on; training: "
        "where the time of a step on 8 clips of 2 s goes; metrics: HASPI and HASQI beside pyclarity's, on one thread"
    )
    what = ("simulators", "training", "metrics")
    option("--what", str, text, ["simulators"], nargs="+", choices=what)
    option("--repeats", count, "counted rounds", 7)
    text = "seconds that one timing of a longer clip or larger batch may take; those that would take more are left out"
    option("--limit", positive, text, 2.0)
    text = "a Neuro-MSBG, by name or folder; by default all that ship"
    option("--simulator", str, text, action="append")
    option("--only", str, "rows whose names hold one of these words", [], nargs="+", metavar="NAME")
    parser.flag("--brief", "one second at batch 1 alone: no longer clips, no larger batches")
    option("--json", Path, "also write the figures to this file, as they come")


def _benchmark(options: argparse.Namespace) -> None:
    import torch

    from hlsim.benchmark.parts import metric_rows, training_step
    from hlsim.benchmark.run import benchmark
    from hlsim.benchmark.tables import benchmark_markdown
    from hlsim.benchmark.timing import about, attempt

    device, repeats = options.device, options.repeats
    result = about(device, repeats) | {"skipped": []}

    def keep(more: dict[str, Any]) -> None:
        result.update(more)
        if options.json is not None:  # what is measured is not to wait for what may yet fail
            write_whole(options.json, json.dumps(result, indent=2) + "\n")

    if "simulators" in options.what:
        sizes: dict[str, Any] = (
            {"lengths": (), "batches": (), "training": None} if options.brief else {}
        )
        benchmark(
            device=device,
            repeats=repeats,
            limit=options.limit,
            simulators=options.simulator,
            only=options.only,
            progress=show_progress("timings"),
            keep=keep,
            **sizes,
        )

    def table(name: str, measure: Measure) -> None:
        rows, skipped = measure(device=device, repeats=repeats)
        result[name] = rows
        result["skipped"] += skipped

    tables: dict[str, tuple[str, Measure]] = {
        "training": ("a training step", training_step),
        "metrics": ("HASPI and HASQI", metric_rows),
    }
    for name, (title, measure) in tables.items():
        if name in options.what:
            print(f"{title} ...", file=sys.stderr)
            attempt(title, partial(table, name, measure), torch.device(device), result["skipped"])
            keep({})
    print(benchmark_markdown(result))
