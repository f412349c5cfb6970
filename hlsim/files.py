"""Writing of files all at once, hashes of files, and reading of tables."""

from __future__ import annotations

import codecs
import csv
import errno
import hashlib
import io
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_LOCK = ".lock"
"""Name of the file by which processes keep each other out of a folder."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Write a file all at once, from a ``with`` block that writes to a temporary path.

    When the block ends, the temporary file replaces ``path``, or the file to which it links. If the
    block raises, ``path`` stays as it was.

    Args:
        path: File to write. Its folder is made if there is none.

    Yields:
        The temporary path.

    Raises:
        ValueError: The path cannot be written, for example because the disk is full.

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_path(f"{folder}/scores.csv") as temporary:
    ...         _ = temporary.write_text("haspi")
    ...     Path(f"{folder}/scores.csv").read_text()
    'haspi'
    """
    target = Path(os.path.realpath(path))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".hlsim-", dir=target.parent) as folder:
            temporary = Path(folder) / Path(path).name
            yield temporary
            os.replace(temporary, target)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def lock_folder(folder: str | Path) -> Iterator[None]:
    """Keep other processes out of a folder, as long as they call this function as well.

    The operating system releases the lock when the ``with`` block or the process ends, even if the
    process is killed.

    Args:
        folder: Folder, which is made if there is none.

    Raises:
        ValueError: Another process has locked the folder, or the folder cannot be written.

    >>> with tempfile.TemporaryDirectory() as folder, lock_folder(folder):
    ...     pass
    """
    path = Path(folder) / _LOCK
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    except OSError as error:
        raise ValueError(f"{path}: cannot be written: {error.strerror or error}") from error
    with file:
        try:
            _lock(file)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                file.seek(0)
                raise ValueError(
                    f"{folder}: process {file.read()} is writing to this folder; wait until it "
                    "ends, or choose another folder"
                ) from error
            # Some file systems of clusters have no locks.
        file.truncate(0)
        print(os.getpid(), end="", file=file, flush=True)
        yield


def _lock(file: TextIO) -> None:
    """Lock an open file, or raise OSError if another process has locked it."""
    if sys.platform == "win32":
        file.seek(2**20)  # Locked bytes cannot be read by other processes.
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def write_atomically(path: str | Path, data: str | bytes) -> None:
    """Write a file completely, or leave it unchanged if writing fails.

    Args:
        path: File to write.
        data: Contents. Text is encoded as UTF-8.

    Raises:
        ValueError: The file cannot be written.

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(f"{folder}/scores.csv", "haspi")
    ...     Path(f"{folder}/scores.csv").read_text()
    'haspi'
    """
    contents = data.encode() if isinstance(data, str) else data
    with atomic_path(path) as temporary:
        temporary.write_bytes(contents)


def path_below(root: str | Path, name: str) -> Path:
    """Return the absolute path of a file that a manifest names, without ``..``.

    Links below the folder may lead out of it, as in corpora whose files are stored elsewhere.

    Args:
        root: Folder that contains all files of the manifest.
        name: Path of the file relative to the folder.

    Raises:
        ValueError: The name is empty, or the path leads out of the folder.

    >>> path_below("/corpus", "clean/../1.wav").as_posix()
    '/corpus/1.wav'
    """
    if not name:
        raise ValueError(f"expected the path of a file below {root}, got none; fill it in")
    folder = os.path.abspath(root)
    path = Path(os.path.normpath(os.path.join(folder, name)))
    if not path.is_relative_to(folder):
        raise ValueError(
            f"expected the path of a file below {root}, got {name!r}; move the file there, or pass "
            "the folder that contains all files as root"
        )
    return path


def sha256(path: Path) -> str:
    """Compute the SHA-256 hash of the contents of a file, in hexadecimal.

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(f"{folder}/empty", "")
    ...     sha256(Path(f"{folder}/empty"))[:8]
    'e3b0c442'
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_table(path: str | Path, contents: str) -> list[tuple[int, dict[str, str]]]:
    """Read a CSV file with commas, semicolons or tabs, in UTF-8, UTF-16 or Windows' cp1252.

    Args:
        path: CSV file, whose first line names the columns.
        contents: Description of the contents for error messages, such as "the manifest".

    Returns:
        A list with two members per row: the number of its last line, and its values by column,
        without surrounding blanks. Missing values are empty. Rows without any value are left out.

    Raises:
        ValueError: The file cannot be read or has no rows, a column appears twice, or a row has too
            many values.

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(f"{folder}/ears.csv", "name;500 Hz\\nA;20\\n")
    ...     read_table(f"{folder}/ears.csv", "the table")
    [(2, {'name': 'A', '500 Hz': '20'})]
    """
    rows = []
    try:
        with io.StringIO(_decode(Path(path).read_bytes()), newline="") as file:
            header = file.readline()
            delimiter = max(",;\t", key=header.count)
            file.seek(0)
            reader = csv.DictReader(file, delimiter=delimiter, restval="")
            names = [name.strip() for name in reader.fieldnames or ()]
            reader.fieldnames = names
            for name in names:
                if name and names.count(name) > 1:
                    raise ValueError(
                        f"{path}, line 1: the column {name} appears twice; rename one of the two"
                    )
            for row in reader:
                surplus_values = row.pop(None, ())
                if any(surplus_values):
                    raise ValueError(
                        f"{path}, line {reader.line_num}: expected {len(names)} values, one for "
                        f"each column of the header, got {len(names) + len(surplus_values)}; put "
                        "values that contain the separator into quotes"
                    )
                values = {name: value.strip() for name, value in row.items() if name}
                if any(values.values()):  # spreadsheets write rows of commas
                    rows.append((reader.line_num, values))
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: {contents} must be a CSV file in UTF-8 or cp1252 ({error})"
        ) from error
    except (OSError, csv.Error) as error:
        raise ValueError(f"{path}: cannot read {contents}: {error}") from error
    if not rows:
        raise ValueError(
            f"{path}: expected {contents} with a header and rows, got no rows; add them"
        )
    return rows


def _decode(data: bytes) -> str:
    """Decode the text of a file, in UTF-8 or in an encoding that spreadsheets write."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")
