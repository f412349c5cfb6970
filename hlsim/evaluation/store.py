"""Scores on disk: each is appended when it is known, so that an interrupted run can be continued.

The file holds one JSON object per line, so that two runs can share it and people can read it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any


class ScoreStore:
    """Stored scores, by a hash of everything that decides a score.

    The file has one line ``{"key": ..., "values": ...}`` per score, and only grows. The last line
    with a key counts. A line that an interruption cut short is ignored.

    Args:
        path: File of scores, which is created with the first one. None keeps them in memory.

    >>> store = ScoreStore()
    >>> store.append("abc", {"values": {"haspi": 0.5}})
    >>> store.get("abc")
    {'values': {'haspi': 0.5}}
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self.records: dict[str, dict[str, Any]] = {}
        if self.path is None or not self.path.exists():
            return
        for line in self.path.read_text(encoding="utf-8", errors="replace").split("\n"):
            # A line that is cut short, or is not a record, is ignored.
            with suppress(ValueError, KeyError, TypeError, AttributeError):
                record = json.loads(line)
                self.records[record.pop("key")] = record

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the record that was stored under a key, or None if there is none."""
        return self.records.get(key)

    def append(self, key: str, record: Mapping[str, Any]) -> None:
        """Store a record under a key. The file, if any, has the record when this method returns.

        Args:
            key: Hash of everything that decides the score.
            record: Entries of the line, such as ``values``, the measured values by column.

        Raises:
            ValueError: JSON cannot represent the record.
        """
        line = json.dumps({"key": key, **record}, ensure_ascii=False, allow_nan=False)
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(f"\n{line}")  # The line before this one may be cut short.
        self.records[key] = dict(record)
