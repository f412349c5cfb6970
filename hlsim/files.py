"""Files and folders that are written whole or not at all, by one process at a time; rows of CSV files.

Everything that hlsim leaves on a disk is first written under a temporary name beside its place, and then renamed.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import zip_longest
from pathlib import Path
from typing import IO, Self

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

EXTENSIONS = (".wav", ".flac", ".ogg")
"""Of audio that is read and written."""

PARTIAL = ".part"
"""Ending of a file that is not yet whole."""


@contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Be the only process that holds this file, which exists; it ends with the process, however that ends.

    Raises:
        ValueError: another process holds it. Systems without such locks (Windows, some network drives) do not tell.
    """
    with path.open("rb") as file:
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            where = path.parent
            raise ValueError(
                f"{where}: another process is writing there; wait until it is done"
            ) from None
        except OSError:
            pass  # no locks on this drive
        yield


class Whole:
    """A file under a temporary name, until ``keep`` gives it the right one; left without that, it is removed.

    Args:
        new_folder: make the folder that it is in, if need be.

    Attributes:
        partial: the temporary name, for libraries that write by themselves.

    Raises:
        ValueError: it cannot be written; the message says so where the disk is full.
    """

    def __init__(self, path: str | Path, *, new_folder: bool = True) -> None:
        self.path, self._new_folder = Path(path), new_folder
        self.partial = self.path.with_name(f".{self.path.name}.{os.getpid()}{PARTIAL}")
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            if self._new_folder:
                self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self.partial, "wb")
        except OSError as error:
            raise self.refusal(error) from error
        return self

    def write(self, data: str | bytes) -> None:
        assert self._file is not None
        try:
            self._file.write(
                data.encode(errors="backslashreplace") if isinstance(data, str) else data
            )
        except OSError as error:
            raise self.refusal(error) from error

    def keep(self) -> None:
        """End the file and give it its name, over what had it."""
        assert self._file is not None
        try:
            self._file.close()
            os.replace(self.partial, self.path)
        except OSError as error:
            raise self.refusal(error) from error

    def __exit__(self, *raised: object) -> None:
        with suppress(OSError):  # what could not be flushed is thrown away
            if self._file is not None:
                self._file.close()
        self.partial.unlink(missing_ok=True)

    def refusal(self, error: Exception) -> ValueError:
        """What to raise where writing failed."""
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return ValueError(
                f"{self.path}: the disk is full; what was finished is kept, and with more space the same command goes on "
                "from there"
            )
        return ValueError(
            f"{self.path}: cannot be written ({getattr(error, 'strerror', None) or error})"
        )


def write_whole(path: str | Path, data: str | bytes) -> None:
    """A file of these contents, whole or not at all. Raises ValueError as ``Whole``."""
    with Whole(path) as file:
        file.write(data)
        file.keep()


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder to fill; it takes its name at the end, and an older one of that name goes.

    Left by an error, the older one stays; killed, ``repair_folder`` brings it back.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    repair_folder(folder)
    staging, old = (
        Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent)),
        _old(folder),
    )
    try:
        yield staging
        staging.chmod(0o755)
        shutil.rmtree(old, ignore_errors=True)
        if folder.exists():
            os.replace(folder, old)
        os.replace(staging, folder)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if old.exists() and not folder.exists():
            os.replace(old, folder)


def repair_folder(folder: Path) -> None:
    """Undo what a kill within ``whole_folder`` left: the older folder gets its name back, and the rest goes."""
    old = _old(folder)
    if old.exists() and not folder.exists():
        with suppress(FileNotFoundError):  # another process was first
            os.replace(old, folder)
    staged = re.compile(rf"\.{re.escape(folder.name)}\.[a-z0-9_]{{8}}")  # as mkdtemp names it
    for path in folder.parent.glob(f".{folder.name}.*"):
        if path.is_dir() and staged.fullmatch(path.name):
            shutil.rmtree(path, ignore_errors=True)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


def resolved(path: str | Path) -> Path:
    """Links followed; one that leads to itself stays, at which ``Path.resolve`` raises RuntimeError up to Python 3.12.

    ValueError for a null character."""
    if "\0" in str(path):
        raise ValueError(f"{str(path)!r}: holds a null character; allowed: a path")
    return Path(os.path.realpath(path))


def check_extension(path: str | Path) -> str:
    """Return the extension in lower case, or raise ValueError unless it is one of audio that is written."""
    suffix = Path(path).suffix.lower()
    if suffix not in EXTENSIONS:
        found = suffix or "a file without extension"
        raise ValueError(f"{path}: cannot write {found}; allowed: {', '.join(EXTENSIONS)}")
    return suffix


def sha256(path: Path) -> str:
    """Of what a file holds."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_rows(path: str | Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row's number of the line that it ends in, and its values by column, "" where the row is short.

    Blanks around names and values are taken off, blank lines passed over, and columns without a name.

    Raises:
        OSError, UnicodeDecodeError, csv.Error: the file cannot be read.
        ValueError: a column twice, or a row of more values than columns or with a null character; the message names file
            and line.
    """
    # spreadsheets put a byte order mark first, which would hide the first column
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(filter(None, reader), [])]
        for name in filter(None, header):
            if header.count(name) > 1:
                raise ValueError(
                    f"{path}, line {reader.line_num}: column {name} twice; allowed: once"
                )
        for values in filter(None, reader):
            if "\0" in "".join(values):
                raise ValueError(
                    f"{path}, line {reader.line_num}: holds a null character; allowed: text"
                )
            if any(value.strip() for value in values[len(header) :]):
                allowed = f"one for each of the {len(header)} columns"
                raise ValueError(
                    f"{path}, line {reader.line_num}: {len(values)} values; allowed: {allowed}"
                )
            row = zip_longest(header, values[: len(header)], fillvalue="")
            yield reader.line_num, {name: value.strip() for name, value in row if name}


def read_table(path: str | Path, what: str) -> list[tuple[int, dict[str, str]]]:
    """All of ``read_rows``. Raises ValueError that names ``what`` where the file cannot be read, too."""
    try:
        return list(read_rows(path))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: cannot read {what}: {error}") from error
