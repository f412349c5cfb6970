"""The command ``evaluate-simulator``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.options import (
    EARS_TABLE,
    Commands,
    add_command,
    count,
    number,
    out_option,
    positive,
    read_simulator,
    seed_option,
    show_progress,
)
from hlsim.extras import require


def add(commands: Commands) -> None:
    sub = add_command(
        commands,
        "evaluate-simulator",
        _evaluate_simulator,
        "compare simulators with MSBG: SNR, STOI, PESQ, bands",
    )
    sub.add_argument(
        "names", nargs="+", metavar="NAME", help="checkpoints, by name or folder, or msbg (exact)"
    )
    sub.add_argument("--speech", type=Path, required=True, help="folder of clean speech")
    sub.add_argument("--audiograms", type=Path, required=True, help=EARS_TABLE)
    sub.add_argument("--noise", type=Path, help="folder of noises; every second item is then noisy")
    sub.add_argument(
        "--teacher", choices=("pyclarity", "msbg"), default="pyclarity", help="what counts as the truth"
    )
    sub.add_argument(
        "--levels",
        type=number,
        nargs="+",
        default=[50, 60, 65, 70, 80],
        help="dB SPL that items take in turn",
    )
    sub.add_argument(
        "--inputs",
        nargs="+",
        default=["as-is"],
        metavar="INPUT",
        help="what the ear is given: as-is, louder (20 dB), nal-r, compressed (3:1), compensated",
    )
    sub.add_argument("--compensator", help="its name or folder, for the input compensated")
    sub.add_argument("--items", type=count, default=240, help="how many")
    sub.add_argument("--seconds", type=positive, default=3.0, help="length of an item")
    seed_option(sub)
    out_option(sub)


def _evaluate_simulator(options: argparse.Namespace) -> None:
    if len(set(options.names)) < len(options.names):
        raise ValueError(f"simulators {', '.join(options.names)}; allowed: each once")
    if options.compensator and "compensated" not in options.inputs:
        raise ValueError("--compensator without --inputs compensated; allowed: only with it")
    for module in ("clarity", "pystoi", "pesq", "matplotlib"):
        require(module, "eval")
    from compensators import load_compensator
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.neuro.config import NEURO_RATE
    from hlsim.report.page import check_out
    from hlsim.report.simulators import write_fidelity

    done = evaluate_simulators(
        {name: read_simulator(name, NEURO_RATE) for name in options.names},
        speech=options.speech,
        audiograms=options.audiograms,
        noise=options.noise,
        store=check_out(options.out) / "scores.jsonl",
        teacher=options.teacher,
        items=options.items,
        seconds=options.seconds,
        levels=options.levels,
        inputs=options.inputs,
        compensator=load_compensator(options.compensator) if options.compensator else None,
        seed=options.seed,
        progress=show_progress("items"),
    )
    write_fidelity(done.result, done.heard, done.shown, options.out)
    print((options.out / "fidelity.md").read_text(encoding="utf-8"))
