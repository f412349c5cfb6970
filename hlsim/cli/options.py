"""The parser of the command line, and the options that several commands have.

This module does not import torch, so that ``--help`` takes a fraction of a second.
"""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

TypedEar = str | tuple[float, ...] | dict[float, float]
"""An ear of a command line: its name, its eight levels, or frequencies with levels."""

STANDARD_EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "N7", "S1", "S2", "S3")
"""Names of the standard ears, as in ``hlsim.audiogram``."""

EARS_TABLE = (
    "CSV file of ears with columns hl_250, hl_500, ... in dB HL, an empty value where a frequency "
    "was not measured; or standard for Bisgaard's ears N1 to N6 and S1 to S3"
)
"""Help text of options that take a table of ears."""


class Parser(argparse.ArgumentParser):
    """Parser of the program and of each command, whose errors are one line without the usage.

    Args:
        declare: Function that declares the options of a command on this parser. It is called only
            when the command is used, so that other commands do not import its module.
        settings: Arguments of ``argparse.ArgumentParser``.
    """

    def __init__(self, *, declare: Callable[[Parser], None] | None = None, **settings: Any) -> None:
        super().__init__(**settings)
        self._declare = declare
        self._examples: tuple[str, ...] = ()
        self._prefixes: tuple[str, ...] = ()
        self._required: Any = None
        # argparse would take a value such as -10,0,20 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def set_command(self, run: Callable[[argparse.Namespace], None], *examples: str) -> None:
        """Set the function that runs the command, and the examples in the help.

        Args:
            run: Function of the parsed options.
            examples: Options of each example, without the name of the command.
        """
        self.set_defaults(run=run)
        self._examples = examples

    def accept_prefixes(self, *prefixes: str) -> None:
        """Accept options that are not declared if their names begin with one of the prefixes.

        The parsed options contain them, with their values, as the list ``undeclared``.
        """
        self.set_defaults(undeclared=[])
        self._prefixes = prefixes

    def format_help(self) -> str:
        text = super().format_help()
        if self._examples:
            lines = [f"  {self.prog} {example}".rstrip() for example in self._examples]
            text += "\nexamples:\n" + "\n".join(lines) + "\n"
        return text

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        if self._declare is not None:
            declare = self._declare
            self._declare = None
            declare(self)
        options, unknown = super().parse_known_args(args, namespace)
        if unknown and unknown[0].startswith(self._prefixes):
            options.undeclared = unknown
            unknown = []
        if unknown:
            # The parser of the program would report them as well, but without the command's name.
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}; see {self.prog} --help\n")

    def option(
        self,
        name: str,
        kind: Callable[[str], Any],
        text: str,
        default: Any = None,
        *,
        group: Any = None,
        **settings: Any,
    ) -> None:
        """Declare an option or, if the name has no dashes, a positional argument.

        Required options have a group of their own in the help.

        Args:
            name: Name, such as ``--speech``; without dashes for a positional argument.
            kind: Function that converts the text of the command line to a value, such as ``count``.
            text: Description for the help, which adds the default.
            default: Value if the option is missing.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
            settings: Further arguments of ``argparse.ArgumentParser.add_argument``.
        """
        if settings.get("required"):
            group = self._required = self._required or self.add_argument_group("required options")
        elif default not in (None, []):
            separator = " " if "nargs" in settings else ","
            text += f" (default: {_format_default(default, separator)})"
        if name.startswith("-"):
            settings["default"] = default
        if "choices" not in settings and kind in _METAVARS:
            settings.setdefault("metavar", _METAVARS[kind])
        (group or self).add_argument(name, type=kind, help=text, **settings)

    def flag(self, name: str, text: str, group: Any = None) -> None:
        """Declare an option without a value, which is True if a user gives it and otherwise False.

        Args:
            name: Name, such as ``--json``.
            text: Description for the help.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
        """
        (group or self).add_argument(name, action="store_true", help=text)

    def teacher(self, text: str, default: str) -> None:
        """Declare ``--teacher``, a simulator with which others are compared or which they learn.

        Args:
            text: Beginning of the help text.
            default: Value if the option is missing.
        """
        help_ = (
            f"{text}: msbg (exact), or your own simulator as package.module:name or "
            "path/to/file.py:name, a function (waveform, audiogram) -> waveform or a class that is "
            "constructed without arguments and whose objects are such functions; waveforms "
            "(items, time) are in pascals, audiograms (items, 8) in dB HL, and the sample rate is "
            "its attribute sample_rate or else 16000 Hz"
        )
        self.option("--teacher", teacher_name, help_, default, metavar="NAME")

    def audiogram(self, default: str | None = None, text: str = "", group: Any = None) -> None:
        """Declare ``--audiogram``, the thresholds of one ear.

        Args:
            default: Value if the option is missing, such as ``N3``.
            text: End of the help text.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
        """
        help_ = (
            "NH, N1 to N7, S1 to S3; eight levels in dB HL at 250, 500, 1000, 2000, 3000, 4000, "
            "6000 and 8000 Hz, separated by commas; or frequencies in Hz with levels, such as "
            f"500:30,1000:40,4000:60{text}"
        )
        self.option("--audiogram", ear, help_, default, group=group)

    def listener(self, text: str, group: Any) -> None:
        """Declare ``--listener``, a file with the audiograms of a person's two ears.

        Users type ``--listener FILE``, or ``--listener FILE:NAME`` for one of several persons.

        Args:
            text: Beginning of the help text.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
        """
        help_ = (
            f"{text}: a CSV file with columns listener, ear (left or right), hl_250, ..., or "
            "Clarity's listeners.json; write FILE:NAME if the file holds several listeners"
        )
        self.option("--listener", str, help_, group=group, metavar="FILE[:NAME]")

    def levels(self, signal: str) -> None:
        """Declare ``--full-scale-spl`` and ``--spl``, of which a user sets at most one.

        The first is the level in dB SPL of a file whose RMS is 1.0. The second is the level of each
        signal, whatever its RMS.

        Args:
            signal: Noun for the signal whose level is ``--spl``, for the help text.
        """
        group = self.add_mutually_exclusive_group()
        text = "level in dB SPL of a file whose RMS is 1.0"
        self.option("--full-scale-spl", number, text, 94.0, group=group, metavar="DB")
        text = f"level in dB SPL of {signal}"
        self.option("--spl", positive_number, text, group=group, metavar="DB")

    def linked(self, condition: str) -> None:
        """Declare ``--linked``, which gives both ears the same gains.

        Args:
            condition: Beginning of the restriction in the help text, such as "stereo files; ".
        """
        text = f"link the gains of both ears ({condition}hearing aids and wdrc only)"
        self.flag("--linked", text)

    def enhancers(self, waveforms: str) -> None:
        """Declare ``--enhancer``, noise reductions of the user.

        Args:
            waveforms: Shape and unit of their input and output, for the help text.
        """
        text = (
            "noise reduction of your own before each aid, package.module:name or "
            "path/to/file.py:name: a callable (waveform, sample_rate) -> waveform or its class, "
            f"for {waveforms}"
        )
        settings = {"nargs": "+", "metavar": "NAME", "dest": "enhancers"}
        self.option("--enhancer", plugin_name, text, [], **settings)

    def sliders(self) -> None:
        """Declare ``--noise-reduction`` and ``--amplification``, the sliders of a hearing aid."""
        text = "strength of a hearing aid's noise reduction, 0 to 1 (default: 0.5)"
        self.option("--noise-reduction", fraction, text)
        text = "strength of a hearing aid's amplification, 0 to 1 (default: 1)"
        self.option("--amplification", fraction, text)


