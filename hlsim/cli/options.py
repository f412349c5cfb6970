"""The parser of a command, and the options that commands of several files have.

Options of all trainings are in ``training.py``, and those of all evaluations in ``evaluation.py``.
This module does not import torch, so that ``--help`` takes a fraction of a second.
"""

import argparse
import math
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, NoReturn

EARS_TABLE = (
    "CSV file of ears with columns hl_250, hl_500, ... in dB HL, an empty value where a frequency "
    "was not measured; or standard for Bisgaard's ears N1 to N6 and S1 to S3"
)
"""Help text of options that take a table of ears."""

SIMULATED_EARS = "NH, N1 to N6, S1 to S3"
"""Standard ears of commands that simulate a loss; N7 exceeds the range of simulators."""

ALL_EARS = "NH, N1 to N7, S1 to S3"
"""Standard ears of commands that do not simulate a loss."""

AIDED_EARS = f"{ALL_EARS} (N7 exceeds the range of trained aids)"
"""Standard ears of commands that process signals by an aid."""


_EAR = re.compile(r"NH|[NS]\d|-?[\d.]+([,:]-?[\d.]+)+", re.IGNORECASE)
"""Text of an ear on the command line: a name, levels, or frequencies with levels."""


class _StoreOnce(argparse.Action):
    """Action that stores the value of an option, and rejects the option if it is repeated.

    argparse would store the last value, so that, for example, the first of two folders of speech
    would be ignored.

    An option of ``Parser.series`` gets one list per word, such as "50,65"; the lists are joined.
    """

    namespace: argparse.Namespace | None = None

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if self.namespace is namespace:
            fix = "write all values after one of them" if self.nargs == "+" else "leave one out"
            raise argparse.ArgumentError(self, f"appears twice; {fix}")
        self.namespace = namespace
        if isinstance(values, list) and isinstance(values[0], list):
            values = [*chain.from_iterable(values)]
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """Parser of the program or of a command, whose errors are one line without the usage.

    Args:
        settings: Arguments of ``argparse.ArgumentParser``.

    Attributes:
        prefix: Beginning of the names of options that are accepted without being declared, or None.
            They are appended, with their values, to the list ``settings`` of the parsed options.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.prefix: str | None = None
        self._examples: tuple[str, ...] = ()
        # argparse would take a value such as -10,0,20 for an option.
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def set_command(self, run: Callable[[argparse.Namespace], None], *examples: str) -> None:
        """Set the function that runs the command, and the examples in the help.

        Args:
            run: Function that is called with the parsed options.
            examples: Arguments and options of each example, without the name of the command.
        """
        self.set_defaults(run=run)
        self._examples = examples

    def format_help(self) -> str:
        text = super().format_help()
        if self._examples:
            examples = [f"  {self.prog} {example}\n" for example in self._examples]
            text += "\nexamples:\n" + "".join(examples)
        return text

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = sys.argv[1:] if args is None else args
        for option, value, word in zip(words, words[1:], words[2:], strict=False):
            if option == "--audiogram" and _EAR.fullmatch(word) and not Path(word).exists():
                self.error(
                    f"--audiogram takes one ear, got {value} and {word}; where several are "
                    f"possible, repeat the option: --audiogram {value} --audiogram {word}"
                )
        options, unknown = super().parse_known_args(args, namespace)
        if self.prefix and unknown and unknown[0].startswith(self.prefix):
            options.settings = [*options.settings, *unknown]
            unknown = []
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

        Args:
            name: Name, such as ``--speech``; without dashes for a positional argument.
            kind: Function that converts the text of the command line to a value, such as ``count``.
            text: Description for the help, which adds the default.
            default: Value if the option is missing.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
            settings: Further arguments of ``argparse.ArgumentParser.add_argument``.
        """
        if settings.get("required"):
            text += " (required)"
        elif default not in (None, []):
            values = default if isinstance(default, list) else [default]
            text += f" (default: {' '.join(map(str, values))})"
        if name.startswith("-"):
            settings = {"action": _StoreOnce, "default": default, **settings}
        (group or self).add_argument(name, type=kind, help=text, **settings)

    def series(self, name: str, kind: Callable[[str], Any], text: str, default: Any) -> None:
        """Declare an option that takes several values, separated by spaces or commas.

        Args:
            name: Name, such as ``--levels``.
            kind: Function that converts the text of one value.
            text: Description for the help, which adds the default.
            default: Values if the option is missing.
        """

        def read_values(text: str) -> list[Any]:
            return [kind(value) for value in text.split(",")]

        self.option(name, read_values, text, default, nargs="+")

    def flag(self, name: str, text: str, group: Any = None) -> None:
        """Declare an option without a value, which is True if a user passes it, else False.

        Args:
            name: Name, such as ``--linked``.
            text: Description for the help.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
        """
        (group or self).add_argument(name, action="store_true", help=text)

    def teacher(self, text: str) -> None:
        """Declare ``--teacher``, the simulator whose output others match, by default ``msbg``.

        Args:
            text: Beginning of the help text.
        """
        help_ = (
            f"{text}: msbg (exact), a checkpoint by name or folder, or your own simulator as "
            "package.module:name or path/to/file.py:name, a function (waveform, audiogram) -> "
            "waveform or a class that is constructed without arguments and whose objects are such "
            "functions; waveforms (items, time) are in pascals, audiograms (items, 8) in dB HL, "
            "and the sample rate is its attribute sample_rate or else 16000 Hz"
        )
        self.option("--teacher", str, help_, "msbg")

    def audiogram(
        self,
        default: str | None = None,
        *,
        ears: str = SIMULATED_EARS,
        text: str = "",
        group: Any = None,
        **settings: Any,
    ) -> None:
        """Declare ``--audiogram``, the thresholds of one ear.

        Args:
            default: Value if the option is missing, such as ``N3``.
            ears: Names of the standard ears that the command accepts, for the help text.
            text: End of the help text.
            group: Group of argparse that the option joins, such as a mutually exclusive group.
            settings: Further arguments of ``argparse.ArgumentParser.add_argument``.
        """
        help_ = (
            f"{ears}; eight levels in dB HL at 250, 500, 1000, 2000, 3000, 4000, "
            "6000 and 8000 Hz, separated by commas; or frequencies in Hz with levels, such as "
            f"500:30,1000:40,4000:60{text}"
        )
        self.option("--audiogram", ear, help_, default, group=group, **settings)

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
        self.option("--listener", str, help_, group=group)

    def ears(self, names: str, text: str) -> None:
        """Declare ``--audiogram``, which users may repeat, and ``--listener`` instead of it.

        Args:
            names: Names of the standard ears that the command accepts, for the help text.
            text: End of the help text of ``--audiogram``.
        """
        group = self.add_mutually_exclusive_group(required=True)
        text = f"; repeat the option for several ears{text}"
        self.audiogram(ears=names, text=text, group=group, action="append")
        self.listener("both ears, for stereo files, left first", group=group)

    def simulator(self, default: str) -> None:
        """Declare ``--simulator``, the simulator of hearing loss, with its default."""
        text = (
            "msbg (exact), msbg-unsmeared, attenuation (a linear ear), a checkpoint's name or "
            "folder, or a simulator of your own, package.module:name or file.py:name"
        )
        self.option("--simulator", str, text, default)

    def levels(self, signal: str) -> None:
        """Declare ``--full-scale-spl`` and ``--spl``, of which a user sets at most one.

        The first is the level in dB SPL of a file whose RMS is 1.0. The second is the level of each
        signal, whatever its RMS.

        Args:
            signal: Noun for the signal whose level is ``--spl``, for the help text.
        """
        group = self.add_mutually_exclusive_group()
        text = "level in dB SPL of a file whose RMS is 1.0"
        self.option("--full-scale-spl", full_scale, text, 94.0, group=group)
        self.option("--spl", sound_level, f"level in dB SPL of {signal}", group=group)

    def linked(self, condition: str) -> None:
        """Declare ``--linked``, with which one level sets the gains of both ears.

        Args:
            condition: Text before "hearing aids, wdrc and camfit only" in the help, such as "stereo
                files; ".
        """
        text = f"link the gains of both ears ({condition}hearing aids, wdrc and camfit only)"
        self.flag("--linked", text)

    def limit_to_ear(self, table: str) -> None:
        """Declare ``--limit-to-ear``, with which no band exceeds the ear's uncomfortable level.

        Declare also ``--ucl``, with measured levels.

        Args:
            table: Option with a file of ears and an example of its columns, for the help text.
        """
        text = (
            "limit each band of the output to the ear's uncomfortable level, as measured or "
            "predicted (hearing aids, wdrc and camfit only)"
        )
        self.flag("--limit-to-ear", text)
        self.uncomfortable_levels("--limit-to-ear", f"; a file of {table} instead")

    def uncomfortable_levels(self, user: str, text: str = "") -> None:
        """Declare ``--ucl``, the measured uncomfortable levels of the ear of ``--audiogram``.

        Args:
            user: Option or output that uses the levels, for the help text.
            text: End of the help text.
        """
        help_ = (
            f"measured uncomfortable levels for {user} by frequency in Hz, in dB HL, such as "
            f"500:100,1000:95, of the single ear of --audiogram{text}"
        )
        self.option("--ucl", ucl, help_)

    def enhancers(self, waveforms: str) -> None:
        """Declare ``--enhancer``, functions of the user that reduce noise.

        Args:
            waveforms: Shape and unit of the functions' input and output, for the help text.
        """
        text = (
            "noise reduction of your own before each aid, package.module:name or "
            "path/to/file.py:name: a callable (waveform, sample_rate) -> waveform or its class, "
            f"for {waveforms}"
        )
        self.option("--enhancer", str, text, [], nargs="+", dest="enhancers")

    def sliders(self) -> None:
        """Declare the sliders of a hearing aid and ``--loudness``."""
        text = "strength of a hearing aid's noise reduction, 0 to 1 (default: 0.5)"
        self.option("--noise-reduction", share, text)
        text = "strength of a hearing aid's amplification, 0 to 1 (default: 1)"
        self.option("--amplification", share, text)
        text = (
            "loudness of a hearing aid's output for the ear in dB relative to a normal ear, -40 to "
            "0; most people prefer less than 0"
        )
        self.option("--loudness", _limited(float, "a number", -40, 0), text, 0.0)


