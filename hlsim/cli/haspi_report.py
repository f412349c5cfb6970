"""The command ``haspi-report``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hlsim.cli.options import (
    EARS_TABLE,
    Commands,
    add_command,
    audiogram_option,
    count,
    full_scale_option,
    natural,
    out_option,
    positive,
    read_ear,
    seed_option,
    show_progress,
)
from hlsim.extras import require


def add(commands: Commands) -> None:
    sub = add_command(
        commands,
        "haspi-report",
        _haspi_report,
        "HASPI (HASQI, STOI, PESQ) before and after a treatment, with paired tests",
    )
    for name, text in (
        ("clean", "clean speech"),
        ("before", "what the ear was given"),
        ("after", "what it is given now"),
    ):
        sub.add_argument(f"--{name}", type=Path, help=f"folder of {text}; the file names are the same")
    sub.add_argument(
        "--manifest",
        type=Path,
        help="in place of the folders: CSV with columns condition, clean, processed, and listener, ear, snr, "
        "hl_250, ... or audiogram, spl or full_scale_spl where known",
    )
    sub.add_argument("--root", type=Path, help="folder of the manifest's paths; its own folder by default")
    audiogram_option(sub, default=None, text=", for all files, or of a manifest for rows that bring none")
    sub.add_argument(
        "--audiograms",
        type=Path,
        help=f"{EARS_TABLE}; and a column file (folders) or columns listener and ear (manifest, for rows without)",
    )
    sub.add_argument(
        "--measures",
        default="haspi",
        help="of haspi, hasqi, stoi, pesq, separated by commas; the first leads",
    )
    sub.add_argument("--baseline", help="condition that all others are compared with; all pairs by default")
    level = sub.add_mutually_exclusive_group()
    full_scale_option(level)
    level.add_argument(
        "--spl",
        type=positive,
        help="level of each clean file in dB SPL, in place of --full-scale-spl; of a manifest for rows that bring none",
    )
    sub.add_argument("--scores", type=Path, help="file of scores made so far; OUT/scores.jsonl by default")
    sub.add_argument("--jobs", type=count, help="processes; all cores by default")
    sub.add_argument("--backend", choices=("loky", "dask"), default="loky", help="this machine, or a cluster")
    sub.add_argument("--scheduler", help="of --backend dask: its address, such as tcp://host:8786")
    sub.add_argument("--listen", type=natural, default=3, help="items with players in report.html")
    seed_option(sub)
    out_option(sub)


def _haspi_report(options: argparse.Namespace) -> None:
    from hlsim.evaluation import haspi_report
    from hlsim.report.haspi import markdown, write_report
    from hlsim.report.page import check_out

    require("matplotlib", "eval")  # not after hours of scoring
    report = haspi_report(
        options.clean,
        options.before,
        options.after,
        read_ear(options.audiogram) if options.audiogram else None,
        audiograms=options.audiograms,
        manifest=options.manifest,
        root=options.root,
        measures=[name.strip() for name in options.measures.split(",")],
        baseline=options.baseline,
        store=options.scores or check_out(options.out) / "scores.jsonl",
        full_scale_spl=options.full_scale_spl,
        spl=options.spl,
        seed=options.seed,
        jobs=options.jobs,
        backend=options.backend,
        scheduler=options.scheduler,
        progress=show_progress("scores"),
    )
    write_report(report, options.out, listen=options.listen)
    print(markdown(report))
    if report.failures:
        made = sum(len(own) for item in report.items for own in item.scores.values())
        print(
            f"hlsim: {len(report.failures)} of {made + len(report.failures)} scores could not be made; "
            f"the reasons are in {options.out / 'report.md'}",
            file=sys.stderr,
        )
