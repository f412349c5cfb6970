"""The command ``demo``, which trains an aid for one ear and writes a page about it."""

import argparse
from pathlib import Path

from hlsim.cli.inputs import check_extras, use_one_thread
from hlsim.cli.options import Parser, count


def demo(parser: Parser) -> None:
    """Declare the options of the command ``demo``."""
    parser.set_command(_demo, "", "--audiogram S2 --steps 1000 --out s2")
    parser.option("--out", Path, "folder for the page and the checkpoint", Path("hlsim-demo"))
    parser.audiogram("N4")
    parser.option("--steps", count, "training steps", 1000)


def _demo(options: argparse.Namespace) -> None:
    use_one_thread()
    check_extras("train", "eval")
    from hlsim.audiogram import as_audiogram
    from hlsim.cli.demo_run import run_demo

    ear = as_audiogram(options.audiogram)
    print(run_demo(options.out, ear, steps=options.steps))
