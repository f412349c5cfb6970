"""Audiograms and listeners in files."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from hlsim.audiogram.listener import EAR_NAMES, Listener
from hlsim.audiogram.value import HIGHEST_LEVEL, HIGHEST_SIMULATED, STANDARD, Audiogram, EarName
from hlsim.files import read_table

STANDARD_TABLE = "standard"
"""Name that ``read_audiograms`` takes in place of a file for Bisgaard's audiograms."""


def read_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[dict[str, str], Audiogram]]:
    """Read the audiograms of a CSV file.

    The table may have commas, semicolons or tabs, and is in UTF-8, UTF-16 or Windows' cp1252.
    ``Audiogram.from_row`` describes its columns.

    Args:
        path: The file, or ``"standard"`` for Bisgaard's audiograms N1 to N7 and S1 to S3.
        simulated: Reject levels above 100 dB HL, which simulators do not take, and leave out N7 of
            the standard audiograms, which has them.

    Returns:
        For each row, its texts by column and its audiogram.

    Raises:
        ValueError: The file cannot be read, has no rows, or a row is not an audiogram. The message
            names the file, the line and the column.

    Example:
        >>> import hlsim
        >>> row, ear = hlsim.read_audiograms("standard")[3]
        >>> row, ear
        ({'listener': 'N4'}, Audiogram('N4'))
    """
    highest = HIGHEST_SIMULATED if simulated else HIGHEST_LEVEL
    if str(path) == STANDARD_TABLE:
        names = [
            name for name, levels in STANDARD.items() if name != "NH" and max(levels) <= highest
        ]
        return [({"listener": name}, Audiogram.standard(name)) for name in names]
    rows = read_rows(path)
    return [(row, parse_row(path, line, row, highest)) for line, row in rows]


def read_audiogram(path: str | Path, name: str | None = None) -> Audiogram:
    """Read one ear from a table, as ``Audiogram.from_csv``."""
    rows = read_audiograms(path)
    found = [ear for row, ear in rows if name is None or name in row.values()]
    if len(found) != 1:
        wanted = "row" if name is None else f"row with {name!r} in a column"
        raise ValueError(
            f"{path}: expected one {wanted}, found {len(found)}; pass the name of a row"
        )
    return found[0]


def read_rows(path: str | Path) -> list[tuple[int, dict[str, str]]]:
    """Read the rows of a table of audiograms with the numbers of their lines, not yet converted."""
    rows = read_table(path, "audiograms")
    if not rows:
        raise ValueError(
            f"{path}: expected a header such as hl_250,hl_500,... and one row per ear, found no rows"
        )
    return rows


def parse_row(
    path: str | Path, line: int, row: dict[str, str], highest: float = HIGHEST_LEVEL
) -> Audiogram:
    """Return the audiogram of a row, or raise ValueError with the file and the line."""
    try:
        return Audiogram.from_row(row, highest=highest)
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}") from error


def lower_columns(row: Mapping[str, str]) -> dict[str, str]:
    """Return a row with the names of its columns in lower case."""
    return {column.lower(): text for column, text in row.items()}


def read_listeners(path: str | Path, names: Collection[str] | None = None) -> dict[str, Listener]:
    """Read listeners from Clarity's ``listeners.json`` or from a CSV file.

    The CSV file has one row per ear, with the columns ``listener`` and ``ear`` (left or right, L or
    R, LE or RE) beside the thresholds that ``read_audiograms`` describes.

    Args:
        path: The file. Its name ends in ``.json`` if it is Clarity's.
        names: Names of the listeners to read, by default all. The others are not validated.

    Returns:
        Listeners by name.

    Raises:
        ValueError: The file cannot be read, has no listener of a name, or an ear is not valid, is
            neither left nor right, or occurs twice. The message names the file and the line or the
            listener.
    """
    is_json = str(path).lower().endswith(".json")
    sources = _read_entries(path) if is_json else _read_rows_by_listener(path)
    unknown = sorted(set(names or ()) - sources.keys())
    if unknown:
        few = ", ".join(list(sources)[:5]) + (", ..." if len(sources) > 5 else "")
        raise ValueError(f"{path}: no listener {unknown[0]!r}; expected one of {few}")
    convert = _convert_entry if is_json else _convert_rows
    wanted = [name for name in sources if names is None or name in names]
    return {name: convert(path, name, sources[name]) for name in wanted}


def _read_entries(path: str | Path) -> Mapping[str, Any]:
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: cannot read listeners: {error}") from error
    if not isinstance(entries, Mapping) or not entries:
        raise ValueError(f"{path}: expected one entry per listener, as in Clarity's listeners.json")
    return entries


def _convert_entry(path: str | Path, name: str, entry: Any) -> Listener:
    try:
        return Listener.from_clarity(entry)
    except ValueError as error:
        raise ValueError(f"{path}, listener {name}: {error}") from error


def _read_rows_by_listener(path: str | Path) -> dict[str, list[tuple[int, dict[str, str]]]]:
    rows: dict[str, list[tuple[int, dict[str, str]]]] = {}
    for line, row in read_rows(path):
        name = lower_columns(row).get("listener")
        if not name:
            raise ValueError(f"{path}, line {line}: expected a name in the column listener")
        rows.setdefault(name, []).append((line, row))
    return rows


def _convert_rows(
    path: str | Path, name: str, rows: Sequence[tuple[int, dict[str, str]]]
) -> Listener:
    ears: dict[EarName, Audiogram] = {}
    for line, row in rows:
        text = lower_columns(row).get("ear", "")
        ear = EAR_NAMES.get(text.lower())
        if ear is None or ear in ears:
            raise ValueError(
                f"{path}, line {line}: expected one row per ear of {name}, with left or right in the "
                f"column ear, got {text!r}" + (" again" if ear else "")
            )
        ears[ear] = parse_row(path, line, row)
    return Listener(ears.get("left"), ears.get("right"))
