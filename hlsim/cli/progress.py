"""Progress of long work, and the time when it will end, on stderr."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable

LINE_INTERVAL = 30.0
"""Seconds between two lines, if stderr is not a terminal."""


def show_progress(unit: str) -> Callable[..., None]:
    """Return a function that shows the progress of a task.

    In a terminal, it overwrites one line. Elsewhere, it writes a line every 30 seconds. The time of
    the end is estimated from the pace since the first call, without the work of an earlier run.

    Args:
        unit: Plural noun for what is counted, such as "items".

    Returns:
        A function of the number of finished units, their total number, and optionally a description
        of the next one.
    """
    first: tuple[int, float] | None = None
    last_line = 0.0

    def show(done: int, total: int, next_unit: str = "") -> None:
        nonlocal first, last_line
        now = time.time()
        first = first or (done, now)
        text = f"{done} of {total} {unit}"
        if first[0] < done < total:
            seconds = (now - first[1]) / (done - first[0]) * (total - done)
            clock = time.strftime("%a %H:%M", time.localtime(now + seconds))
            text += f", {seconds / 60:.1f} min left ({clock})"
        text += f": {next_unit}" if next_unit else ""
        if sys.stderr.isatty():
            width = shutil.get_terminal_size().columns - 1
            end = "\n" if done == total else ""
            print(f"\r{text[:width]:<{width}}", end=end, file=sys.stderr, flush=True)
        elif done == total or now - last_line >= LINE_INTERVAL:
            last_line = now
            print(text, file=sys.stderr, flush=True)

    return show
