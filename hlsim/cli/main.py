"""The program ``hlsim``. Bad input ends with exit status 2 and one line."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from functools import partial
from importlib import import_module

from hlsim.cli.options import Parser, join_negative_values
from hlsim.extras import MissingExtraError
from hlsim.version import __version__

COMMANDS = {
    "demo": (
        "demo",
        "train a compensator for one ear on the embedded speech and score it by HASPI",
    ),
    "simulate": ("files", "write what an impaired ear hears of a file"),
    "compensate": ("files", "write what an impaired ear is to be given of a file"),
    "live": (
        "live",
        "give an impaired ear what it needs, or hear as it does: microphone to headphones",
    ),
    "prepare": (
        "prepare",
        "recognise the layout of a corpus and write its manifest, a CSV file to train on",
    ),
    "train-simulator": (
        "training",
        "train a Neuro-MSBG on targets from the exact MSBG or another teacher",
    ),
    "train-compensator": ("training", "train a compensator through a frozen simulator"),
    "evaluate-simulator": (
        "evaluation",
        "compare simulators with MSBG or another teacher: SNR, STOI, PESQ, bands",
    ),
    "evaluate-compensator": (
        "evaluation",
        "judge compensators beside no aid and NAL-R: HASPI, HASQI, loudness as heard, surrogate gap, gain curves, tones",
    ),
    "haspi-report": (
        "evaluation",
        "HASPI (HASQI, STOI, PESQ) before and after a treatment, with paired tests",
    ),
    "clarity": (
        "clarity",
        "judge pairs of aids on scenes of Clarity's challenges: the better ear's HASPI and HASQI",
    ),
}
"""Each command's module in ``hlsim.cli``, where a function of its name declares its options, and what it does."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit status."""
    terminated: list[int] = []

    def end(number: int, frame: object) -> None:
        terminated.append(number)
        raise KeyboardInterrupt

    main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, end) if main_thread else None
    try:
        given = sys.argv[1:] if arguments is None else arguments
        options = _parser().parse_args(join_negative_values(given))
        options.run(options)
    except (ValueError, MissingExtraError, OSError) as error:
        print(f"hlsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "hlsim: stopped; what was finished is kept, and training and reports go on from there with the same command",
            file=sys.stderr,
        )
        return 128 + (terminated[0] if terminated else signal.SIGINT)
    finally:
        if main_thread:
            signal.signal(signal.SIGTERM, before)
    return 0


def _parser() -> Parser:
    parser = Parser(prog="hlsim", description="Hear through an impaired ear, and train through it.")
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command, (module, text) in COMMANDS.items():
        commands.add_parser(
            command,
            help=text,
            description=text,
            declare=partial(_declare, module, command.replace("-", "_")),
        )
    return parser


def _declare(module: str, function: str, parser: Parser) -> None:
    getattr(import_module(f"hlsim.cli.{module}"), function)(parser)


if __name__ == "__main__":
    sys.exit(main())
