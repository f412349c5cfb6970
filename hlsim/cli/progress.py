"""What the program says of long work: how much is done, and when the rest will be."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable


def show_progress(what: str) -> Callable[..., None]:
    """Print how many are done and when the rest will be, on one line of stderr.

    The end is told from the pace since the first call, so that what was done by an earlier run does not count.

    Returns: called with how many are done, how many there are and, where there is something to say of it, what comes.
    """
    first: tuple[int, float] | None = None

    def show(done: int, total: int, coming: str = "") -> None:
        nonlocal first
        now = time.time()
        first = first or (done, now)
        text = f"{done} of {total} {what}"
        if first[0] < done < total:
            left = (now - first[1]) / (done - first[0]) * (total - done)
            clock = time.strftime("%a %H:%M:%S", time.localtime(now + left))
            text += f", ends about {clock} (in {left / 60:.1f} min)"
        text += f": {coming}" if coming else ""
        print(f"\r{text:<79.79}", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return show
