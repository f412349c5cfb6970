"""The program ``hlsim``. Bad input ends with exit status 2 and one line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from hlsim import __version__
from hlsim.commands import benchmark, compensators, demo, evaluation, files, haspi_report, prepare, training
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hlsim", description="Hear through an impaired ear, and train through it."
    )
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in (demo, files, prepare, training, evaluation, compensators, haspi_report, benchmark):
        module.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
