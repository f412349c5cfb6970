"""Scores on disk: each is appended when it is known, so that a stopped run continues where it was.

The file holds one JSON object per line, so that two runs may share it and people can read it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from hlsim.evaluation.fingerprint import text_hash
from hlsim.files import sha256


class ScoreStore:
    """A file of JSON lines, ``{"key": ..., ...}``, that only grows; the last line with a key counts.

    Nothing is written before the first record. A line that a kill cut short is ignored, and the next
    record starts a new line.

    Args:
        path: file of records; it need not exist. None keeps the records in memory.

    Raises:
        ValueError: the file cannot be read.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self.records: dict[str, dict[str, Any]] = {}
        self._last_line_is_cut = False
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def __len__(self) -> int:
        return len(self.records)

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the record with a key, or None."""
        return self.records.get(key)

    def append(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a record, on disk before this returns. ValueError if that fails."""
        line = json.dumps({"key": key, **record}, ensure_ascii=False, allow_nan=False) + "\n"
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._write(self.path, line)
            except OSError as error:
                raise ValueError(f"{self.path}: cannot store scores ({error})") from error
        self.records[key] = dict(record)

    def _write(self, path: Path, line: str) -> None:
        data = (f"\n{line}" if self._last_line_is_cut else line).encode()
        with open(path, "ab", buffering=0) as file:
            # one write of whole lines at the end of the file: two runs may share it
            self._last_line_is_cut = file.write(data) < len(data)
            os.fsync(file.fileno())
        if self._last_line_is_cut:
            raise OSError("the disk is full")

    def _read(self, path: Path) -> None:
        try:
            with open(path, encoding="utf-8", errors="replace") as file:
                for line in file:
                    self._last_line_is_cut = not line.endswith("\n")
                    # a line that is cut short or not ours is ignored
                    with suppress(ValueError, KeyError, TypeError, AttributeError):
                        record = json.loads(line)
                        self.records[record.pop("key")] = record
        except OSError as error:
            raise ValueError(f"{path}: cannot read stored scores ({error})") from error


def content_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file's contents, in hexadecimal; ValueError if it cannot be read."""
    try:
        return sha256(Path(path))
    except OSError as error:
        raise ValueError(f"{path}: {str(error.strerror).lower()}") from error


def key_of(settings: Mapping[str, Any]) -> str:
    """Return the SHA-256 of settings that JSON can hold, in hexadecimal, whatever their order."""
    return text_hash(json.dumps(settings, sort_keys=True, allow_nan=False))
