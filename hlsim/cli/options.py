"""The parser of the command line, and the options that several commands have.

This module does not import torch, so that ``--help`` takes a fraction of a second.
"""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

STANDARD_EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "N7", "S1", "S2", "S3")
"""Names of the standard ears, as in ``hlsim.audiogram``."""

TEACHERS = ("msbg",)
"""Names of the teachers that are no plug-ins, as in ``hlsim.training.teacher``."""

EARS_TABLE = (
    "CSV file of ears with columns hl_250, hl_500, ... in dB HL, an empty value where a frequency "
    "was not measured; or standard for Bisgaard's ears N1 to N6 and S1 to S3"
)
"""Description of a table of ears, for the help."""

_NEGATIVE_LIST = re.compile(r"-\.?\d.*[,e]")


def join_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join an option and a value such as ``-10,0,20``, which argparse mistakes for an option.

    Args:
        arguments: Command and options.

    Returns:
        The arguments, with ``--option -10,0`` replaced by ``--option=-10,0``.
    """
    joined: list[str] = []
    for argument in arguments:
        previous = joined[-1] if joined else ""
        follows_option = previous.startswith("--") and "=" not in previous
        if follows_option and _NEGATIVE_LIST.match(argument):
            joined[-1] = f"{previous}={argument}"
        else:
            joined.append(argument)
    return joined


class Parser(argparse.ArgumentParser):
    """Parser of the program and of each command, whose errors are one line without the usage.

    Args:
        declare: Function that declares the options. It is called when the command is used.
        settings: Arguments of ``argparse.ArgumentParser``.
    """

    def __init__(self, *, declare: Callable[[Parser], None] | None = None, **settings: Any) -> None:
        super().__init__(**settings)
        self._declare = declare
        self._examples: tuple[str, ...] = ()
        self._prefixes: tuple[str, ...] = ()
        self._required: Any = None

    def set_command(self, run: Callable[[argparse.Namespace], None], *examples: str) -> None:
        """Set the function that runs the command, and the arguments of the examples in the help."""
        self.set_defaults(run=run)
        self._examples = examples

    def accept_prefixes(self, *prefixes: str) -> None:
        """Collect undeclared options that begin with a prefix, and their values, as
        ``undeclared``."""
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

        The help text ends with the default; required options are listed in a group of their own.

        Args:
            name: Name, with dashes unless the argument is positional.
            kind: Function from text to value.
            text: Description for the help.
            default: Value if the option is missing.
            group: Group of options that it joins, such as a mutually exclusive group.
            settings: Other arguments of ``add_argument``.
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
        """Declare an option without a value."""
        (group or self).add_argument(name, action="store_true", help=text)

    def teacher(self, text: str, default: str) -> None:
        """Declare ``--teacher``."""
        help_ = (
            f"{text}: msbg (exact), or your own simulator as package.module:name or "
            "path/to/file.py:name, which is a function (waveform, audiogram) -> waveform, or a "
            "class of such functions; waveforms (items, time) are in pascals, audiograms (items, "
            "8) in dB HL, and the sample rate is its attribute sample_rate or else 16000 Hz"
        )
        self.option("--teacher", teacher_name, help_, default, metavar="NAME")

    def audiogram(self, default: str | None = None, text: str = "", **settings: Any) -> None:
        """Declare ``--audiogram``, one ear."""
        help_ = (
            "NH, N1 to N7, S1 to S3, or eight levels in dB HL at 250, 500, 1000, 2000, 3000, "
            f"4000, 6000 and 8000 Hz, separated by commas{text}"
        )
        self.option("--audiogram", str, help_, default, metavar="EAR", **settings)

    def listener(self, text: str, **settings: Any) -> None:
        """Declare ``--listener``, two ears."""
        help_ = (
            f"{text}: a CSV file with columns listener, ear (left or right), hl_250, ..., or "
            "Clarity's listeners.json; write FILE:NAME if the file holds several listeners"
        )
        self.option("--listener", str, help_, metavar="FILE[:NAME]", **settings)

    def levels(self, levelled: str) -> None:
        """Declare ``--full-scale-spl`` and ``--spl``, of which a user sets at most one.

        The first is the level of a file whose RMS is 1.0, the second the level of each file.

        Args:
            levelled: Name of the signal that has the level ``--spl``, for the help text.
        """
        group = self.add_mutually_exclusive_group()
        text = "level in dB SPL of a file whose RMS is 1.0"
        self.option("--full-scale-spl", number, text, 94.0, group=group, metavar="DB")
        text = f"level in dB SPL of {levelled}"
        self.option("--spl", positive, text, group=group, metavar="DB")

    def linked(self, condition: str) -> None:
        """Declare ``--linked``."""
        text = f"link the gains of both ears ({condition}hearing aids and wdrc only)"
        self.flag("--linked", text)

    def enhancers(self, waveforms: str) -> None:
        """Declare ``--enhancer``.

        Args:
            waveforms: Description of its input and output.
        """
        text = (
            "noise reduction of your own before each aid, package.module:name or "
            "path/to/file.py:name: a callable (waveform, sample_rate) -> waveform or its class, "
            f"for {waveforms}"
        )
        settings = {"nargs": "+", "metavar": "NAME", "dest": "enhancers"}
        self.option("--enhancer", plugin_name, text, [], **settings)

    def sliders(self) -> None:
        """Declare the sliders of a hearing aid."""
        text = "strength of a hearing aid's noise reduction, 0 to 1 (default: 0.5)"
        self.option("--noise-reduction", slider, text)
        text = "strength of a hearing aid's amplification, 0 to 1 (default: 1)"
        self.option("--amplification", slider, text)


def _format_default(default: Any, separator: str) -> str:
    """Format a default value, or the values of a list, for the help."""
    values = default if isinstance(default, list | tuple) else [default]
    texts = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    return separator.join(texts)


def checked_type(
    read: Callable[[str], Any], accepts: Callable[[Any], bool], expected: str
) -> Callable[[str], Any]:
    """Make a function that reads the value of an option and validates it.

    Args:
        read: Function from text to value; a ValueError rejects the text.
        accepts: Function that returns whether a value is valid.
        expected: Description of valid values, for the error message.
    """

    def read_value(text: str) -> Any:
        with suppress(ValueError):
            value = read(text)
            if accepts(value):
                return value
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")

    return read_value


_PLUGIN = re.compile(r".+:\w+")

number = checked_type(float, math.isfinite, "a number such as 65 or 2.5")
positive = checked_type(float, lambda value: 0 < value < math.inf, "a number above 0")
slider = checked_type(float, lambda value: 0 <= value <= 1, "a number from 0 to 1")
integer = checked_type(int, lambda value: True, "a whole number")
count = checked_type(int, lambda value: value >= 1, "a whole number, 1 or more")
natural = checked_type(int, lambda value: value >= 0, "a whole number, 0 or more")
plugin_name = checked_type(
    str, lambda text: bool(_PLUGIN.fullmatch(text)), "package.module:name or path/to/file.py:name"
)
teacher_name = checked_type(
    str,
    lambda text: text in TEACHERS or bool(_PLUGIN.fullmatch(text)),
    f"{', '.join(TEACHERS)}, package.module:name or path/to/file.py:name",
)


def folder(text: str) -> Path:
    """Read the name of a folder for results, and reject one that cannot be created."""
    path = Path(text)
    existing = path.absolute()
    while not os.path.lexists(existing):
        existing = existing.parent
    if not existing.is_dir():
        raise argparse.ArgumentTypeError(f"{existing} is not a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(f"no permission to write to {existing}")
    return path


_METAVARS: dict[Callable[[str], Any], str] = {
    Path: "PATH",
    folder: "DIR",
    str: "NAME",
    count: "N",
    natural: "N",
    integer: "N",
    number: "X",
    positive: "X",
    slider: "X",
}
