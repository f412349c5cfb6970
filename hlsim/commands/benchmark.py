"""The command ``benchmark``."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from hlsim.commands.options import (
    Commands,
    add_command,
    count,
    positive,
)


def add(commands: Commands) -> None:
    sub = add_command(commands, "benchmark", _benchmark, "time the simulators side by side")
    sub.add_argument("--device", default="cpu", help="cpu or cuda")
    sub.add_argument("--seconds", type=positive, default=1.0, help="length of the clip")
    sub.add_argument("--repeats", type=count, default=9, help="counted rounds")
    sub.add_argument("--simulator", default="neuro-msbg", help="the Neuro-MSBG, by name or folder")
    sub.add_argument("--json", type=Path, help="also write the figures to this file")


def _benchmark(options: argparse.Namespace) -> None:
    from hlsim.evaluation.benchmark import benchmark, benchmark_markdown

    result = benchmark(
        device=options.device,
        seconds=options.seconds,
        repeats=options.repeats,
        simulator=options.simulator,
        progress=lambda line: print(f"\r{line}", end="", file=sys.stderr, flush=True),
    )
    print(file=sys.stderr)
    print(benchmark_markdown(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
