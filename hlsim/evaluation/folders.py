"""HASPI before and after of three folders of equally named files: clean, before, after."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch

from hlsim.audio import EXTENSIONS, find_audio
from hlsim.audiogram import Audiogram, read_audiograms
from hlsim.calibration import check_full_scale, level_spl
from hlsim.evaluation.haspi import HaspiItem, Progress, check_pair, check_seed, haspi_many, read_ear
from hlsim.evaluation.report import HaspiReport, ItemScore, check_out, write_report
from hlsim.extras import require

_NAMED = 3  # of many missing files a message names the first few


def haspi_report(
    clean: str | Path,
    before: str | Path,
    after: str | Path,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    out: str | Path | None = None,
    full_scale_spl: float = 94.0,
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> HaspiReport:
    """HASPI v2 of speech before and after a treatment, against the clean speech, with paired tests and levels.

    Files are taken as they are: one channel for one ear, no change of level, delay or length. All of them are read and
    checked before the first is scored.

    Args:
        clean, before, after: folders of wav, flac or ogg files whose names below the folder, but for the extension, are
            the same. Of one name, the three files have one rate and one length.
        audiogram: the ear, of all files; or else
        audiograms: a CSV file with columns ``file`` (the name below the folder, with or without extension) and
            ``hl_250``, ``hl_500``, ... in dB HL, one row a file. Rows of other files are passed over.
        out: folder for ``report.json``, ``report.md`` and ``before-after.png``; None writes nothing.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0.
        seed: item i, in order of names, is scored with ``seed`` + i, before and after alike.
        jobs: processes; None takes all cores. The scores do not depend on it.
        progress: called after each score with the number made and the number of all (two an item).

    Raises:
        ValueError: names differ between the folders, a file is broken, silent, too short, not one channel or unlike its
            partners, a file has no audiogram, both or none of ``audiogram`` and ``audiograms`` are given, or ``out``
            is no folder. Nothing is written then.
        MissingExtraError: pyclarity, joblib or (with ``out``) matplotlib is not installed.
    """
    for module in ("clarity", "joblib", "matplotlib") if out is not None else ("clarity", "joblib"):
        require(module, "eval")
    if out is not None:
        check_out(out)
    check_full_scale(full_scale_spl)
    check_seed(seed)
    if (audiogram is None) == (audiograms is None):
        raise ValueError(
            "give either audiogram, one ear of all files, or audiograms, a CSV file with a row a file"
        )
    if audiogram is not None and not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; allowed: an Audiogram, one ear of all files"
        )
    folders = [_by_name(folder) for folder in (clean, before, after)]
    names = _common_names((clean, before, after), folders)
    ears = dict.fromkeys(names, audiogram) if audiogram is not None else _ears(str(audiograms), names)

    tasks: list[HaspiItem] = []
    facts: list[dict[str, Any]] = []
    for i, name in enumerate(names):
        paths = [folder[name] for folder in folders]
        ear, item_seed = ears[name], (seed + i) % 2**32
        facts.append(
            {"file": name, "audiogram": ear, "seed": item_seed, **_check_files(paths, full_scale_spl)}
        )
        tasks += [HaspiItem(paths[0], path, ear, seed=item_seed) for path in paths[1:]]
    scores = haspi_many(tasks, full_scale_spl=full_scale_spl, jobs=jobs, progress=progress)
    pairs = zip(facts, scores[::2], scores[1::2], strict=True)
    items = [ItemScore(**fact, before=first, after=second) for fact, first, second in pairs]
    report = HaspiReport(items, full_scale_spl=full_scale_spl, seed=seed)
    if out is not None:
        write_report(report, out)
    return report


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
    for line, (row, ear) in enumerate(read_audiograms(path), start=2):
        if not row.get("file"):
            raise ValueError(f"{path}, line {line}: no file named; needs a column 'file' with a name a row")
        name = _name(PurePath(row["file"].strip()))
        if name in ears:
            raise ValueError(f"{path}, line {line}: a second row of {row['file']}; allowed: one ear a file")
        ears[name] = ear
    missing = [name for name in names if name not in ears]
    if missing:
        raise ValueError(f"{path}: no audiogram of {len(missing)} of {len(names)} files, {_listed(missing)}")
    return ears


def _check_files(paths: list[Path], full_scale_spl: float) -> dict[str, float]:
    """Levels of clean, before and after in dB SPL, rate in Hz and duration in s; ValueError if they are no trio."""
    clean, rate = read_ear(paths[0])
    facts = {"sample_rate": rate, "seconds": len(clean) / rate, "clean_level": _level(clean, full_scale_spl)}
    for path, name in zip(paths[1:], ("before_level", "after_level"), strict=True):
        samples, own_rate = read_ear(path)
        if own_rate != rate:
            raise ValueError(f"{path} has {own_rate} Hz and {paths[0]} {rate} Hz; allowed: equal rates")
        check_pair(clean, samples, rate, full_scale_spl, names=(str(paths[0]), str(path)))
        facts[name] = _level(samples, full_scale_spl)
    return facts


def _level(samples: np.ndarray, full_scale_spl: float) -> float:
    return float(level_spl(torch.from_numpy(samples), full_scale_spl))


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
