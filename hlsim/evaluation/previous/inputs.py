"""A CSV manifest: which files which ear of which listener is given, under any number of conditions.

A row is one file that one ear is given::

    listener,ear,condition,clean,processed,snr,hl_250,hl_500,...,hl_8000
    L1,left,unaided,clean/s01.flac,noisy/s01.flac,5,35,35,...,65
    L1,left,NAL-R,clean/s01.flac,nalr/L1-left/s01.flac,5,35,35,...,65

Columns: ``condition``, ``clean`` and ``processed`` are needed, the paths relative to the root; ``listener``, ``ear``
(left or right), ``item`` and ``snr`` (dB) may be there. Rows of one listener, ear, clean file, item and SNR are one item
of the report. The ear's audiogram is in columns ``hl_250`` and so on, or in a column ``audiogram`` by its standard name,
or in a second CSV file by ``listener`` and ``ear``. The level is in a column ``spl`` (dB SPL of the clean file) or
``full_scale_spl`` (dB SPL of RMS 1.0), or is given for all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, TypeVar

from hlsim.audio import find_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import numbered_audiograms
from hlsim.calibration import check_full_scale
from hlsim.evaluation.previous.scores import EARS
from hlsim.evaluation.previous.scoring import FileItem
from hlsim.files import EXTENSIONS, read_table, resolved

_Name = TypeVar("_Name")

_EAR_NAMES = {"": "", "l": "left", "left": "left", "r": "right", "right": "right"}
_NAMED = 3  # of many missing files a message names the first few
_NEEDED = ("condition", "clean", "processed")


def read_manifest(
    path: str | Path,
    root: str | Path | None = None,
    *,
    audiogram: Audiogram | None = None,
    audiograms: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
) -> list[FileItem]:
    """The items of a manifest, in the order of their first rows.

    Args:
        root: the folder that the paths are relative to, and that they may not leave; by default the manifest's.
        audiogram: the ear of all rows that bring none; or else
        audiograms: a CSV file with columns ``listener``, ``ear`` (where left and right differ) and ``hl_250``, ....
        full_scale_spl, spl: the level, as in ``FileItem``, of rows that bring none.

    Raises:
        ValueError: what is wrong, and in which line; or no row takes ``audiogram``, ``audiograms`` or ``spl``.
    """
    folder = resolved(Path(path).parent if root is None else root)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; the manifest's paths are relative to it")
    ears = {} if audiograms is None else _ears(audiograms, _listener)
    items: dict[tuple[str, ...], FileItem] = {}
    rows, taken = _rows(path), []
    for line, row in rows:
        try:
            name, condition, item = _item(row, folder, ears, audiogram, full_scale_spl, spl)
            taken.append(item.audiogram)
            known = items.get(name)
            if known is None:
                items[name] = item
                continue
            if condition in known.processed:
                raise ValueError(f"a second row of condition {condition!r} of {item.name}")
            if replace(known, processed={}) != replace(item, processed={}):
                raise ValueError(f"audiogram or level is not that of the other rows of {item.name}")
            items[name] = replace(known, processed={**known.processed, **item.processed})
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
    used = {id(ear) for ear in taken}
    idle = {
        "audiogram": audiogram is not None and id(audiogram) not in used,
        "audiograms": audiograms is not None and used.isdisjoint(map(id, ears.values())),
        "spl": spl is not None
        and all(row.get("spl") or row.get("full_scale_spl") for _, row in rows),
    }
    for what in filter(idle.get, idle):
        raise ValueError(
            f"{path}: no row takes {what}, for each has its own; leave one of the two out"
        )
    return list(items.values())


def below_root(root: Path, name: str, column: str) -> Path:
    """A path below a root, links followed, or ValueError where it leaves it."""
    path = resolved(root / name)
    if not name or PurePosixPath(name).is_absolute() or Path(name).is_absolute():
        raise ValueError(f"{column} is {name!r}; allowed: a path relative to {root}")
    if not path.is_relative_to(root):
        raise ValueError(f"{column} is {name!r}, which leaves {root}; allowed: paths below it")
    return path


def _rows(path: str | Path) -> list[tuple[int, dict[str, str]]]:
    """With the number of each row's line."""
    rows = read_table(path, "the manifest")
    if not rows:
        raise ValueError(
            f"{path}: no rows; needs a header with {', '.join(_NEEDED)} and a row a file"
        )
    missing = [column for column in _NEEDED if column not in rows[0][1]]
    if missing:
        raise ValueError(f"{path}: no column {', '.join(missing)}; needs {', '.join(_NEEDED)}")
    return rows


