"""Audiograms and listeners in files and in pandas' data frames."""

import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from hlsim.audiogram.columns import UCL_WORDS, threshold_columns
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.published import STANDARD
from hlsim.audiogram.scale import EAR_NAMES, HIGHEST_LEVEL, HIGHEST_SIMULATED, EarName
from hlsim.audiogram.value import Audiogram, ears_in_row
from hlsim.files import check_spellings, convert_at, read_json, read_table

_Row = tuple[str, dict[str, str]]
"""A row of a table: its place in the file, for messages, and its texts by column."""


def read_audiograms(
    path: str | Path | Any, *, simulated: bool = False
) -> list[tuple[dict[str, str], Audiogram]]:
    """Read the audiograms of a table with one row per ear, per listener or per threshold.

    A column of thresholds is called ``hl_250``, ``250``, ``250 Hz`` or ``.25k``, or ``L250`` and
    ``R250`` if each row has both ears; one of uncomfortable levels ``ucl_250``, or ``ucl_L250`` and
    ``ucl_R250``. A long table has the columns ``frequency`` in Hz and ``threshold``, perhaps
    ``ucl``, and ``listener`` and ``ear`` if it has several ears. Other columns may have any name,
    in a long table only if it has ``listener`` and ``ear``; those of a long table are not read, and
    a warning names those that differ within an ear. A file may have commas, semicolons or tabs, and
    is in UTF-8, UTF-16 or Windows' cp1252.

    Args:
        path: A CSV file, a pandas ``DataFrame``, or ``"standard"`` for Bisgaard's audiograms N1 to
            N7 and S1 to S3.
        simulated: Whether the audiograms are for a simulator. Then thresholds above 100 dB HL are
            rejected, and N7, which has them, is left out of the standard audiograms.

    Returns:
        A list of pairs, one per ear: the texts of its row by column, and its audiogram. The names
        of the columns ``listener`` and ``ear`` are in lower case. For a row with both ears, the
        text in the column ``ear`` is ``left`` or ``right``. For a long table, the row has
        ``listener``, ``ear`` and a column per frequency, such as ``500 Hz``.

    Raises:
        ValueError: The file cannot be read, has no rows, a row is not an audiogram, columns
            contradict each other, the names of two listeners differ only in case, an ear has two
            thresholds at one frequency, or a column looks like thresholds and is not understood.
            The message names the file, and the line or row and the column where there is one.

    Example:
        >>> import hlsim
        >>> row, ear = hlsim.read_audiograms("standard")[3]
        >>> row, ear
        ({'listener': 'N4'}, Audiogram('N4'))
    """
    highest = HIGHEST_SIMULATED if simulated else HIGHEST_LEVEL
    if isinstance(path, str | Path) and str(path) == "standard":
        standard = [(name, Audiogram.standard(name)) for name in STANDARD if name != "NH"]
        return [({"listener": name}, ear) for name, ear in standard if max(ear.levels) <= highest]
    audiograms = []
    for place, row in _read_rows(path):
        for name, ear in convert_at(place, _read_ears, row, highest).items():
            is_named = name is None or row.get("ear", "").lower() in EAR_NAMES
            audiograms.append((row if is_named else {**row, "ear": str(name)}, ear))
    return audiograms


def read_listeners(
    path: str | Path | Any, names: Collection[str] | None = None
) -> dict[str, Listener]:
    """Read listeners from Clarity's ``listeners.json`` or from a table.

    The table has a column ``listener``. It has one row per ear, with the column ``ear`` (left or
    right, L or R, LE or RE), one row per listener with both ears, or one row per threshold, as
    ``read_audiograms`` describes.

    Args:
        path: A file, whose name ends in ``.json`` if it is Clarity's, or a pandas ``DataFrame``.
        names: Names of the listeners to read, by default all. The thresholds of other listeners are
            not validated.

    Returns:
        Listeners, each under its name. An ear without thresholds in a table is None.

    Raises:
        ValueError: The file cannot be read, has no column ``listener`` or no listener of a name,
            the names of two listeners differ only in case, or an ear is not valid, is neither left
            nor right, or occurs twice. The message names the file and the line or the listener.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(f"{folder}/ears.csv").write_text("listener,L500,R500\\nA,20,30\\n")
    ...     read_listeners(f"{folder}/ears.csv")
    {'A': Listener(left=Audiogram({500: 20}), right=Audiogram({500: 30}))}
    """
    is_file = isinstance(path, str | Path)
    is_json = is_file and str(path).lower().endswith(".json")
    records: Mapping[str, Any] = _read_entries(path) if is_json else _group_rows(path)
    source = path if is_file else "the table"
    listeners = {}
    for name in records if names is None else names:
        if name not in records:
            examples = ", ".join([*records][:5])
            raise ValueError(f"{source}: no listener {name!r}; expected a name such as {examples}")
        if is_json:
            place = f"{path}, listener {name}"
            listeners[name] = convert_at(place, Listener.from_clarity, records[name])
        else:
            listeners[name] = _join_ears(name, records[name])
    return listeners


