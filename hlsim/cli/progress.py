"""How much of long work is done, and when the rest will be, on stderr."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable

_PAUSE = 30.0  # seconds between lines that go to a file


def show_progress(what: str) -> Callable[..., None]:
    """Return a function that shows how many of all are done and when the rest will be.

    In a terminal it overwrites one line; elsewhere it writes a line every half minute. The end is
    estimated from the pace since the first call, so that the work of an earlier run does not count.

    The returned function takes the number done, the number of all and, optionally, what comes next.
    """
    first: tuple[int, float] | None = None
    last_line = 0.0

    def show(done: int, total: int, coming: str = "") -> None:
        nonlocal first, last_line
        now = time.time()
        first = first or (done, now)
        text = f"{done} of {total} {what}"
        if first[0] < done < total:
            seconds = (now - first[1]) / (done - first[0]) * (total - done)
            clock = time.strftime("%a %H:%M", time.localtime(now + seconds))
            text += f", the rest in {seconds / 60:.1f} min ({clock})"
        text += f": {coming}" if coming else ""
        if sys.stderr.isatty():
            width = shutil.get_terminal_size().columns - 1
            end = "\n" if done == total else ""
            print(f"\r{text[:width]:<{width}}", end=end, file=sys.stderr, flush=True)
        elif done == total or now - last_line >= _PAUSE:
            last_line = now
            print(text, file=sys.stderr, flush=True)

    return show
