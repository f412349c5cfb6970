"""Files: written atomically, hashed, and read as tables."""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

EXTENSIONS = tuple(
    ".wav .flac .ogg .oga .opus .mp3 .aif .aiff .aifc .au .snd .caf .w64 .rf64 .sph .voc".split()
)
"""Extensions of audio files that are looked for in folders; libsndfile reads all of them."""

WRITTEN_EXTENSIONS = (".wav", ".flac", ".ogg")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path for a file or folder, which takes the place of ``path`` afterwards.

    If the block raises, ``path`` stays as it was.

    Raises:
        ValueError: The file system refuses, because the disk is full or the folder is write-protected, say.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".hlsim-", dir=path.parent) as folder:
            temporary, previous = Path(folder) / path.name, Path(folder) / "previous"
            yield temporary
            if path.is_dir():
                os.replace(path, previous)
            try:
                os.replace(temporary, path)
            except OSError:
                if previous.exists():
                    os.replace(previous, path)
                raise
    except OSError as error:
        raise ValueError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_whole(path: str | Path, data: str | bytes) -> None:
    """Write a file; the file is complete or, if writing fails, as it was before. ValueError as ``atomic_path``."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode() if isinstance(data, str) else data)


def resolved(path: str | Path) -> Path:
    """Follow links. Unlike ``Path.resolve`` before Python 3.13, a link to itself raises nothing."""
    return Path(os.path.realpath(path))


def check_extension(path: str | Path) -> str:
    """Return the extension in lower case.

    Raises:
        ValueError: Files with this extension are not written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITTEN_EXTENSIONS:
        raise ValueError(f"{path}: expected the extension .wav, .flac or .ogg")
    return suffix


def sha256(path: Path) -> str:
    """Compute the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_table(path: str | Path, what: str) -> list[tuple[int, dict[str, str]]]:
    """Read a table with commas, semicolons or tabs, in UTF-8, UTF-16 or Windows' cp1252.

    Args:
        what: Description of the contents, for errors.

    Returns: for each row, the number of its last line and its values by column, without surrounding
        blanks. Missing values are empty.

    Raises:
        ValueError: The file cannot be read, a column appears twice, or a row has too many values.
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
            for name in filter(None, names):
                if names.count(name) > 1:
                    raise ValueError(f"{path}, line 1: the column {name} appears twice")
            for row in reader:
                if any(row.pop(None, ())):
                    raise ValueError(
                        f"{path}, line {reader.line_num}: expected {len(names)} values, got more"
                    )
                values = {name: value.strip() for name, value in row.items() if name}
                rows.append((reader.line_num, values))
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: {what} must be a CSV file in UTF-8 or cp1252 ({error})"
        ) from error
    except (OSError, csv.Error) as error:
        raise ValueError(f"{path}: cannot read {what}: {error}") from error
    return rows


def _decode(data: bytes) -> str:
    """Return the text of a file, in UTF-8 or else in one of the encodings that spreadsheets write."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")
