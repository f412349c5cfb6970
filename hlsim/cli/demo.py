"""The command ``demo``."""

from __future__ import annotations

import argparse
from pathlib import Path

from hlsim.cli.options import Commands, add_command, audiogram_option, folder, positive, read_ear, seed_option
from hlsim.extras import require
from hlsim.torchtools import keep_freed_memory


def add(commands: Commands) -> None:
    sub = add_command(
        commands,
        "demo",
        _demo,
        "train a compensator for one ear on the embedded speech and score it by HASPI",
    )
    sub.add_argument(
        "--out", type=folder, default=Path("hlsim-demo"), help="folder for report, audio and pictures"
    )
    audiogram_option(sub, default="N4")
    sub.add_argument(
        "--speech",
        type=Path,
        help="folder of 22 files or more instead of the embedded speech; a third is scored",
    )
    sub.add_argument("--minutes", type=positive, default=3.0, help="of training")
    seed_option(sub)


def _demo(options: argparse.Namespace) -> None:
    for module, extra in (
        ("lightning", "train"),
        ("tensorboard", "train"),
        ("clarity", "eval"),
        ("matplotlib", "eval"),
    ):
        require(module, extra)
    keep_freed_memory()
    from hlsim.demo import demo

    report = demo(
        options.out,
        read_ear(options.audiogram),
        speech=options.speech,
        minutes=options.minutes,
        seed=options.seed,
    )
    print(report)