def _read_entries(path: str | Path) -> Mapping[str, Any]:
    """Read the entries of Clarity's ``listeners.json``, each under the name of its listener.

    Raises:
        ValueError: The file does not exist, is no JSON, has a key twice, is not an object with
            entries, or the names of two listeners differ only in case.
    """
    entries = read_json(path)
    if not isinstance(entries, Mapping) or not entries:
        raise ValueError(f"{path}: expected one entry per listener, as in Clarity's listeners.json")
    check_spellings([(str(path), {"listener": name}) for name in entries], "listener")
    return entries


def _group_rows(path: str | Path | Any) -> dict[str, list[_Row]]:
    """Read the rows of a table, and group them by the name of the listener.

    Raises:
        ValueError: The table cannot be read, has no column ``listener``, or no name in a row of it.
    """
    rows: dict[str, list[_Row]] = {}
    for place, row in _read_rows(path):
        if "listener" not in row:
            raise ValueError(
                f"{place}: expected a column listener, got the columns {', '.join(row)}; add it, "
                "or rename one of them"
            )
        name = row["listener"]
        if not name:
            raise ValueError(f"{place}: expected a name in the column listener, got none; add it")
        rows.setdefault(name, []).append((place, row))
    return rows


def _join_ears(listener: str, rows: Sequence[_Row]) -> Listener:
    """Build a listener from one row with both ears, or from one row per ear.

    An ear without thresholds is None in the listener.

    Args:
        listener: Name of the listener, for messages.
        rows: The rows, each with its place in the table.

    Raises:
        ValueError: A row names no ear, an ear occurs twice, or an ear is not valid.
    """
    ears: dict[EarName, Audiogram] = {}
    for place, row in rows:
        for name, ear in convert_at(place, _read_ears, row).items():
            if name is None:
                text = row.get("ear", "")
                raise ValueError(
                    f"{place}: expected left or right in the column ear, got {text!r}; correct it"
                )
            if name in ears:
                raise ValueError(
                    f"{place}: expected one row for the {name} ear of listener {listener}, got a "
                    "second one; remove one of them"
                )
            ears[name] = ear
    return Listener(ears.get("left"), ears.get("right"))


def _read_ears(
    row: Mapping[str, str], highest: float = HIGHEST_LEVEL
) -> dict[EarName | None, Audiogram]:
    """Convert a row into audiograms, under ``"left"``, ``"right"``, or None for an unknown ear.

    Either the columns of thresholds name the ear, such as L500, or the column ``ear`` does.

    Args:
        row: Texts by column.
        highest: Highest level allowed, in dB HL.

    Raises:
        ValueError: The thresholds are not valid (see ``ears_in_row``), the column ``ear`` contains
            no name of an ear, or both the columns of thresholds and the column ``ear`` name it.
    """
    ears = ears_in_row(row, highest)
    if None in ears:
        return {named_ear(row): ears[None]}
    if row.get("ear", "").lower() in EAR_NAMES:
        raise ValueError(
            f"columns of thresholds name the ear, and the column ear has {row['ear']!r}; "
            "remove the column ear"
        )
    return ears


def named_ear(row: Mapping[str, str]) -> EarName | None:
    """Return the ear that the column ``ear`` of a row names, or None if there is no text.

    Raises:
        ValueError: The text is no name of an ear.

    >>> named_ear({"ear": "L"}), named_ear({})
    ('left', None)
    """
    text = row.get("ear", "")
    name = EAR_NAMES.get(text.lower())
    if text and name is None:
        raise ValueError(f"expected left or right in the column ear, got {text!r}; correct it")
    return name


