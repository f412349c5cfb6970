"""Scores on disk, each appended as it is made, so that a run that was killed goes on where it was."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class ScoreStore:
    """A file of JSON lines, ``{"key": ..., ...}``, that only ever grows; the last line of a key counts.

    Nothing is written before the first record. A line that a kill cut short is passed over, and the next begins anew.

    Args:
        path: the file, there or not; None keeps the records in memory.

    Raises:
        ValueError: the file cannot be read.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = None if path is None else Path(path)
        self._records: dict[str, dict[str, Any]] = {}
        self._torn = False
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def __len__(self) -> int:
        return len(self._records)

    def get(self, key: str) -> dict[str, Any] | None:
        """The record of a key, or None."""
        return self._records.get(key)

    def append(self, key: str, record: Mapping[str, Any]) -> None:
        """Keep a record, and put it on the disk before returning.

        Raises:
            ValueError: the file cannot be written, or the record is nothing that JSON can hold.
        """
        line = json.dumps({"key": key, **record}, ensure_ascii=False, allow_nan=False) + "\n"
        if self.path is not None:
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                # one write of whole lines at the end: two runs may share a store
                handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
                try:
                    data = ("\n" * self._torn + line).encode()
                    self._torn = os.write(handle, data) < len(data)
                    os.fsync(handle)
                finally:
                    os.close(handle)
            except OSError as error:
                raise ValueError(f"{self.path}: scores cannot be stored ({error})") from error
            if self._torn:
                raise ValueError(f"{self.path}: scores cannot be stored (the disk is full)")
        self._records[key] = dict(record)

    def _read(self, path: Path) -> None:
        try:
            with open(path, encoding="utf-8", errors="replace") as file:
                for line in file:
                    self._torn = not line.endswith("\n")
                    try:
                        record = json.loads(line)
                        self._records[record.pop("key")] = record
                    except (ValueError, KeyError, TypeError, AttributeError):
                        continue  # cut short, or not ours: it is scored again
        except OSError as error:
            raise ValueError(f"{path}: stored scores cannot be read ({error})") from error


def content_hash(path: str | Path) -> str:
    """SHA-256 of a file's contents, in hexadecimal.

    Raises:
        ValueError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        reason = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        raise ValueError(f"{path}: {reason}") from error


def key_of(settings: Mapping[str, Any]) -> str:
    """SHA-256, in hexadecimal, of settings that JSON can hold, whatever their order."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True, allow_nan=False).encode()).hexdigest()
