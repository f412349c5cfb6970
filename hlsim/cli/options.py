"""How a command's options are declared, those that several share, and the kinds of values; nothing here imports torch."""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any, NoReturn

STANDARD_EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "N7", "S1", "S2", "S3")

TEACHERS = ("msbg", "pyclarity")

EARS_TABLE = (
    "CSV with columns hl_250, hl_500, ... hl_8000 in dB HL; where one of the eight is missing its level is interpolated "
    "over log frequency, flat beyond the ends"
)


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage; its commands' parsers are of this class too.

    Args:
        declare: declares the options, once the command is named.
    """

    def __init__(self, *, declare: Callable[[Parser], None] | None = None, **settings: Any) -> None:
        super().__init__(**settings)
        # as from Python 3.14 on: no option begins with a digit, so that -10,0 and -2.5e1 are values
        self._negative_number_matcher = re.compile(r"-\.?\d")
        self._declare = declare
        self._examples: tuple[str, ...] = ()

    def runs(self, run: Callable[[argparse.Namespace], None], *examples: str) -> None:
        """What the command does with its options, and arguments that the help ends with."""
        self.set_defaults(run=run)
        self._examples = examples

    def format_help(self) -> str:
        lines = [f"  {self.prog} {example}".rstrip() + "\n" for example in self._examples]
        return super().format_help() + "".join(["\nexamples:\n", *lines] if lines else [])

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        if self._declare is not None:
            declare, self._declare = self._declare, None
            declare(self)
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:  # here, not in the program's own parser, so that the command is named
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}; see {self.prog} --help\n")

    def option(
        self,
        name: str,
        kind: Callable[[str], Any],
        text: str,
        default: Any = None,
        *,
        group: argparse._ActionsContainer | None = None,
        **more: Any,
    ) -> None:
        """An option or, without dashes, an argument; the help says that it is required, or its default."""
        if more.get("required"):
            text += " (required)"
        elif default not in (None, []):
            values = default if isinstance(default, list | tuple) else [default]
            shown = (" " if "nargs" in more else ",").join(
                f"{value:g}" if isinstance(value, float) else str(value) for value in values
            )
            text += f" (default: {shown})"
        if name.startswith("-"):
            more["default"] = default
        (group or self).add_argument(name, type=kind, help=text, **more)

    def flag(self, name: str, text: str) -> None:
        self.add_argument(name, action="store_true", help=text)

    # what several commands take

    def teacher(self, text: str, default: str) -> None:
        help_ = (
            f"{text}: msbg (exact), pyclarity, or anyone's simulator, package.module:name, found from the working "
            "directory too: a callable (waveform, audiogram) -> waveform or its class, time-aligned, of (items, time) in "
            "pascals and (items, 8) in dB HL, at its attribute sample_rate or else 16000 Hz"
        )
        self.option("--teacher", teacher_name, help_, default, metavar="NAME")

    def audiogram(self, default: str | None = None, text: str = "", **more: Any) -> None:
        help_ = (
            "NH, N1 to N7 (simulators and trained compensators take up to N6), S1 to S3, or eight levels in dB HL at "
            f"250, 500, 1000, 2000, 3000, 4000, 6000, 8000 Hz, separated by commas{text}"
        )
        self.option("--audiogram", str, help_, default, **more)

    def listener(self, text: str, **more: Any) -> None:
        file = (
            "a CSV file with columns listener, ear (left or right), hl_250, ..., or Clarity's listeners.json; FILE:NAME "
            "of one with several listeners"
        )
        self.option("--listener", str, f"{text}: {file}", metavar="FILE[:NAME]", **more)

    def full_scale(self, **more: Any) -> None:
        self.option(
            "--full-scale-spl", number, "level in dB SPL of a file whose RMS is 1.0", 94.0, **more
        )

    def sliders(self) -> None:
        for name in ("--noise-reduction", "--amplification"):
            self.option(name, slider, "of a hearing aid, 0 to 1; 1 by default")

    def engine(self) -> None:
        text = "what computes HASPI and HASQI: hlsim, with pyclarity's figures, or pyclarity itself, which is slower"
        self.option("--engine", str, text, "hlsim", choices=("hlsim", "pyclarity"))

    def jobs(self) -> None:
        self.option("--jobs", count, "processes; all cores by default")

    def parallel(self) -> None:
        self.jobs()
        self.option(
            "--backend", str, "this machine, or a cluster", "loky", choices=("loky", "dask")
        )
        self.option("--scheduler", str, "of --backend dask: its address, such as tcp://host:8786")

    def seed(self) -> None:
        self.option("--seed", integer, "of every random draw", 0)

    def out(self) -> None:
        self.option("--out", folder, "folder for the results", required=True)


def passed(
    options: argparse.Namespace, *functions: Callable[..., Any], **instead: Any
) -> dict[str, Any]:
    """The options that are arguments of the functions, by their names, and what is given in the place of some."""
    names = {name for function in functions for name in signature(function).parameters}
    return {name: value for name, value in vars(options).items() if name in names} | instead


def kind(
    read: Callable[[str], Any], fits: Callable[[Any], bool], allowed: str
) -> Callable[[str], Any]:
    """Reads a value that ``fits``, and refuses any other with what is allowed."""

    def value_of(text: str) -> Any:
        with suppress(ValueError):
            if fits(value := read(text)):
                return value
        raise argparse.ArgumentTypeError(f"{text}; allowed: {allowed}")

    return value_of


number = kind(float, math.isfinite, "numbers such as 65 or 2.5")
positive = kind(float, lambda value: 0 < value < math.inf, "numbers above 0")
slider = kind(float, lambda value: 0 <= value <= 1, "0 to 1")
integer = kind(int, lambda value: True, "whole numbers")
count = kind(int, lambda value: value >= 1, "whole numbers from 1 up")
natural = kind(int, lambda value: value >= 0, "whole numbers from 0 up")
_FOREIGN = re.compile(r"\w+(\.\w+)*:\w+")
foreign_name = kind(str, lambda text: bool(_FOREIGN.fullmatch(text)), "package.module:name")
teacher_name = kind(
    str,
    lambda text: text in TEACHERS or bool(_FOREIGN.fullmatch(text)),
    f"{', '.join(TEACHERS)}, or package.module:name",
)
numbers = kind(
    lambda text: tuple(map(float, text.split(","))),
    lambda values: all(map(math.isfinite, values)),
    "numbers separated by commas, such as 0,2.5,5",
)
shares = kind(
    lambda text: {
        name.strip(): float(value)
        for name, _, value in (part.partition("=") for part in text.split(","))
    },
    lambda pairs: all(map(math.isfinite, pairs.values())),
    "severities with a number each, such as mild=1,severe=2",
)


def folder(text: str) -> Path:
    """Where results go, there or not: one that cannot be is to be known before hours of work."""
    path = Path(text)
    there = next(
        part for part in (path.absolute(), *path.absolute().parents) if os.path.lexists(part)
    )
    if not there.is_dir():
        raise argparse.ArgumentTypeError(f"{there}: not a folder; allowed: a folder, there or not")
    if not os.access(there, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(
            f"{there}: no permission to write there; allowed: a folder of one's own"
        )
    return path
