"""Atomic writing of files, locks on folders, hashes of files, and reading of tables."""

import codecs
import csv
import hashlib
import inspect
import io
import json
import os
import tempfile
import unicodedata
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")

_LOCK = ".lock"
"""Name of the file that a process locks to keep other processes out of a folder."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Write a file all at once, from a ``with`` block that writes to a temporary path.

    When the block ends, the temporary file replaces ``path``, or the file to which it links. If the
    block raises, ``path`` stays as it was.

    Args:
        path: File to write. Its folder is created if there is none.

    Yields:
        The temporary path.

    Raises:
        ValueError: The path cannot be written, for example because the disk is full, or the block
            raised OSError.

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
        folder: Folder to lock, which is created if there is none.

    Raises:
        ValueError: The folder is locked already, or cannot be written.

    >>> with tempfile.TemporaryDirectory() as folder, lock_folder(folder):
    ...     pass
    """
    from filelock import FileLock, Timeout  # takes longer to import than this module

    lock = FileLock(Path(folder) / _LOCK)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except Timeout as error:
        raise ValueError(
            f"{folder}: another process is writing to this folder; wait until it ends, or choose "
            "another folder"
        ) from error
    except OSError as error:
        raise ValueError(
            f"{folder}: cannot write to this folder ({error.strerror or error}); choose another one"
        ) from error
    try:
        yield
    finally:
        lock.release()


def check_output_folder(folder: str | Path) -> None:
    """Raise ValueError unless files can be written to a folder, which need not exist yet.

    Commands call this function first, because they would otherwise fail after their work.

    >>> check_output_folder(tempfile.gettempdir())
    """
    paths = [Path(folder).absolute(), *Path(folder).absolute().parents]
    existing = next(path for path in paths if path.exists())
    reason = "" if os.access(existing, os.W_OK) else "there is no permission"
    if not existing.is_dir():
        reason = f"{existing} is a file"
    if reason:
        raise ValueError(f"{folder}: cannot write to this folder ({reason}); choose another one")


def check_output_file(path: str | Path, inputs: Iterable[Path] = ()) -> None:
    """Raise ValueError unless a file can be written, whose folder need not exist yet.

    Args:
        path: File to write.
        inputs: Files that must not be replaced.

    >>> check_output_file(f"{tempfile.gettempdir()}/page.html")
    """
    if Path(path).is_dir():
        raise ValueError(f"{path}: expected the name of a file, got a folder; add a name")
    if Path(path).resolve() in [file.resolve() for file in inputs]:
        raise ValueError(f"{path}: refusing to overwrite the input; choose another name")
    check_output_folder(Path(path).parent)


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


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return the text of a CSV file.

    Args:
        rows: Values of each row, the names of the columns first.

    >>> csv_text([["ear", "level"], ["N3", 40]])
    'ear,level\\nN3,40\\n'
    """
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


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


def source_hash(code: Any) -> str | None:
    """Compute the SHA-256 of the file with the source code of a class or function, in hexadecimal.

    The result is None if there is no such file, as for code in a notebook.

    >>> source_hash(len) is None
    True
    """
    try:
        return sha256(Path(inspect.getfile(code)))
    except (OSError, TypeError):
        return None


def read_json(path: str | Path) -> Any:
    """Return the contents of a JSON file.

    Args:
        path: File in UTF-8.

    Raises:
        ValueError: The file does not exist, is no JSON, or has an object with a key that occurs
            twice.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(f"{folder}/pairs.json").write_text('{"S1": ["L1"]}')
    ...     read_json(f"{folder}/pairs.json")
    {'S1': ['L1']}
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        return json.loads(text, object_pairs_hook=reject_duplicates)
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: cannot be read as JSON: {error}") from error


def reject_duplicates(pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    """Convert keys and values of a JSON or YAML file to a dict, and reject keys that occur twice.

    Without this function, the last value of such a key would be used.

    Args:
        pairs: Keys and values, as ``json.loads`` passes them to its ``object_pairs_hook``.

    Raises:
        ValueError: A key occurs twice.

    >>> import json
    >>> json.loads('{"N3": 1}', object_pairs_hook=reject_duplicates)
    {'N3': 1}
    """
    members = dict(pairs)
    if len(members) < len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in members if keys.count(key) > 1)
        raise ValueError(f"the key {repeated!r} occurs twice; remove one of the two")
    return members


