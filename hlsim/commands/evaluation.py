"""The commands ``evaluate-simulator`` and ``haspi-report``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.commands.options import (
    Commands,
    add_command,
    audiogram_option,
    count,
    full_scale_option,
    out_option,
    positive,
    read_ear,
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
    sub.add_argument(
        "--audiograms", type=Path, required=True, help="CSV with columns hl_250, hl_500, ... in dB HL"
    )
    sub.add_argument("--noise", type=Path, help="folder of noises; every second item is then noisy")
    sub.add_argument(
        "--teacher", choices=("pyclarity", "msbg"), default="pyclarity", help="what counts as the truth"
    )
    sub.add_argument("--items", type=count, default=240, help="how many")
    sub.add_argument("--seconds", type=positive, default=3.0, help="length of an item")
    seed_option(sub)
    out_option(sub)

    sub = add_command(
        commands, "haspi-report", _haspi_report, "HASPI before and after a treatment, with paired tests"
    )
    for name, text in (
        ("clean", "clean speech"),
        ("before", "what the ear was given"),
        ("after", "what it is given now"),
    ):
        sub.add_argument(
            f"--{name}", type=Path, required=True, help=f"folder of {text}; the file names are the same"
        )
    audiogram_option(sub, default=None, text=", for all files")
    sub.add_argument(
        "--audiograms", type=Path, help="CSV with columns file, hl_250, hl_500, ...: one row a file"
    )
    full_scale_option(sub)
    sub.add_argument("--jobs", type=count, help="processes; all cores by default")
    seed_option(sub)
    out_option(sub)


def _evaluate_simulator(options: argparse.Namespace) -> None:
    for module in ("clarity", "pystoi", "pesq"):
        require(module, "eval")
    from hlsim.evaluation.simulators import RATE, evaluate_simulators

    evaluate_simulators(
        {name: read_simulator(name, RATE) for name in options.names},
        speech=options.speech,
        audiograms=options.audiograms,
        noise=options.noise,
        out=options.out,
        teacher=options.teacher,
        items=options.items,
        seconds=options.seconds,
        seed=options.seed,
        progress=show_progress("items"),
    )
    print((options.out / "fidelity.md").read_text(encoding="utf-8"))


def _haspi_report(options: argparse.Namespace) -> None:
    from hlsim.evaluation import haspi_report

    report = haspi_report(
        options.clean,
        options.before,
        options.after,
        read_ear(options.audiogram) if options.audiogram else None,
        audiograms=options.audiograms,
        out=options.out,
        full_scale_spl=options.full_scale_spl,
        seed=options.seed,
        jobs=options.jobs,
        progress=show_progress("scores"),
    )
    print(report.to_markdown())