def _format_default(default: Any, separator: str) -> str:
    """Format a default value, or the values of a list, for the help."""
    values = default if isinstance(default, list | tuple) else [default]
    texts = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    return separator.join(texts)


def checked_type(
    read: Callable[[str], Any], accepts: Callable[[Any], bool], expected: str
) -> Callable[[str], Any]:
    """Make a function that converts the text of an option to a value and validates it.

    Args:
        read: Function that converts the text; it raises ValueError for text that it cannot convert.
        accepts: Function that returns whether a value is valid.
        expected: Description of valid values, for the error message.

    Returns:
        Function from a text to its value. For an invalid text it raises ``ArgumentTypeError``,
        which argparse reports as an error of one line.
    """

    def read_value(text: str) -> Any:
        with suppress(ValueError):
            value = read(text)
            if accepts(value):
                return value
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")

    return read_value


def _read_ear(text: str) -> TypedEar:
    """Return the name of a standard ear, eight levels, or frequencies with their levels."""
    if text.upper() in STANDARD_EARS:
        return text.upper()
    parts = re.split(r"[,\s]+", text.strip())
    if ":" in text:
        points = [part.split(":") for part in parts]
        return {float(frequency): float(level) for frequency, level in points}
    return tuple(float(part) for part in parts)


def _is_ear(value: TypedEar) -> bool:
    """Return whether a value is a name, or levels in the range of an audiogram."""
    if isinstance(value, str):
        return True
    levels = value.values() if isinstance(value, dict) else value
    is_complete = isinstance(value, dict) or len(value) == 8
    return is_complete and all(-10.0 <= level <= 120.0 for level in levels)


def _can_be_created(path: Path) -> bool:
    """Return whether a folder exists and is writable, or can be created."""
    existing = path.absolute()
    while not os.path.lexists(existing):
        existing = existing.parent
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


_PLUGIN = re.compile(r".+:\w+")

number = checked_type(float, math.isfinite, "a number such as 65 or 2.5")
positive_number = checked_type(float, lambda value: 0 < value < math.inf, "a number above 0")
fraction = checked_type(float, lambda value: 0 <= value <= 1, "a number from 0 to 1")
integer = checked_type(int, lambda value: True, "a whole number")
count = checked_type(int, lambda value: value >= 1, "a whole number, 1 or more")
count_or_zero = checked_type(int, lambda value: value >= 0, "a whole number, 0 or more")
ear = checked_type(
    _read_ear,
    _is_ear,
    f"{', '.join(STANDARD_EARS)}, eight levels from -10 to 120 dB HL, or frequencies in Hz with "
    "levels such as 500:30,1000:40,4000:60",
)
plugin_name = checked_type(
    str, lambda text: bool(_PLUGIN.fullmatch(text)), "package.module:name or path/to/file.py:name"
)
teacher_name = checked_type(
    str,
    lambda text: text == "msbg" or bool(_PLUGIN.fullmatch(text)),
    "msbg, package.module:name or path/to/file.py:name",
)
input_path = checked_type(Path, lambda path: path.exists(), "an existing file or folder")
input_file = checked_type(Path, lambda path: path.exists(), "an existing file")
input_folder = checked_type(Path, lambda path: path.is_dir(), "an existing folder")
ears_table = checked_type(
    Path, lambda path: path.exists() or str(path) == "standard", "an existing file, or standard"
)
output_folder = checked_type(Path, _can_be_created, "a folder that you may write to")

_METAVARS: dict[Callable[[str], Any], str] = {
    input_path: "PATH",
    input_file: "FILE",
    input_folder: "FOLDER",
    ears_table: "FILE",
    output_folder: "FOLDER",
    Path: "FILE",
    str: "NAME",
    ear: "EAR",
    count: "N",
    count_or_zero: "N",
    integer: "N",
    number: "X",
    positive_number: "X",
    fraction: "X",
}
"""Placeholders of values in the help."""
