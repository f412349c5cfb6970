"""Items of three folders of equally named files: clean, before, after."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path, PurePath

from hlsim.audio import EXTENSIONS, find_audio
from hlsim.audiogram import Audiogram, numbered_audiograms
from hlsim.evaluation.scoring import Item

_NAMED = 3  # of many missing files a message names the first few


def read_folders(
    clean: str | Path,
    before: str | Path,
    after: str | Path,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
) -> list[Item]:
    """An item a name, with the conditions ``before`` and ``after``, sorted by name.

    Args:
        clean, before, after: folders of wav, flac or ogg files whose names below the folder, but for the extension, are
            the same.
        audiogram: the ear, of all files; or else
        audiograms: a CSV file with columns ``file`` (the name below the folder, with or without extension) and
            ``hl_250``, ``hl_500``, ... in dB HL, one row a file. Rows of other files are passed over.
        full_scale_spl, spl: the level, as in ``Item``.

    Raises:
        ValueError: names differ between the folders, a file has no audiogram, or both or none of ``audiogram`` and
            ``audiograms`` are given.
    """
    if (audiogram is None) == (audiograms is None):
        raise ValueError(
            "give either audiogram, one ear of all files, or audiograms, a CSV file with a row a file"
        )
    folders = [_by_name(folder) for folder in (clean, before, after)]
    names = _common_names((clean, before, after), folders)
    ears = dict.fromkeys(names, audiogram) if audiogram is not None else _ears(str(audiograms), names)
    return [
        Item(
            name=name,
            clean=folders[0][name].absolute(),
            processed={"before": folders[1][name].absolute(), "after": folders[2][name].absolute()},
            audiogram=ears[name],
            full_scale_spl=full_scale_spl,
            spl=spl,
        )
        for name in names
    ]


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


def _common_names(roots: Iterable[str | Path], folders: list[dict[str, Path]]) -> list[str]:
    """The names, sorted, or ValueError naming the folder that lacks some."""
    names = sorted(set(chain(*folders)))
    for root, files in zip(roots, folders, strict=True):
        missing = [name for name in names if name not in files]
        if missing:
            raise ValueError(
                f"{root}: {len(missing)} of {len(names)} files missing, {_listed(missing)}; "
                "clean, before and after need the same names"
            )
    return names


def _ears(path: str, names: list[str]) -> dict[str, Audiogram]:
    ears: dict[str, Audiogram] = {}
    for line, row, ear in numbered_audiograms(path):
        if not row.get("file"):
            raise ValueError(f"{path}, line {line}: no file named; needs a column 'file' with a name a row")
        name = _name(PurePath(row["file"]))
        if name in ears:
            raise ValueError(f"{path}, line {line}: a second row of {row['file']}; allowed: one ear a file")
        ears[name] = ear
    missing = [name for name in names if name not in ears]
    if missing:
        raise ValueError(f"{path}: no audiogram of {len(missing)} of {len(names)} files, {_listed(missing)}")
    return ears


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
