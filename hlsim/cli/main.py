"""The program ``hlsim``. Bad input ends with exit status 2 and a message of one line."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import warnings
from collections.abc import Sequence
from functools import partial
from importlib import import_module

from hlsim.cli.options import Parser, join_negative_values
from hlsim.extras import MissingExtraError
from hlsim.version import __version__

COMMANDS = {
    "simulate": ("processing", "simulate a hearing loss on a file or a folder of files"),
    "compensate": ("processing", "apply a hearing aid to a file or a folder of files"),
    "live": ("live", "run a hearing aid or a simulated hearing loss from microphone to headphones"),
    "demo": (
        "demo",
        "train a compensator for one ear on bundled speech, and compare it with NAL-R",
    ),
    "haspi-report": (
        "evaluation",
        "compare recordings by HASPI, HASQI, HAAQI, STOI or PESQ, with paired tests",
    ),
    "evaluate-compensator": ("evaluation", "compare hearing aids with no aid, NAL-R and WDRC"),
    "evaluate-simulator": ("evaluation", "compare simulators with MSBG or another teacher"),
    "clarity": ("evaluation", "evaluate pairs of aids on scenes of the Clarity challenges"),
    "prepare": (
        "prepare",
        "recognise the layout of a corpus and write its manifest, a CSV file to train on",
    ),
    "train-simulator": ("training", "train a Neuro-MSBG to reproduce MSBG or another teacher"),
    "train-compensator": ("training", "train a hearing aid through a frozen simulator"),
}
"""Module in ``hlsim.cli`` and description of each command.

The module has a function of the command's name that declares the options.
"""

GROUPS = {
    "listen": ("simulate", "compensate", "live", "demo"),
    "evaluate": ("haspi-report", "evaluate-compensator", "evaluate-simulator", "clarity"),
    "train": ("prepare", "train-simulator", "train-compensator"),
}
"""Groups of commands in the help."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program.

    Args:
        arguments: Command and options; by default those of the process.

    Returns:
        Exit status: 0 after success, 2 after an error, and 128 plus the number of the signal that
        stopped the program.
    """
    # NumPy solves only small systems here, for which threads of OpenBLAS wait longer than they
    # compute.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if "matplotlib" not in sys.modules:
        # The backend of a notebook may be missing in this environment.
        os.environ["MPLBACKEND"] = "Agg"
    warnings.formatwarning = lambda message, *_, **__: f"hlsim: warning: {message}\n"
    signals: list[int] = []

    def stop(number: int, frame: object) -> None:
        signals.append(number)
        raise KeyboardInterrupt

    is_main_thread = threading.current_thread() is threading.main_thread()
    previous_handler = signal.signal(signal.SIGTERM, stop) if is_main_thread else None
    try:
        parser = make_parser()
        arguments = sys.argv[1:] if arguments is None else arguments
        options = parser.parse_args(join_negative_values(arguments))
        if not hasattr(options, "run"):
            parser.print_help()
            return 0
        options.run(options)
    except (ValueError, MissingExtraError, OSError) as error:
        print(f"hlsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        text = "stopped; run the same command again to continue a training or an evaluation"
        print(f"\nhlsim: {text}", file=sys.stderr)
        return 128 + (signals[0] if signals else signal.SIGINT)
    finally:
        if is_main_thread:
            signal.signal(signal.SIGTERM, previous_handler)
    return 0


def make_parser() -> Parser:
    """Make the parser of the program, whose commands declare their options when they are used."""
    lines = []
    for group, names in GROUPS.items():
        lines.append(f"\n{group}:")
        lines += [f"  {name:<22}{COMMANDS[name][1]}" for name in names]
    parser = Parser(
        prog="hlsim",
        usage="hlsim COMMAND ...",
        description="Simulate hearing losses, apply, train and evaluate hearing aids.",
        epilog="\n".join(lines) + "\n\nhlsim COMMAND --help describes the options of a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    commands = parser.add_subparsers(
        prog="hlsim", metavar="COMMAND", help="one of the commands below"
    )
    for command, (module, text) in COMMANDS.items():
        declare = partial(_declare, module, command.replace("-", "_"))
        commands.add_parser(command, description=text, declare=declare)
    return parser


def _declare(module: str, function: str, parser: Parser) -> None:
    """Declare the options of a command with the function of its module."""
    getattr(import_module(f"hlsim.cli.{module}"), function)(parser)


if __name__ == "__main__":
    sys.exit(main())
