"""The command ``demo``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.inputs import check_extras
from hlsim.cli.options import Parser, count, input_folder, integer, output_folder
from hlsim.cli.progress import show_progress


def demo(parser: Parser) -> None:
    """Declare the options of the command ``demo``."""
    parser.set_command(_demo, "", "--audiogram S2 --steps 1000 --out s2")
    text = "folder for report, audio and pictures"
    parser.option("--out", output_folder, text, Path("hlsim-demo"))
    parser.audiogram("N4")
    text = "folder of 22 files or more instead of the bundled speech; a third is scored"
    parser.option("--speech", input_folder, text)
    parser.option("--steps", count, "training steps; 3000 take about three minutes", 3000)
    parser.option("--seed", integer, "seed of every random draw", 0)


def _demo(options: argparse.Namespace) -> None:
    check_extras("train", "eval")
    from hlsim.audiogram.conversion import as_audiogram
    from hlsim.demo import demo

    summary = demo(
        options.out,
        as_audiogram(options.audiogram),
        speech=options.speech,
        steps=options.steps,
        seed=options.seed,
        jobs=None,
        progress=show_progress("scores"),
    )
    print(summary)
