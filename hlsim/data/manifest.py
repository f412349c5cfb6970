"""The manifest: a CSV row an utterance, with paths that never lead out of the root."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

from hlsim.files import resolved

SPLITS = ("train", "valid", "test")

_READ: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float}
_READ["float | None"] = lambda text: float(text) if text else None


@dataclass(frozen=True, slots=True)
class Utterance:
    """One row of a manifest.

    Attributes:
        id: unique in the manifest.
        speaker: one that is in no other split.
        split: train, valid or test.
        clean: path of the clean speech below the root.
        noisy: path of its recorded or published noisy counterpart; empty where there is none.
        noise: its type; or, without ``noisy``, the path below the root of the noise to mix in; or empty.
        snr: signal-to-noise ratio in dB by active speech level; None where unknown or without noise.
        noise_start: second of the noise at which mixing starts.
        rate: of the files, Hz.
        seconds: length.
        active_level: active speech level of the clean speech (ITU-T P.56) in dB relative to RMS 1.0.
    """

    id: str
    speaker: str
    split: str
    clean: str
    noisy: str = ""
    noise: str = ""
    snr: float | None = None
    noise_start: float | None = None
    rate: int = 0
    seconds: float = 0.0
    active_level: float = 0.0

    def to_row(self) -> dict[str, str]:
        row = {name: getattr(self, name) for name in UTTERANCE_COLUMNS}
        return {
            name: f"{value:.6g}"
            if isinstance(value, float)
            else ""
            if value is None
            else str(value)
            for name, value in row.items()
        }

    @classmethod
    def from_row(cls, row: Mapping[str, str]) -> Utterance:
        """Raises ValueError where a column is missing or holds what it cannot."""
        try:
            utterance = cls(
                **{entry.name: _READ[str(entry.type)](row[entry.name]) for entry in fields(cls)}
            )
        except (KeyError, TypeError, ValueError) as error:
            allowed = ", ".join(UTTERANCE_COLUMNS)
            raise ValueError(f"no row of a manifest ({error!r}); allowed: {allowed}") from None
        if utterance.split not in SPLITS:
            raise ValueError(f"split {utterance.split!r}; allowed: {', '.join(SPLITS)}")
        return utterance

    @property
    def mixed(self) -> bool:
        """Whether the noisy counterpart is made from ``clean`` and ``noise``."""
        return not self.noisy and bool(self.noise)


UTTERANCE_COLUMNS = tuple(entry.name for entry in fields(Utterance))


def inside(root: str | Path, relative: str) -> Path:
    """The path ``root / relative``, or ValueError where it leads out of the root, be it through .. or a link."""
    path = PurePosixPath(relative)
    full = Path(root) / path
    if (
        path.is_absolute()
        or ".." in path.parts
        or not resolved(full).is_relative_to(_resolved(Path(root)))
    ):
        raise ValueError(
            f"{relative}: leads out of {root}; allowed: paths below it, without .. and links out"
        )
    return full


class Rows(Sequence[dict[str, str]]):
    """Rows of a CSV file, kept as they are written and parsed when asked for: dictionaries take ten times as much.

    Raises ValueError where the file cannot be read, or lacks a column."""

    def __init__(self, path: str | Path, columns: Iterable[str]) -> None:
        self.path = Path(path)
        try:
            self._lines = self.path.read_bytes().splitlines()
        except OSError as error:
            raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
        self.columns = self._parse(0) if self._lines else []
        if missing := ", ".join(name for name in columns if name not in self.columns):
            raise ValueError(f"{path}: no column {missing}; allowed: a CSV file of 'hlsim prepare'")

    def __len__(self) -> int:
        return len(self._lines) - 1

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        line = index % len(self) + 1
        cells, wanted = self._parse(line), len(self.columns)
        if len(cells) != wanted:
            raise ValueError(f"{self.path}, line {line + 1}: {len(cells)} cells; allowed: {wanted}")
        return dict(zip(self.columns, cells, strict=True))

    def _parse(self, line: int) -> list[str]:
        try:
            return next(csv.reader([self._lines[line].decode("utf-8-sig")]), [])
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(
                f"{self.path}, line {line + 1}: cannot be read as CSV ({error})"
            ) from error


def csv_line(cells: Iterable[object]) -> str:
    """One line of a CSV file; line breaks within cells become spaces."""
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(
        [" ".join(str(cell).splitlines()) for cell in cells]
    )
    return line.getvalue()


def no_formula(path: str) -> str:
    """The same relative path, which no spreadsheet takes for a formula."""
    return f"./{path}" if path.startswith(("=", "+", "-", "@")) else path


def storable(name: str) -> bool:
    """Whether a name comes back from a CSV file as it was: it is UTF-8 and has no line break."""
    return " ".join(name.splitlines()).encode(errors="replace").decode() == name


def printable(name: str) -> str:
    """What cannot be printed in a line, as escapes."""
    return "".join(
        char if char.isprintable() else char.encode("unicode_escape").decode() for char in name
    )


_resolved = lru_cache(maxsize=16)(resolved)
