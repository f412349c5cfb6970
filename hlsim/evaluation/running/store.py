"""Scores on disk: each is appended when it is known, so that an interrupted run can be continued.

The file has one JSON object per line. Two runs can append to it at the same time, and people can
read it.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path


class ScoreStore:
    """Stored scores, each under a key: a hash of everything on which the score depends.

    The file has one line ``{"key": ..., "values": ...}`` per score, with ``"warnings"`` if there
    were any, and only grows. The last line with a key counts. A line that an interruption cut short
    is ignored.

    Args:
        path: File of scores, which is read if it exists and is created with the first score. None
            keeps scores in memory.

    Attributes:
        scores: Dict from key to measured values, by column.
        warnings: Dict from key to the texts of the warnings that the score caused, for the scores
            that caused any.

    Raises:
        OSError: The file cannot be read.

    >>> store = ScoreStore()
    >>> store.append("abc", {"haspi": 0.5})
    >>> store.scores
    {'abc': {'haspi': 0.5}}
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self.scores: dict[str, Mapping[str, float | str]] = {}
        self.warnings: dict[str, Sequence[str]] = {}
        if self.path is None or not self.path.exists():
            return
        for line in self.path.read_text(encoding="utf-8", errors="replace").split("\n"):
            # A line that is cut short, or is not a score, is ignored.
            with suppress(ValueError, KeyError, TypeError):
                score = json.loads(line)
                self._add(score["key"], dict(score["values"]), list(score.get("warnings", [])))

    def append(
        self, key: str, values: Mapping[str, float | str], warnings: Sequence[str] = ()
    ) -> None:
        """Store a score under a key. The file, if any, has the score when this method returns.

        Args:
            key: Hash of everything on which the score depends.
            values: Measured values by column.
            warnings: Texts of the warnings that the score caused.

        Raises:
            ValueError: A value is NaN or infinite, or the file cannot be written.
        """
        score = {"key": key, "values": values}
        if warnings:
            score["warnings"] = list(warnings)
        line = json.dumps(score, ensure_ascii=False, allow_nan=False)
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with open(self.path, "a+b") as file:
                    # An interruption may have cut the last line short, which then has no end.
                    file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
                    line_break = "" if file.read(1) in (b"", b"\n") else "\n"
                    file.write(f"{line_break}{line}\n".encode())
            except OSError as error:
                raise ValueError(
                    f"{self.path}: a score cannot be written: {error.strerror or error}; correct "
                    "this, and run again to continue with the scores that are stored"
                ) from error
        self._add(key, values, warnings)

    def _add(self, key: str, values: Mapping[str, float | str], warnings: Sequence[str]) -> None:
        self.scores[key] = values
        self.warnings.pop(key, None)
        if warnings:
            self.warnings[key] = warnings
