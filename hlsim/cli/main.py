"""The program ``hlsim``. Every error ends with exit status 2 and a message of one line."""

import argparse
import atexit
import gc
import io
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module

from hlsim.cli.options import Parser
from hlsim.version import __version__

GROUPS = {
    "listen": {
        "simulate": ("processing", "simulate a hearing loss on a file or a folder of files"),
        "compensate": ("processing", "apply a hearing aid to a file or a folder of files"),
        "listen": (
            "listen",
            "write a page with players: what ears perceive, with and without an aid",
        ),
        "live": ("live", "run a hearing aid or a simulated hearing loss with a microphone"),
        "demo": ("demo", "train a compensator for one ear on bundled speech"),
        "export-gains": ("fitting.export_gains", "write the gains of an aid for another program"),
    },
    "evaluate": {
        "haspi-report": ("evaluation", "compare recordings by HASPI, HASQI, HAAQI, STOI or PESQ"),
        "evaluate-compensator": ("evaluation", "compare hearing aids with no aid, NAL-R and WDRC"),
        "evaluate-simulator": ("evaluation", "compare simulators with MSBG or another teacher"),
        "verify": (
            "fitting.verify",
            "compare the gains of an aid in two recordings with their targets",
        ),
        "srt": ("srt", "measure the speech reception threshold in noise of ears and aids"),
        "clarity": ("evaluation", "evaluate pairs of aids on scenes of the Clarity challenges"),
    },
    "train": {
        "prepare": ("prepare", "write the manifest of a corpus, a CSV file to train on"),
        "train-simulator": ("training", "train a Neuro-MSBG to reproduce MSBG or another teacher"),
        "train-compensator": ("training", "train a hearing aid through a frozen simulator"),
    },
}
"""Commands by group, each with its module in ``hlsim.cli`` and its description.

The module has a function of the command's name that declares the options.
"""

COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
"""Module and description of each command, by its name."""

TRACEBACK_VARIABLE = "HLSIM_TRACEBACK"
"""Environment variable that, unless empty, adds the traceback to the message of an error."""

_EXPECTED_ERRORS = (ValueError, ImportError, OSError)
"""Exceptions whose message is written for users; others are errors of hlsim or of a plug-in."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program ``hlsim``.

    Args:
        arguments: Command and options, such as ``["demo", "--steps", "100"]``; by default those of
            the process.

    Returns:
        Exit status: 0 after success, 2 after an error, and 130 after Ctrl-C.

    Raises:
        SystemExit: Help or the version was printed (status 0), or the command or an option is not
            valid (2).
    """
    # NumPy solves only small systems here, for which threads of OpenBLAS wait longer than they
    # compute.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "matplotlib" not in sys.modules:
        # The backend of a notebook may be missing in this environment.
        os.environ["MPLBACKEND"] = "Agg"
    warnings.formatwarning = lambda message, *_, **__: f"hlsim: warning: {message}\n"
    for stream in (sys.stdout, sys.stderr):
        # A character that the encoding lacks, in the name of a file, must not end the command.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if arguments is None:
        # Python ends by a search for unused objects, which takes half a second after torch is
        # imported. The memory goes back to the system anyway. ``load_plugin`` takes this back.
        atexit.register(gc.freeze)
    try:
        options = parse_arguments(sys.argv[1:] if arguments is None else arguments)
        options.run(options)
    except KeyboardInterrupt:
        text = "stopped; run the same command again to continue a training or an evaluation"
        print(f"\nhlsim: {text}", file=sys.stderr)
        return 130
    except Exception as error:
        if os.environ.get(TRACEBACK_VARIABLE):
            traceback.print_exc()
        print(f"hlsim: error: {_describe(error)}", file=sys.stderr)
        return 2
    return 0


def _describe(error: Exception) -> str:
    """Return the message of an exception in one line, with its type if it is unexpected."""
    text = " ".join(str(error).split())
    if isinstance(error, _EXPECTED_ERRORS) and text:
        return text
    if isinstance(error, MemoryError):
        return f"out of memory {text}".rstrip()
    kind = type(error).__name__
    return f"unexpected {kind}: {text}; {TRACEBACK_VARIABLE}=1 hlsim ... shows where it was raised"


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse a command and its options.

    Args:
        arguments: Command and options. Without any, the help is printed.

    Returns:
        Values of the options as attributes; the attribute ``run`` is the function that runs the
        command with them.

    Raises:
        SystemExit: Help or the version was printed, or the command or an option is not valid.
    """
    words = [*arguments] or ["--help"]
    if words[0] == "help":
        words = [*words[1:2], "--help"]
    if words[0] in COMMANDS:
        return make_parser(words[0]).parse_args(words[1:])
    lines = []
    for group, commands in GROUPS.items():
        lines.append(f"\n{group}:")
        lines += [f"  {name:<22}{text}" for name, (_, text) in commands.items()]
    parser = Parser(
        prog="hlsim",
        usage="hlsim COMMAND ...",
        description="Simulate hearing losses, apply, train and evaluate hearing aids.",
        epilog="\n".join(lines) + "\n\nhlsim COMMAND --help describes the options of a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("-V", "--version", action="version", version=f"hlsim {__version__}")
    parser.add_argument("command", metavar="COMMAND", help="one of the commands below")
    command = parser.parse_args(words).command
    # ``suggest`` of hlsim.checks would import torch, which takes seconds.
    similar = get_close_matches(command.lower(), COMMANDS, n=1)
    suggestion = f" (did you mean {similar[0]}?)" if similar else ""
    parser.error(f"there is no command {command!r}{suggestion}")


def make_parser(command: str) -> Parser:
    """Make the parser of a command, such as ``prepare``, and declare its options.

    >>> make_parser("prepare").prog
    'hlsim prepare'
    """
    module, description = COMMANDS[command]
    parser = Parser(prog=f"hlsim {command}", description=description)
    declare = getattr(import_module(f"hlsim.cli.{module}"), command.replace("-", "_"))
    declare(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
