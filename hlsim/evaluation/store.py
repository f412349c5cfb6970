"""Scores on disk: each is appended when it is known, so that an interrupted run can be continued.

The file holds one JSON object per line, so that two runs can share it and people can read it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hlsim.files import sha256


class ScoreStore:
    """Stored scores, by a hash of everything that decides a score.

    The file has one line ``{"key": ..., "values": ...}`` per score, and only grows. The last line
    with a key counts. A line that an interruption cut short is ignored.

    Args:
        path: File of scores, which is created with the first one. None keeps them in memory.

    Raises:
        ValueError: The file cannot be read.

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
        try:
            lines = self.path.read_text(encoding="utf-8", errors="replace").split("\n")
        except OSError as error:
            raise ValueError(
                f"{path}: cannot read stored scores ({error}); pass the file that an earlier run "
                "wrote, or the path of a new one"
            ) from error
        for line in lines:
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
            ValueError: The file cannot be written, or JSON cannot represent the record.
        """
        line = json.dumps({"key": key, **record}, ensure_ascii=False, allow_nan=False)
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with open(self.path, "a", encoding="utf-8") as file:
                    # The line before this one may be cut short.
                    file.write(f"\n{line}")
            except OSError as error:
                raise ValueError(f"{self.path}: cannot store scores ({error})") from error
        self.records[key] = dict(record)


def content_hash(path: str | Path) -> str:
    """Compute the SHA-256 of a file's contents, in hexadecimal.

    Raises:
        ValueError: The file cannot be read.

    >>> len(content_hash(__file__))
    64
    """
    try:
        return sha256(Path(path))
    except OSError as error:
        raise ValueError(f"{path}: {str(error.strerror).lower()}") from error
