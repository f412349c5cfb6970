"""Display of the progress of long work, and of the time when it will end, on stderr."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

_LINE_INTERVAL = 10.0
"""Time in seconds after which another line is due, if stderr is not a terminal."""

_TICK = 1.0
"""Time in seconds between two updates of the line."""


Part = TypeVar("Part")

_active_lines: list[ProgressLine] = []
"""Lines of work in progress, the innermost last. Only the last one is shown."""


class ProgressLine:
    """Line about the progress of long work, which is shown on stderr about every 10 seconds.

    Use it in a ``with`` block, and call it after each unit of work with the number of finished
    units, their total number and, optionally, a text to append. A terminal shows one line, which is
    overwritten every second. Before the first call and after the last one, the line shows
    ``before`` or ``after``, and for how many seconds this stage has run.

    The end is estimated from the pace since the first call, so that units that an earlier run
    finished have no influence.

    Args:
        unit: Plural noun for the counted units of work, such as "scores".
        before: Description of the work before the first call.
        after: Description of the work after the last call.

    >>> with ProgressLine("scores") as progress:
    ...     progress(1, 4)
    """

    def __init__(self, unit: str, before: str = "starting", after: str = "finishing") -> None:
        self.unit = unit
        self.before = before
        self.after = after
        self._first: tuple[float, float] | None = None
        self._counts: tuple[float, float] = (0, 0)
        self._details = ""
        self._stage_start = self._last_line = time.time()
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> ProgressLine:
        _active_lines.append(self)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        _active_lines.remove(self)
        clear_line(sys.stderr)

    def __call__(self, done: float, total: float, details: str = "") -> None:
        with self._lock:
            now = time.time()
            is_first = self._first is None
            is_last = done == total and self._counts != (done, total)
            self._first = self._first or (done, now)
            self._counts = done, total
            self._details = details
            if is_last:
                self._stage_start = now
            if is_last or done < total:
                self._show(self._describe_counts(now), now, is_due=is_first or is_last)

    def print(self, text: str, file: TextIO | None = None) -> None:
        """Print a line of results, in a terminal in place of the line of progress.

        Args:
            text: Line to print.
            file: Stream to which the line is printed, such as ``sys.stderr``; by default
                ``sys.stdout``.
        """
        with self._lock:
            clear_line(sys.stderr)
            print(text, file=file or sys.stdout, flush=True)
            self._last_line = time.time()

    def _watch(self) -> None:
        """Show the line every second, or every 10 without a terminal, until the work has ended.

        While the line of an inner ``with`` block is active, this one waits. Runs in a thread of
        its own.
        """
        while not self._ended.wait(_TICK):
            if _active_lines[-1] is not self:
                continue  # The line of a part of the work, such as a training, says more.
            with self._lock:
                now = time.time()
                done, total = self._counts
                if self._first is not None and done < total:
                    text = self._describe_counts(now)
                else:
                    stage = self.before if self._first is None else self.after
                    text = f"{stage}, {now - self._stage_start:.0f} s"
                self._show(text, now)

    def _describe_counts(self, now: float) -> str:
        """Return a text with the number of finished units and the estimated time of the end.

        Args:
            now: Present time in seconds, from ``time.time``.
        """
        done, total = self._counts
        text = f"{int(done)} of {total:g} {self.unit} ({done / total:.0%})"
        first_done, start = self._first or (done, now)
        if first_done < done < total:
            seconds = (now - start) / (done - first_done) * (total - done)
            clock = time.strftime("%a %H:%M", time.localtime(now + seconds))
            text += f", {seconds / 60:.1f} min left ({clock})"
        return text + self._details

    def _show(self, text: str, now: float, is_due: bool = False) -> None:
        """Print a line if it is due, if stderr is a terminal, or if the last line is 10 s old."""
        if is_due or sys.stderr.isatty() or now - self._last_line >= _LINE_INTERVAL:
            self._last_line = now
            show_line(text, sys.stderr)


def track(parts: Iterable[Part], unit: str, total: int) -> Iterator[Part]:
    """Yield the parts of a stage of long work, and count them in the current progress line, if any.

    After the stage, the line shows the same numbers as before.

    Args:
        parts: Parts of the work.
        unit: Plural noun for the parts, such as "pictures".
        total: Number of the parts.

    >>> list(track([1, 2], "pictures", 2))
    [1, 2]
    """
    if not _active_lines:
        yield from parts
        return
    line = _active_lines[-1]
    state = line.unit, line._first, line._counts, line._details
    start = time.time()
    try:
        for number, part in enumerate(parts):
            with line._lock:
                line.unit, line._first, line._details = unit, (0, start), ""
                line._counts = number, total
            yield part
    finally:
        with line._lock:
            line.unit, line._first, line._counts, line._details = state


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
