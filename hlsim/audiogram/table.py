"""Audiograms of a CSV file, an ear a row."""

from __future__ import annotations

from pathlib import Path

from hlsim.audiogram.thresholds import as_thresholds
from hlsim.audiogram.value import Audiogram
from hlsim.files import read_table


def read_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[dict[str, str], Audiogram]]:
    """Rows of a CSV file with columns ``hl_250`` and so on: each row's columns and its audiogram.

    Blanks around names and values do not count. Frequencies other than the eight are interpolated, as in ``Audiogram``.

    Args:
        simulated: take only ears that a simulator takes.

    Raises:
        ValueError: the file is missing, empty, has a column twice, or a row is no audiogram, or, with ``simulated``,
            beyond 100 dB HL; the message names file and line.
    """
    return [(row, ear) for _, row, ear in numbered_audiograms(path, simulated=simulated)]


def numbered_audiograms(
    path: str | Path, *, simulated: bool = False
) -> list[tuple[int, dict[str, str], Audiogram]]:
    """``read_audiograms`` with the number of each row's line first, for messages that name it."""
    rows = read_table(path, "audiograms")
    if not rows:
        raise ValueError(
            f"{path}: no audiograms; needs a header with hl_250, hl_500, ... and a row an ear"
        )
    ears = []
    for number, row in rows:
        try:
            ear = Audiogram.from_row(row)
            if simulated:
                as_thresholds(ear)
            ears.append((number, row, ear))
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
    return ears
