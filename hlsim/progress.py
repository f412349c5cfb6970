"""Progress of long work, and the time when it will end, on stderr."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from typing import TextIO

_LINE_INTERVAL = 10.0
"""Seconds between two lines, if stderr is not a terminal."""


def show_progress(unit: str) -> Callable[..., None]:
    """Return a function that shows the progress of long work and the time when it will end.

    In a terminal, the function overwrites one line. Elsewhere, it writes a line every 10 seconds.
    The time of the end is estimated from the pace since the first call, without the work of an
    earlier run.

    Args:
        unit: Plural noun for what is counted, such as "items".

    Returns:
        A function to call after each unit, with the number of finished units, their total number
        and, optionally, a text to append.

    >>> show_progress("items")(1, 4)
    """
    first: tuple[int, float] | None = None
    last_line = 0.0
    is_finished = False

    def show(done: int, total: int, details: str = "") -> None:
        nonlocal first, last_line, is_finished
        if is_finished:
            return
        is_finished = done == total
        now = time.time()
        first = first or (done, now)
        text = f"{done} of {total} {unit}"
        if first[0] < done < total:
            seconds = (now - first[1]) / (done - first[0]) * (total - done)
            clock = time.strftime("%a %H:%M", time.localtime(now + seconds))
            text += f", {seconds / 60:.1f} min left ({clock})"
        text += details
        if sys.stderr.isatty() or is_finished or now - last_line >= _LINE_INTERVAL:
            last_line = now
            show_line(text, sys.stderr)
        if sys.stderr.isatty() and is_finished:
            print(file=sys.stderr)

    return show


def clear_line(file: TextIO) -> None:
    """Clear the line that ``show_line`` printed to a terminal, so that other text takes its place.

    Args:
        file: stdout or stderr.

    >>> clear_line(sys.stdout)  # no terminal
    """
    if file.isatty():
        show_line("", file)
        print("\r", end="", file=file, flush=True)


def show_line(text: str, file: TextIO) -> None:
    """Print a line, in a terminal in place of the one before.

    Args:
        text: Line to print. A terminal shows as much of it as fits.
        file: stdout or stderr.

    >>> show_line("1 of 4 items", sys.stdout)
    1 of 4 items
    """
    width = shutil.get_terminal_size().columns - 1
    line = f"\r{text[:width]:<{width}}" if file.isatty() else f"{text}\n"
    print(line, end="", file=file, flush=True)
