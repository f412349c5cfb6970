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

from hlsim.cli.options import Parser
from hlsim.version import __version__

GROUPS = {
    "listen": {
        "simulate": ("processing", "simulate a hearing loss on a file or a folder of files"),
        "compensate": ("processing", "apply a hearing aid to a file or a folder of files"),
        "live": ("live", "run a hearing aid or a simulated hearing loss with a microphone"),
        "demo": ("demo", "train a compensator for one ear on bundled speech"),
    },
    "evaluate": {
        "haspi-report": ("evaluation", "compare recordings by HASPI, HASQI, HAAQI, STOI or PESQ"),
        "evaluate-compensator": ("evaluation", "compare hearing aids with no aid, NAL-R and WDRC"),
        "evaluate-simulator": ("evaluation", "compare simulators with MSBG or another teacher"),
        "clarity": ("evaluation", "evaluate pairs of aids on scenes of the Clarity challenges"),
    },
    "train": {
        "prepare": ("prepare", "write the manifest of a corpus, a CSV file to train on"),
        "train-simulator": ("training", "train a Neuro-MSBG to reproduce MSBG or another teacher"),
        "train-compensator": ("training", "train a hearing aid through a frozen simulator"),
    },
}
"""Module in ``hlsim.cli`` and description of each command, by group.

The module has a function of the command's name that declares the options.
"""

COMMANDS = {name: entry for group in GROUPS.values() for name, entry in group.items()}
"""Module and description of each command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program ``hlsim``.

    Args:
        arguments: Command and options, such as ``["demo", "--seed", "1"]``; by default those of the
            process.

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

    def stop(signal_number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal_number)

    is_main_thread = threading.current_thread() is threading.main_thread()
    previous_handler = signal.signal(signal.SIGTERM, stop) if is_main_thread else None
    try:
        parser = make_parser()
        options = parser.parse_args(arguments)
        if not hasattr(options, "run"):
            parser.print_help()
            return 0
        options.run(options)
    except (ValueError, ImportError, OSError) as error:
        print(f"hlsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        text = "stopped; run the same command again to continue a training or an evaluation"
        print(f"\nhlsim: {text}", file=sys.stderr)
        return 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)
    finally:
        if is_main_thread:
            signal.signal(signal.SIGTERM, previous_handler)
    return 0


def make_parser() -> Parser:
    """Make the parser of the ``hlsim`` command line, which has one parser per command.

    A command declares its options when it is invoked, so that other commands need not be imported.
    """
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
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    text = "one of the commands below"
    subparsers = parser.add_subparsers(prog="hlsim", metavar="COMMAND", help=text)
    for command, (module, text) in COMMANDS.items():
        declare = partial(_declare, module, command.replace("-", "_"))
        subparsers.add_parser(command, description=text, declare=declare)
    return parser


def _declare(module: str, function: str, parser: Parser) -> None:
    """Import the module of a command, whose function declares the options on the parser."""
    getattr(import_module(f"hlsim.cli.{module}"), function)(parser)