def _read_rows(table: str | Path | Any) -> list[_Row]:
    """Read the rows of a table of ears, and join the rows of a table with one threshold per row.

    Returns:
        Rows with one or two ears each.

    Raises:
        ValueError: The table cannot be read, its columns contradict each other, the names of two
            listeners differ only in case, or a row is not valid, see ``_widen``.
    """
    rows = read_table(table, "audiograms", ("listener", "ear"))
    check_spellings(rows, "listener")
    columns: dict[str, str] = {}
    for column in rows[0][1]:
        if re.search(r"\d", column):  # "threshold 500" is a column of a wide table
            continue
        other = columns.setdefault(_without_units(column), column)
        if other != column and _without_units(column) in ("frequency", "threshold"):
            raise ValueError(
                f"{rows[0][0]}: expected one column of each kind, got {other} and {column}; remove "
                "one of them"
            )
    is_long = {"frequency", "threshold"} <= columns.keys()
    if not is_long:
        return rows
    ucl = [name for words, name in columns.items() if not UCL_WORDS.isdisjoint(words.split())]
    names = [column for column in rows[0][1] if column not in ucl]
    wide_columns = convert_at(rows[0][0], threshold_columns, names)
    if wide_columns:
        raise ValueError(
            f"{rows[0][0]}: expected thresholds in the column {columns['threshold']} alone, got "
            f"some in {', '.join(wide_columns)} as well; remove one of both"
        )
    return _widen(rows, columns["frequency"], columns["threshold"], ucl)


def _without_units(column: str) -> str:
    """Return the words of a column's name in lower case, without Hz, dB and HL."""
    words = re.findall("[a-z]+", column.lower())
    return " ".join(word for word in words if word not in ("hz", "db", "hl"))


def _widen(rows: Sequence[_Row], frequency: str, threshold: str, ucl: Sequence[str]) -> list[_Row]:
    """Join the rows of each ear of a table with one threshold per row.

    Further columns are left out. A warning names those that differ between the rows of an ear.

    Args:
        rows: Rows of the table.
        frequency: Name of the column of frequencies in Hz.
        threshold: Name of the column of thresholds in dB HL.
        ucl: Names of the columns of uncomfortable levels in dB HL.

    Returns:
        One row per ear, with the place of the first row of this ear. Its columns are the listener,
        the ear and, per frequency, one column of thresholds and perhaps of uncomfortable levels.

    Raises:
        ValueError: There are further columns without those of the listener and the ear, a frequency
            is not understood, an ear has two thresholds at one frequency, or a row lacks the
            listener or the ear that other rows have.
    """
    names = [column for column in rows[0][1] if column not in (frequency, threshold, *ucl)]
    key_names: list[str] = [name for name in ("listener", "ear") if name in names]
    if names and len(key_names) < 2:
        raise ValueError(
            f"{rows[0][0]}: expected the columns listener and ear beside {frequency} and "
            f"{threshold}, got {', '.join(names)}; add or rename columns"
        )
    other_names = [name for name in names if name not in key_names]
    # A spreadsheet with merged cells names the listener and the ear in the first row only.
    required_names = [name for name in key_names if any(row[name] for _, row in rows)]
    ears: dict[tuple[str, ...], tuple[str, dict[str, str], dict[str, str]]] = {}
    differing_names = set()
    for place, row in rows:
        ear = {name: row[name] for name in key_names}
        for name in required_names:
            if not row[name]:
                raise ValueError(
                    f"{place}: expected a value in the column {name}, as in other rows, got none; "
                    "fill it in"
                )
        key = tuple(EAR_NAMES.get(text.lower(), text) for text in ear.values())
        _, wide, first_row = ears.setdefault(key, (place, ear, row))
        differing_names |= {name for name in other_names if row[name] != first_row[name]}
        text = row[frequency]
        column = text if re.search("k|hz", text.lower()) else f"{text} Hz"
        if not convert_at(place, threshold_columns, [column]):
            raise ValueError(
                f"{place}: expected a frequency in the column {frequency}, got {text!r}; correct "
                "or remove the row"
            )
        if column in wide:
            raise ValueError(
                f"{place}: expected one threshold at {column} for this ear, got a second one; "
                "remove one of them"
            )
        wide[column] = row[threshold]
        wide |= {f"{name} {column}": row[name] for name in ucl}
    if differing_names:
        warnings.warn(
            f"{rows[0][0]}: not read, although they differ between the thresholds of one ear: the "
            f"columns {', '.join(sorted(differing_names))}; remove rows that are not thresholds of "
            "air conduction",
            stacklevel=2,
        )
    return [(place, wide) for place, wide, _ in ears.values()]
