"""Audiograms and listeners in files."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

from hlsim.audiogram.listener import EAR_NAMES, Listener
from hlsim.audiogram.scale import HIGHEST_LEVEL, HIGHEST_SIMULATED, STANDARD
from hlsim.audiogram.value import Audiogram, convert_at
from hlsim.files import read_table

_Builders = Mapping[str, Callable[[], Listener]]
"""Functions that build listeners, under the names of the listeners."""


def read_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[dict[str, str], Audiogram]]:
    """Read the audiograms of a CSV file with one row per ear.

    A column of thresholds is called ``hl_250``, ``250``, ``250 Hz`` or ``.25k``
    (``Audiogram.from_row`` describes the details); other columns may have any name. The table may
    have commas, semicolons or tabs, and is in UTF-8, UTF-16 or Windows' cp1252.

    Args:
        path: The file, or ``"standard"`` for Bisgaard's audiograms N1 to N7 and S1 to S3.
        simulated: Whether the audiograms are for a simulator. Then thresholds above 100 dB HL are
            rejected, and N7, which has them, is left out of the standard audiograms.

    Returns:
        A list with two members per row: the texts of the row by column, and its audiogram.

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
    if str(path) == "standard":
        standard = [(name, Audiogram.standard(name)) for name in STANDARD if name != "NH"]
        return [({"listener": name}, ear) for name, ear in standard if max(ear.levels) <= highest]
    ears = []
    for line, row in read_table(path, "audiograms"):
        ear = convert_at(f"{path}, line {line}", Audiogram.from_row, row, highest)
        ears.append((row, ear))
    return ears


def read_listeners(path: str | Path, names: Collection[str] | None = None) -> dict[str, Listener]:
    """Read listeners from Clarity's ``listeners.json`` or from a CSV file.

    The CSV file has one row per ear, with the columns ``listener`` and ``ear`` (left or right, L or
    R, LE or RE) beside the thresholds that ``read_audiograms`` describes.

    Args:
        path: The file. Its name ends in ``.json`` if it is Clarity's.
        names: Names of the listeners to read, by default all. Other listeners are not validated.

    Returns:
        Listeners, each under its name.

    Raises:
        ValueError: The file cannot be read, has no listener of a name, or an ear is not valid, is
            neither left nor right, or occurs twice. The message names the file and the line or the
            listener.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(f"{folder}/ears.csv").write_text("listener,ear,500 Hz\\nA,L,20\\nA,R,30\\n")
    ...     read_listeners(f"{folder}/ears.csv")
    {'A': Listener(left=Audiogram({500: 20}), right=Audiogram({500: 30}))}
    """
    is_json = str(path).lower().endswith(".json")
    builders = _read_entries(path) if is_json else _group_rows(path)
    for name in names or ():
        if name not in builders:
            examples = ", ".join([*builders][:5])
            raise ValueError(f"{path}: no listener {name!r}; expected a name such as {examples}")
    return {name: builders[name]() for name in (builders if names is None else names)}


def _read_entries(path: str | Path) -> _Builders:
    """Read Clarity's ``listeners.json``, and return functions that build the listeners."""
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: cannot read listeners: {error}") from error
    if not isinstance(entries, Mapping) or not entries:
        raise ValueError(f"{path}: expected one entry per listener, as in Clarity's listeners.json")
    return {
        name: partial(convert_at, f"{path}, listener {name}", Listener.from_clarity, entry)
        for name, entry in entries.items()
    }


def _group_rows(path: str | Path) -> _Builders:
    """Read the rows of a CSV file, and return functions that build the listeners."""
    rows: dict[str, list[tuple[str, dict[str, str]]]] = {}
    for line, row in read_table(path, "audiograms"):
        place = f"{path}, line {line}"
        columns = {column.lower(): text for column, text in row.items()}
        name = columns.get("listener")
        if not name:
            raise ValueError(f"{place}: expected a name in the column listener, got none; add it")
        rows.setdefault(name, []).append((place, columns))
    return {name: partial(_join_ears, rows_of_name) for name, rows_of_name in rows.items()}


def _join_ears(rows: Sequence[tuple[str, dict[str, str]]]) -> Listener:
    """Return the listener of one or two rows."""
    ears: dict[str, Audiogram | None] = {"left": None, "right": None}
    for place, row in rows:
        text = row.get("ear", "")
        ear = EAR_NAMES.get(text.lower())
        if ear is None:
            raise ValueError(
                f"{place}: expected left or right in the column ear, got {text!r}; correct it"
            )
        if ears[ear] is not None:
            raise ValueError(
                f"{place}: expected one row for the {ear} ear of listener {row['listener']}, got a "
                "second one; remove one of them"
            )
        ears[ear] = convert_at(place, Audiogram.from_row, row)
    return Listener(**ears)
