"""Files that are written whole or not at all, and rows of CSV files as people and spreadsheets write them."""

from __future__ import annotations

import csv
import errno
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from types import TracebackType
from typing import IO, Self

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

PARTIAL = ".part"
"""Ending of a file that is not yet whole."""


@contextmanager
def alone(path: Path) -> Iterator[None]:
    """Be the only process that holds this file, which exists; it ends with the process, however that ends.

    Raises:
        ValueError: another process holds it. Systems without such locks (Windows, some network drives) do not tell.
    """
    with path.open("rb") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{path.parent}: another process is writing there; wait until it is done"
            ) from None
        except OSError:
            pass  # no locks on this drive
        yield


class Whole:
    """A file under a temporary name, until ``keep`` gives it its own; left without that, it is removed.

    Raises:
        ValueError: it cannot be written; the message says so where the disk is full.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._partial = self.path.with_name(f".{self.path.name}.{os.getpid()}{PARTIAL}")
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self._partial, "wb")
        except OSError as error:
            raise self._refusal(error) from error
        return self

    def write(self, data: str | bytes) -> None:
        assert self._file is not None
        try:
            self._file.write(data.encode(errors="backslashreplace") if isinstance(data, str) else data)
        except OSError as error:
            raise self._refusal(error) from error

    def keep(self) -> None:
        """End the file and give it its name, over what had it."""
        assert self._file is not None
        try:
            self._file.close()
            os.replace(self._partial, self.path)
        except OSError as error:
            raise self._refusal(error) from error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._file is not None:
                self._file.close()
        except OSError:
            pass  # what could not be flushed is thrown away
        finally:
            self._partial.unlink(missing_ok=True)

    def _refusal(self, error: OSError) -> ValueError:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return ValueError(
                f"{self.path}: the disk is full; what was finished is kept, and with more space the same command goes on "
                "from there"
            )
        return ValueError(f"{self.path}: cannot be written ({error.strerror})")


def sha256(path: Path) -> str:
    """Of what a file holds."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_whole(path: str | Path, data: str | bytes) -> None:
    """A file of these contents, whole or not at all. Raises ValueError as ``Whole``."""
    with Whole(path) as file:
        file.write(data)
        file.keep()


def read_rows(path: str | Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row's number of the line that it ends in, and its values by column, "" where the row is short.

    Blanks around names and values are taken off, blank lines passed over, and columns without a name.

    Raises:
        OSError, UnicodeDecodeError, csv.Error: the file cannot be read.
        ValueError: a column twice, or a row of more values than columns; the message names file and line.
    """
    # spreadsheets put a byte order mark first, which would hide the first column
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(filter(None, reader), [])]
        for name in filter(None, header):
            if header.count(name) > 1:
                raise ValueError(f"{path}, line {reader.line_num}: column {name} twice; allowed: once")
        for values in filter(None, reader):
            if any(value.strip() for value in values[len(header) :]):
                raise ValueError(
                    f"{path}, line {reader.line_num}: {len(values)} values; allowed: one for each of the "
                    f"{len(header)} columns"
                )
            row = zip_longest(header, values[: len(header)], fillvalue="")
            yield reader.line_num, {name: value.strip() for name, value in row if name}