def _checked_type(
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


def ear(text: str) -> str | list[float] | dict[float, float]:
    """Convert the text of ``--audiogram`` to an ear.

    Args:
        text: A name, levels, or frequencies with levels.

    Returns:
        The name, which is any text without comma and colon; a list of levels in dB HL, whose
        number is not checked here; or a dict from frequency in Hz to level in dB HL.

    Raises:
        argparse.ArgumentTypeError: A frequency occurs twice, a frequency or a level is not a
            number, or a pair is not of the form frequency:level.

    >>> ear("N3"), ear("500:30,4000:60")
    ('N3', {500.0: 30.0, 4000.0: 60.0})
    >>> ear("20,30,40,50,60,60,70,70")
    [20.0, 30.0, 40.0, 50.0, 60.0, 60.0, 70.0, 70.0]
    """
    expected = (
        "a name such as N3, eight levels in dB HL separated by commas, or one level for each "
        "frequency, such as 500:30,4000:60"
    )
    if ":" in text:
        return _checked_type(_read_points, bool, expected)(text)
    if "," in text:
        return _checked_type(_read_levels, bool, expected)(text)
    return text


def _read_levels(text: str) -> list[float]:
    return [float(level) for level in text.split(",")]


def loudness(text: str) -> float | dict[float, float]:
    """Convert the text of a loudness target, such as ``--loudness`` of ``evaluate-compensator``.

    It is a number, or numbers by level. ``--loudness`` of ``compensate`` is another option.

    Args:
        text: Loudness in dB relative to a normal ear, a number, or levels of the input in dB SPL
            with such numbers. Their range is not checked here.

    Raises:
        argparse.ArgumentTypeError: The text is neither, or a level occurs twice.

    >>> loudness("-5"), loudness("50:0,80:-9")
    (-5.0, {50.0: 0.0, 80.0: -9.0})
    """
    expected = "a number of dB, or one number for each level such as 50:0,65:-5,80:-9"
    read = _read_points if ":" in text else float
    return _checked_type(read, lambda value: True, expected)(text)


def _read_points(text: str) -> dict[float, float]:
    """Read numbers by frequency or level, such as 500:30,4000:60.

    Raises:
        ValueError: The text has another form, or a frequency or level occurs twice.
    """
    pairs = [point.split(":") for point in text.split(",")]
    points = {float(key): float(number) for key, number in pairs}
    if len(points) < len(pairs):
        raise ValueError(f"a number occurs twice before a colon in {text!r}; leave one out")
    return points


def _limited(
    read: Callable[[str], Any], noun: str, lowest: float, highest: float
) -> Callable[[str], Any]:
    """Make a function that converts the text of an option to a number in a range with both ends.

    Args:
        read: Function that converts the text; it raises ValueError for text that it cannot convert.
        noun: Noun with its article for the number, for the error message.
        lowest: Smallest accepted number.
        highest: Largest accepted number.
    """
    expected = f"{noun} from {lowest:,.10g} to {highest:,.10g}"
    return _checked_type(read, lambda value: lowest <= value <= highest, expected)


ucl = _checked_type(
    _read_points, bool, "one level in dB HL for each frequency in Hz, such as 500:100,1000:95"
)
positive_number = _checked_type(float, lambda value: 0 < value < math.inf, "a number above 0")
minutes = _checked_type(float, lambda value: 0 < value <= 1e6, "above 0 and at most 1,000,000")
count = _checked_type(int, lambda value: value >= 1, "a whole number, 1 or more")
share = _limited(float, "a number", 0, 1)
sound_level = _limited(float, "a level in dB SPL", -20, 140)
full_scale = _limited(float, "a level in dB SPL", 0, 200)
workers = _limited(int, "a whole number", 0, 1024)
seed = _limited(int, "a whole number", 0, 2**32 - 1)
input_path = _checked_type(Path, lambda path: path.exists(), "an existing file or folder")