def _item(
    row: Mapping[str, str],
    root: Path,
    ears: Mapping[tuple[str, str], Audiogram],
    default: Audiogram | None,
    full_scale_spl: float,
    spl: float | None,
) -> tuple[tuple[str, ...], str, FileItem]:
    condition, listener = row["condition"], row.get("listener", "")
    if not condition:
        raise ValueError("no condition")
    ear = _ear(row.get("ear", ""))
    clean = below_root(root, row["clean"], "clean")
    row_spl, row_full_scale, snr = (_number(row, key) for key in ("spl", "full_scale_spl", "snr"))
    if row_spl is not None and row_full_scale is not None:
        raise ValueError("both spl and full_scale_spl; allowed: one of them a row")
    if row_full_scale is not None:
        full_scale_spl, spl = row_full_scale, None
    elif row_spl is not None:
        spl = row_spl
    levels = {key: value for key, value in row.items() if key.lower().startswith("hl")}
    if any(
        levels.values()
    ):  # then all: a blank is no threshold, and not one like its neighbour's either
        audiogram: Audiogram | None = Audiogram.from_row(levels)
    elif row.get("audiogram"):
        audiogram = Audiogram.standard(row["audiogram"])
    else:
        audiogram = ears.get((listener, ear)) or ears.get((listener, "")) or default
    if audiogram is None:
        raise ValueError(
            f"no audiogram of listener {listener!r}, ear {ear!r}: neither in columns hl_250, hl_500, ... or audiogram "
            "nor in a file of audiograms"
        )
    parts = (
        listener,
        ear,
        row.get("item", "") or PurePosixPath(row["clean"]).with_suffix("").as_posix(),
    )
    label = " ".join(filter(None, parts))
    item = FileItem(
        name=label if snr is None else f"{label} {snr:g} dB",
        clean=clean,
        processed={condition: below_root(root, row["processed"], "processed")},
        audiogram=audiogram,
        listener=listener,
        ear=ear,
        snr=snr,
        full_scale_spl=check_full_scale(full_scale_spl),
        spl=spl,
    )
    return (*parts, str(clean), str(snr)), condition, item


def _ears(
    path: str | Path, name_of: Callable[[Mapping[str, str]], tuple[_Name, str]]
) -> dict[_Name, Audiogram]:
    """The audiograms of a CSV file by name; ``name_of`` a row gives it, and what a second row of it is one of."""
    ears: dict[_Name, Audiogram] = {}
    for line, row, audiogram in numbered_audiograms(path):
        try:
            name, words = name_of(row)
            if name in ears:
                raise ValueError(f"a second row of {words}")
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
        ears[name] = audiogram
    return ears


def _listener(row: Mapping[str, str]) -> tuple[tuple[str, str], str]:
    listener, ear = row.get("listener", ""), _ear(row.get("ear", ""))
    if not listener:
        raise ValueError("no listener; needs a column 'listener'")
    return (listener, ear), f"listener {listener}, ear {ear!r}"


def _file(row: Mapping[str, str]) -> tuple[str, str]:
    if not row.get("file"):
        raise ValueError("no file named; needs a column 'file' with a name a row")
    return _name(PurePath(row["file"])), f"{row['file']}; allowed: one ear a file"


def _ear(text: str) -> str:
    if text.lower() not in _EAR_NAMES:
        raise ValueError(f"ear is {text!r}; allowed: {', '.join(EARS)}")
    return _EAR_NAMES[text.lower()]


def _number(row: Mapping[str, str], column: str) -> float | None:
    text = row.get(column, "")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{column} is {text!r}; allowed: a number of dB")
    return value


def read_folders(
    clean: str | Path,
    before: str | Path,
    after: str | Path,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    **levels: Any,
) -> list[FileItem]:
    """An item a name, with the conditions ``before`` and ``after``, sorted by name.

    Args:
        clean, before, after: folders of wav, flac or ogg files whose names below the folder, but for the extension, are
            the same, or ValueError.
        audiogram: the ear, of all files; or else
        audiograms: a CSV file with columns ``file`` (the name below the folder, with or without extension) and
            ``hl_250``, ``hl_500``, ... in dB HL, one row a file. Rows of other files are passed over.
        levels: ``full_scale_spl`` or ``spl``, as in ``FileItem``.
    """
    if (audiogram is None) == (audiograms is None):
        raise ValueError(
            "give either audiogram, one ear of all files, or audiograms, a CSV file with a row a file"
        )
    roots = (clean, before, after)
    folders = [_by_name(root) for root in roots]
    names = sorted(set(chain(*folders)))
    for root, files in zip(roots, folders, strict=True):
        if lack := _lack(names, files):
            raise ValueError(
                f"{root}: {lack[0]} missing, {lack[1]}; clean, before and after need the same names"
            )
    ears = (
        dict.fromkeys(names, audiogram) if audiogram is not None else _ears(str(audiograms), _file)
    )
    if lack := _lack(names, ears):
        raise ValueError(f"{audiograms}: no audiogram of {lack[0]}, {lack[1]}")
    items = []
    for name in names:
        speech, first, last = (files[name].absolute() for files in folders)
        items.append(FileItem(name, speech, {"before": first, "after": last}, ears[name], **levels))
    return items


def _name(path: PurePath) -> str:
    """The path in POSIX form without the extension of audio; other dots belong to the name."""
    return (path.with_suffix("") if path.suffix.lower() in EXTENSIONS else path).as_posix()


def _by_name(folder: str | Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in find_audio(folder):
        name = _name(path.relative_to(folder))
        if name in files:
            raise ValueError(f"{files[name]} and {path}: one name twice; allowed: one file a name")
        files[name] = path
    return files


def _lack(names: list[str], there: Container[str]) -> tuple[str, str] | None:
    """How many of the names are missing, and the first few."""
    missing = [name for name in names if name not in there]
    few = ", ".join(missing[:_NAMED]) + (", ..." if len(missing) > _NAMED else "")
    return (f"{len(missing)} of {len(names)} files", few) if missing else None
