"""Options that several commands share, and how their values are read."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from compensators import trained_for
from hlsim.audiogram import Audiogram
from hlsim.extras import require
from hlsim.msbg import MSBG
from hlsim.pretrained import load_pretrained

Commands = Any
"""What ``argparse.ArgumentParser.add_subparsers`` returns; its type has no public name."""

EARS_TABLE = (
    "CSV with columns hl_250, hl_500, ... hl_8000 in dB HL; where one of the eight is missing its level is interpolated "
    "over log frequency, flat beyond the ends"
)


def add_command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], None], text: str
) -> argparse.ArgumentParser:
    """A command ``name`` of the program, which ``run`` carries out."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name, help=text, description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.set_defaults(run=run)
    return parser


def audiogram_option(
    parser: argparse.ArgumentParser, *, default: str | None = None, required: bool = False, text: str = ""
) -> None:
    parser.add_argument(
        "--audiogram",
        default=default,
        required=required,
        help="NH, N1 to N7 (simulators and trained compensators take up to N6), S1 to S3, or eight levels in dB HL at "
        f"250, 500, 1000, 2000, 3000, 4000, 6000, 8000 Hz, separated by commas{text}",
    )


def out_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=folder, required=True, help="folder for the results")


def seed_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=integer, default=0, help="of every random draw")


def full_scale_option(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--full-scale-spl", type=number, default=94.0, help="level in dB SPL of a file whose RMS is 1.0"
    )


def folder(text: str) -> Path:
    """Where results go, there or not: one that cannot be is to be known before hours of work."""
    path = Path(text)
    there = next(part for part in (path.absolute(), *path.absolute().parents) if part.exists())
    if not there.is_dir():
        raise argparse.ArgumentTypeError(f"{there}: not a folder; allowed: a folder, there or not")
    if not os.access(there, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(
            f"{there}: no permission to write there; allowed: a folder of one's own"
        )
    return path


def check_files(source: Path, target: Path) -> None:
    """Refuse an IN and OUT that would end in nothing after the work, or in the loss of IN."""
    if source.is_dir():
        raise ValueError(f"{source}: a folder; allowed: one file, wav, flac or ogg")
    if not target.parent.is_dir():
        found = "not a folder" if target.parent.exists() else "no such folder"
        raise ValueError(f"{target.parent}: {found}; allowed: an OUT in a folder that is there")
    if source.exists() and target.exists() and target.samefile(source):
        raise ValueError(f"{target}: OUT is IN itself; allowed: another file, for IN would be lost")


def number(text: str) -> float:
    value = _float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text}; allowed: numbers such as 65 or 2.5")
    return value


def positive(text: str) -> float:
    value = _float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text}; allowed: numbers above 0")
    return value


def _float(text: str) -> float:
    """NaN where it is no number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}; allowed: whole numbers") from None


def count(text: str) -> int:
    return _whole(text, 1)


def natural(text: str) -> int:
    return _whole(text, 0)


def _whole(text: str, least: int) -> int:
    if not text.strip().isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"{text}; allowed: whole numbers from {least} up")
    return int(text)


def read_ear(text: str) -> Audiogram:
    """An ear from what ``--audiogram`` holds."""
    if "," not in text:
        return Audiogram.standard(text)
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(
            f"--audiogram {text}; allowed: a standard ear such as N3, or eight numbers in dB HL separated by commas"
        ) from None
    try:
        return Audiogram(levels)
    except ValueError as error:
        raise ValueError(f"--audiogram {text}: {error}") from error


def other_ear(label: str, name: str, ear: Audiogram | None) -> list[str]:
    """What there is to say of a compensator that was trained for one ear and is given another, or several (None)."""
    own = trained_for(name)
    if own is None or (ear is not None and own.thresholds == ear.thresholds):
        return []
    levels = ", ".join(f"{level:g}" for level in own.thresholds)
    return [f"{label} was trained for one ear, {levels} dB HL, and is meant for no other."]


def read_simulator(name: str, sample_rate: int, full_scale_spl: float = 94.0) -> torch.nn.Module:
    options: dict[str, Any] = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
    return MSBG(**options) if name == "msbg" else load_pretrained(name, **options)


def read_recipe(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    yaml = require("yaml", "train")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not readable as YAML ({error})") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: holds no settings; allowed: 'name: value' lines")
    return data


def show_progress(what: str) -> Callable[[int, int], None]:
    """Print how many are done and when the rest will be, on one line of stderr.

    The end is told from the pace since the first call, so that what was done by an earlier run does not count.
    """
    first: tuple[int, float] | None = None

    def show(done: int, total: int) -> None:
        nonlocal first
        now = time.time()
        first = first or (done, now)
        text = f"{done} of {total} {what}"
        if first[0] < done < total:
            left = (now - first[1]) / (done - first[0]) * (total - done)
            clock = time.strftime("%a %H:%M:%S", time.localtime(now + left))
            text += f", ends about {clock} (in {left / 60:.1f} min)"
        print(f"\r{text:<70}", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return show
