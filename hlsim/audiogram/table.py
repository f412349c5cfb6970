"""Audiograms and listeners in files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from hlsim.audiogram.listener import EARS, Listener
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.audiogram.value import Audiogram
from hlsim.files import read_table


def read_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[dict[str, str], Audiogram]]:
    """Read the audiograms of a CSV file, which has one row per ear and columns ``hl_250`` and so on.

    Args:
        path: file to read. Blanks around names and values do not count. Frequencies other than the
            eight of simulators are kept and interpolated, as ``Audiogram`` describes.
        simulated: accept only ears that simulators accept.

    Returns: for each row, its values by column and its audiogram.

    Raises:
        ValueError: the file is missing or empty, has a column twice, or a row holds no audiogram
            or, with ``simulated``, a level above 100 dB HL. The message names file and line.
    """
    return [(row, ear) for _, row, ear in numbered_audiograms(path, simulated=simulated)]


def numbered_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[int, dict[str, str], Audiogram]]:
    """Return the rows of ``read_audiograms``, each after the number of its line, for messages."""
    rows = read_table(path, "audiograms")
    if not rows:
        raise ValueError(
            f"{path}: no audiograms; expected a header with hl_250, hl_500 and so on, "
            "and one row per ear"
        )
    ears = []
    for line, row in rows:
        try:
            ear = Audiogram.from_row(row)
            if simulated:
                as_thresholds(ear)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
        ears.append((line, row, ear))
    return ears


def read_listeners(path: str | Path) -> dict[str, Listener]:
    """Read listeners by name.

    Args:
        path: Clarity's ``listeners.json``, or a CSV file that ``read_audiograms`` reads and that has
            the columns ``listener`` and ``ear`` (left or right, l or r).

    Raises:
        ValueError: the file is missing or broken, an ear is neither left nor right, or a listener
            has two left or two right ears. The message names file, and line or listener.
    """
    if str(path).lower().endswith(".json"):
        return _read_clarity_listeners(Path(path))
    ears: dict[str, dict[str, Audiogram]] = {}
    for line, row, audiogram in numbered_audiograms(path):
        name, side = row.get("listener", ""), row.get("ear", "").lower()
        ear = next((ear for ear in EARS if side and ear.startswith(side)), None)
        if not name or ear is None:
            raise ValueError(
                f"{path}, line {line}: expected the name of a listener and left or right, "
                f"got {name!r} and {side!r}"
            )
        if ear in ears.setdefault(name, {}):
            raise ValueError(f"{path}, line {line}: the {ear} ear of {name} has two rows")
        ears[name][ear] = audiogram
    return {name: Listener(both.get("left"), both.get("right")) for name, both in ears.items()}


def _read_clarity_listeners(path: Path) -> dict[str, Listener]:
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, RecursionError, json.JSONDecodeError) as error:
        raise ValueError(f"{path}: cannot read listeners: {error}") from error
    if not isinstance(entries, Mapping) or not entries:
        raise ValueError(f"{path}: expected one entry per listener, as in Clarity's listeners.json")
    listeners = {}
    for name, entry in entries.items():
        try:
            listeners[name] = Listener.from_clarity(entry)
        except ValueError as error:
            raise ValueError(f"{path}, listener {name}: {error}") from error
    return listeners
