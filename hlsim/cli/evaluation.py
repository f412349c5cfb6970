"""The command ``evaluate-simulator``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.inputs import check_there, need, read_simulator
from hlsim.cli.options import EARS_TABLE, Parser, count, number, passed, positive
from hlsim.cli.progress import show_progress


def evaluate_simulator(parser: Parser) -> None:
    parser.set_defaults(run=_evaluate_simulator)
    option = parser.option
    option("names", str, "checkpoints, by name or folder, or msbg (exact)", nargs="+", metavar="NAME")
    option("--speech", Path, "folder of clean speech", required=True)
    option("--audiograms", Path, EARS_TABLE, required=True)
    option("--noise", Path, "folder of noises; every second item is then noisy")
    option("--teacher", str, "what counts as the reference", "pyclarity", choices=("pyclarity", "msbg"))
    option("--levels", number, "dB SPL that items take in turn", [50, 60, 65, 70, 80], nargs="+")
    text = "what the ear is given: as-is, louder (20 dB), nal-r, compressed (3:1), compensated"
    option("--inputs", str, text, ["as-is"], nargs="+", metavar="INPUT")
    option("--compensator", str, "its name or folder, for the input compensated")
    option("--items", count, "how many", 240)
    option("--seconds", positive, "length of an item", 3.0)
    parser.seed()
    parser.out()


def _evaluate_simulator(options: argparse.Namespace) -> None:
    if len(set(options.names)) < len(options.names):
        raise ValueError(f"simulators {', '.join(options.names)}; allowed: each once")
    if options.compensator and "compensated" not in options.inputs:
        raise ValueError("--compensator without --inputs compensated; allowed: only with it")
    need("eval", "clarity", "pystoi", "pesq", "matplotlib")
    check_there(folders=(options.speech, options.noise), files=(options.audiograms,))
    from compensators import load_compensator
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.neuro.config import NEURO_RATE
    from hlsim.report.page import check_out
    from hlsim.report.simulators import write_fidelity

    instead = {
        "store": check_out(options.out) / "scores.jsonl",
        "compensator": load_compensator(options.compensator) if options.compensator else None,
        "progress": show_progress("items"),
    }
    simulators = {name: read_simulator(name, NEURO_RATE) for name in options.names}
    done = evaluate_simulators(simulators, **passed(options, evaluate_simulators, **instead))
    write_fidelity(done.result, done.heard, done.shown, options.out)
    print((options.out / "fidelity.md").read_text(encoding="utf-8"))
