"""Rows of a CSV file with a header, as people and spreadsheets write them."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path


def read_rows(path: str | Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Each row's number of the line that it ends in, and its values by column, "" where the row is short.

    Blanks around names and values are taken off, blank lines passed over, and columns without a name.

    Raises:
        OSError, UnicodeDecodeError, csv.Error: the file cannot be read.
        ValueError: a column twice, or a row of more values than columns; the message names file and line.
    """
    # spreadsheets put a byte order mark first, which would hide the first column
    with open(path, newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file)
        header = [name.strip() for name in next(filter(None, reader), [])]
        for name in filter(None, header):
            if header.count(name) > 1:
                raise ValueError(f"{path}, line {reader.line_num}: column {name} twice; allowed: once")
        for values in filter(None, reader):
            if any(value.strip() for value in values[len(header) :]):
                raise ValueError(
                    f"{path}, line {reader.line_num}: {len(values)} values; allowed: one for each of the "
                    f"{len(header)} columns"
                )
            row = zip_longest(header, values[: len(header)], fillvalue="")
            yield reader.line_num, {name: value.strip() for name, value in row if name}
