"""The program ``hlsim``. Bad input ends with exit status 2 and one line."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from hlsim import __version__
from hlsim.cli import benchmark, compensators, demo, evaluation, files, haspi_report, prepare, training
from hlsim.extras import MissingExtraError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit status."""
    try:
        options = _parser().parse_args(arguments)
        options.run(options)
    except (ValueError, MissingExtraError, OSError) as error:
        print(f"hlsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "hlsim: stopped; what was finished is kept, and training and reports go on from there with the same command",
            file=sys.stderr,
        )
        return 130
    return 0


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage; its commands' parsers are of this class too."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        # as from Python 3.14 on: no option begins with a digit, so that -10,0 and -2.5e1 are values
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:  # here, not in the program's own parser, so that the command is named
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return found, unknown

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="hlsim", description="Hear through an impaired ear, and train through it.")
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (demo, files, prepare, training, evaluation, compensators, haspi_report, benchmark):
        module.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