def read_table(
    table: str | Path | Any, contents: str, known_columns: Collection[str] = ()
) -> list[tuple[str, dict[str, str]]]:
    """Read the rows of a CSV file or of a pandas ``DataFrame``.

    A file has commas, semicolons or tabs, and is in UTF-8, UTF-16 or Windows' cp1252.

    Args:
        table: CSV file, whose first line names the columns, or data frame.
        contents: Description of the contents for error messages, such as "the manifest".
        known_columns: Names in lower case of columns that may have capitals in the table, but have
            none in the result.

    Returns:
        One pair per row: its place for messages, such as ``ears.csv, line 2``, and its texts by
        column, without surrounding blanks. Missing values are empty. Rows without any value, and
        columns without a name, are left out.

    Raises:
        ValueError: The file cannot be read, the value is neither a file nor a data frame, there
            are no rows, a column appears twice, or a row has too many or too few values.

    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_atomically(f"{folder}/ears.csv", "Name;500 Hz\\nA;20\\n")
    ...     [row for _, row in read_table(f"{folder}/ears.csv", "the ears", ["name"])]
    [{'name': 'A', '500 Hz': '20'}]
    """
    if isinstance(table, str | Path):
        source, unit = str(table), "line"
        names, lines = _read_csv(Path(table), contents)
    else:
        if not hasattr(table, "columns"):
            raise ValueError(
                f"expected a CSV file or a pandas DataFrame for {contents}, got "
                f"{type(table).__name__}; pass the path of a file or a data frame"
            )
        source, unit = contents, "row"
        names = [str(column).strip() for column in table.columns]
        cells = table.astype(object).where(table.notna(), "").astype(str)
        lines = list(zip(table.index, cells.values.tolist(), strict=True))
    names = [name.lower() if name.lower() in known_columns else name for name in names]
    for name in names:
        if name and names.count(name) > 1:
            raise ValueError(f"{source}: the column {name} appears twice; rename one of the two")
    rows = []
    for number, texts in lines:
        place = f"{source}, {unit} {number}"
        if any(texts[len(names) :]):
            raise ValueError(
                f"{place}: expected {len(names)} values, one for each column of the "
                f"header, got {len(texts)}; put values that contain the separator into quotes"
            )
        pairs = zip(names, texts, strict=False)
        values = {name: text.strip() for name, text in pairs if name}
        if not any(values.values()):  # spreadsheets write rows of commas
            continue
        if missing := [name for name in names[len(texts) :] if name]:
            raise ValueError(
                f"{place}: expected {len(names)} values, one for each column of the header, got "
                f"{len(texts)}, and none for {', '.join(missing)}; complete the line, with a "
                "separator for each empty value"
            )
        rows.append((place, values))
    if not rows:
        raise ValueError(f"{source}: expected a table with rows, got no rows; add them")
    return rows


def check_spellings(rows: Iterable[tuple[str, Mapping[str, str]]], column: str) -> None:
    """Raise ValueError if two names in a column look alike, and may mean the same.

    They differ only in case, or are different codes of the same characters, such as an accent that
    is part of a letter or follows it.

    Args:
        rows: Rows of a table, as ``read_table`` returns them. Those without the column are passed
            over.
        column: Name of the column.

    >>> check_spellings([("line 2", {"listener": "A"}), ("line 3", {"listener": "B"})], "listener")
    """
    spellings: dict[str, str] = {}
    for place, row in rows:
        name = row.get(column, "")
        plain_name = unicodedata.normalize("NFKC", name).casefold()
        spelling = spellings.setdefault(plain_name, name)
        if spelling != name:
            raise ValueError(
                f"{place}: the {column} {name!a} differs from {spelling!a} only in case or in the "
                "codes of equal characters; write the same name in all places, or give one of the "
                "two another name"
            )


def warn_of_unused(columns: Collection[str], contents: str, known_columns: Collection[str]) -> None:
    """Warn of columns of a table that nothing reads, because their names may be misspelt.

    Args:
        columns: Names of the columns that nothing reads. If there are none, nothing happens.
        contents: Description of the table for the message.
        known_columns: Names of columns that are read.

    >>> warn_of_unused([], "the manifest", ["path"])
    """
    if columns:
        warnings.warn(
            f"columns of {contents} that are not used: {', '.join(sorted(columns))}; rename them "
            f"if they should be some of {', '.join(known_columns)}",
            stacklevel=3,
        )


def _read_csv(path: Path, contents: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Read the header of a CSV file, and the number and the texts of each line below it.

    Empty lines are left out. A number is that of the line in the file.

    Args:
        path: File with commas, semicolons or tabs.
        contents: Description of the contents for error messages.

    Raises:
        ValueError: The file cannot be read, or has another encoding, such as UTF-16 without its
            mark.
    """
    try:
        text = _decode(path.read_bytes())
        if "\0" in text:
            raise ValueError(
                f"{path}: {contents} must be a CSV file, got zero bytes, as in UTF-16 without a "
                "byte order mark; save it as UTF-8"
            )
        with io.StringIO(text, newline="") as file:
            header = file.readline()
            file.seek(0)
            reader = csv.reader(file, delimiter=max(",;\t", key=header.count))
            lines = [(reader.line_num, texts) for texts in reader if texts]
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: {contents} must be a CSV file in UTF-8, UTF-16 or cp1252 ({error})"
        ) from error
    except (OSError, csv.Error) as error:
        raise ValueError(f"{path}: cannot read {contents}: {error}") from error
    names = [name.strip() for name in lines[0][1]] if lines else []
    return names, lines[1:]


def convert_at(place: str, convert: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function, and put a place in a file in front of the message of its ValueError.

    Args:
        place: Place for the message, such as ``ears.csv, line 2``.
        convert: Function to call.
        arguments: Arguments of the function.

    Returns:
        The result of the function.

    Raises:
        ValueError: The function raised one.

    >>> convert_at("ears.csv, line 2", float, "20")
    20.0
    """
    try:
        return convert(*arguments)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def _decode(data: bytes) -> str:
    """Decode the text of a file: UTF-16 if it begins with its mark, UTF-8, or else cp1252.

    Raises:
        UnicodeDecodeError: The bytes are in none of these encodings.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")
