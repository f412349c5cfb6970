"""The command ``demo``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.inputs import check_paths_exist, read_ear, require_installed
from hlsim.cli.options import Parser, count, folder, integer
from hlsim.cli.progress import show_progress
from hlsim.extras import require


def demo(parser: Parser) -> None:
    """Declare the options of ``demo``."""
    parser.set_command(_demo, "", "--audiogram S2 --steps 1000 --out s2")
    parser.option("--out", folder, "folder for report, audio and pictures", Path("hlsim-demo"))
    parser.audiogram("N4")
    text = "folder of 22 files or more instead of the bundled speech; a third is scored"
    parser.option("--speech", Path, text)
    parser.option("--steps", count, "training steps; 3000 take about three minutes", 3000)
    parser.option("--seed", integer, "seed of every random draw", 0)


def _demo(options: argparse.Namespace) -> None:
    require_installed("train", "lightning", "tensorboard")
    require_installed("eval", "joblib", "matplotlib")
    check_paths_exist(folders=(options.speech,))
    ear = read_ear(options.audiogram)
    require("lightning", "train")  # A broken installation is reported here.
    from hlsim.demo import demo

    summary = demo(
        options.out,
        ear,
        speech=options.speech,
        steps=options.steps,
        seed=options.seed,
        jobs=None,
        progress=show_progress("values"),
    )
    print(summary)
