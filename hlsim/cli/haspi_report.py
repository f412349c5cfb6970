"""The command ``haspi-report``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from hlsim.cli.inputs import check_there, need, read_ear
from hlsim.cli.options import EARS_TABLE, Parser, natural, passed, positive
from hlsim.cli.progress import show_progress


def haspi_report(parser: Parser) -> None:
    parser.set_defaults(run=_haspi_report)
    option = parser.option
    option("--clean", Path, "folder of clean speech; the file names are the same in all three")
    option("--before", Path, "folder of what the ear was given")
    option("--after", Path, "folder of what it is given now")
    text = (
        "in place of the folders: CSV with columns condition, clean, processed, and listener, ear, snr, hl_250, ... or "
        "audiogram, spl or full_scale_spl where known"
    )
    option("--manifest", Path, text)
    option("--root", Path, "folder of the manifest's paths; its own folder by default")
    parser.audiogram(text=", for all files, or of a manifest for rows that bring none")
    text = "; and a column file (folders) or columns listener and ear (manifest, for rows without)"
    option("--audiograms", Path, EARS_TABLE + text)
    option("--measures", str, "of haspi, hasqi, stoi, pesq, separated by commas; the first leads", "haspi")
    option("--baseline", str, "condition that all others are compared with; all pairs by default")
    level = parser.add_mutually_exclusive_group()
    parser.full_scale(group=level)
    text = "level of each clean file in dB SPL, in place of --full-scale-spl; of a manifest for rows that bring none"
    option("--spl", positive, text, group=level)
    option("--scores", Path, "file of scores made so far; OUT/scores.jsonl by default")
    parser.parallel()
    option("--listen", natural, "items with players in report.html", 3)
    parser.seed()
    parser.out()


def _haspi_report(options: argparse.Namespace) -> None:
    measures = [name.strip() for name in options.measures.split(",")]
    need("eval", "joblib", "matplotlib", *(["clarity"] if {"haspi", "hasqi"} & {*measures} else []))
    check_there(
        folders=(options.clean, options.before, options.after, options.root),
        files=(options.manifest, options.audiograms),
    )
    from hlsim.evaluation import haspi_report, score_items
    from hlsim.report.haspi import markdown, write_report
    from hlsim.report.page import check_out

    instead = {
        "audiogram": read_ear(options.audiogram) if options.audiogram else None,
        "measures": measures,
        "store": options.scores or check_out(options.out) / "scores.jsonl",
        "progress": show_progress("scores"),
    }
    report = haspi_report(**passed(options, haspi_report, score_items, **instead))
    write_report(report, options.out, listen=options.listen)
    print(markdown(report))
    if report.failures:
        made = sum(len(own) for item in report.items for own in item.scores.values())
        print(
            f"hlsim: {len(report.failures)} of {made + len(report.failures)} scores could not be made; "
            f"the reasons are in {options.out / 'report.md'}",
            file=sys.stderr,
        )
