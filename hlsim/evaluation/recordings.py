"""Recorded outputs as the items of a study: ``haspi-report`` scores files, from folders or a manifest.

A manifest is a CSV file with one row for each output file::

    listener,ear,condition,clean,processed,snr,hl_250,hl_500,...,hl_8000
    L1,left,unaided,clean/s01.flac,noisy/s01.flac,5,35,35,...,65
    L1,left,NAL-R,clean/s01.flac,nalr/L1-left/s01.flac,5,35,35,...,65

It needs the columns ``condition``, ``clean`` and ``processed``; paths are relative to the root. It may have
``listener``, ``ear`` (left or right), ``item`` and ``snr`` (dB). Rows that agree in listener, ear, clean
file, item and SNR form one item. The audiogram stands in columns ``hl_250`` and so on, in a column
``audiogram`` by its standard name, or in a second CSV file by ``listener`` and ``ear``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path, PurePath, PurePosixPath
from typing import TYPE_CHECKING, Any

from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EAR_NAMES, EARS
from hlsim.audiogram.table import read_rows
from hlsim.audiogram.value import convert_at
from hlsim.calibration import check_full_scale, dbfs
from hlsim.evaluation.comparison import Pair, compare
from hlsim.evaluation.measures import LEVELS, find_measures
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.store import content_hash, key_of
from hlsim.evaluation.study import Condition, Item
from hlsim.files import EXTENSIONS, read_table, resolve_links
from hlsim.metrics.pair import check_seed

if TYPE_CHECKING:
    from pandas import DataFrame

_EAR_NAMES = {"": "", **EAR_NAMES}
_REQUIRED = ("condition", "clean", "processed")


@dataclass(frozen=True)
class Recording:
    """One utterance for one ear, in files.

    Args:
        utterance: name of the utterance, the same for both ears of a listener.
        clean: file of clean speech.
        outputs: file of the output for each condition.
        audiogram: the ear.
        listener: name of the listener; empty if unknown.
        ear: ``"left"``, ``"right"`` or empty. Of a file with two channels it selects the channel.
        snr: signal-to-noise ratio in dB; NaN if unknown.
        full_scale_spl: level in dB SPL of a file with RMS 1.0.
        spl: level of the clean file in dB SPL, in place of ``full_scale_spl``.
        seed: seed of the study; each clean file has its own, made from this one and its contents.
        problems: for each condition without a file, the reason why.
    """

    utterance: str
    clean: Path
    outputs: Mapping[str, Path]
    audiogram: Audiogram
    listener: str = ""
    ear: str = ""
    snr: float = math.nan
    full_scale_spl: float = 94.0
    spl: float | None = None
    seed: int = 0
    problems: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Listener, ear, utterance and SNR, as far as they are known."""
        return _name(self.listener, self.ear, self.utterance, self.snr)

    @property
    def facts(self) -> dict[str, Any]:
        """Columns of the table that describe the item, without its name."""
        facts = ("listener", "ear", "utterance", "snr")
        ear = {"severity": self.audiogram.severity, "audiogram": list(self.audiogram.thresholds)}
        return {name: getattr(self, name) for name in facts} | ear

    def digest(self, condition: str) -> str:
        """Return the SHA-256 of both files, the ear, the level and the seed."""
        files = [content_hash(self.clean), content_hash(self._output_file(condition))]
        level = [self.full_scale_spl if self.spl is None else None, self.spl]
        ear = [self.ear, list(self.audiogram.thresholds)]
        return key_of({"files": files, "ear": ear, "level": level, "seed": self.seed})

    def load(self) -> Item:
        """Read the clean speech; outputs are read when they are measured."""
        if self.problems and not self.outputs:
            raise ValueError(next(iter(self.problems.values())))
        clean, rate = read_channel(self.clean, self.ear)
        full_scale = self.full_scale_spl
        if self.spl is not None:
            full_scale = check_full_scale(self.spl - float(dbfs(clean)))
        names = [*self.outputs, *self.problems]
        return Item(
            self.name,
            clean,
            clean,
            self.audiogram,
            sample_rate=rate,
            full_scale_spl=full_scale,
            seed=(self.seed + int(content_hash(self.clean)[:8], 16)) % 2**32,
            facts=self.facts,
            recorded={name: partial(self._read_output, name, rate) for name in names},
        )

    def _output_file(self, condition: str) -> Path:
        if condition not in self.outputs:
            raise ValueError(self.problems.get(condition, "no file is named"))
        return self.outputs[condition]

    def _read_output(self, condition: str, rate: int) -> Tensor:
        path = self._output_file(condition)
        output, output_rate = read_channel(path, self.ear)
        if output_rate != rate:
            raise ValueError(f"{path} has {output_rate} Hz and {self.clean} {rate} Hz")
        return output


def _name(*parts: str | float) -> str:
    """Join the known parts of an item's name; a number is an SNR in dB."""
    texts = [part if isinstance(part, str) else f"{part:g} dB" for part in parts if part == part]
    return " ".join(filter(None, texts))


def read_channel(path: Path, ear: str = "") -> tuple[Tensor, int]:
    """Read the channel of one ear, as it is in the file.

    Returns: samples (time,) in float64, and the rate in Hz. Of a file with two channels, left is the
        first and right the second.

    Raises:
        ValueError: the file cannot be read or is silent, or its channels do not fit the ear.
    """
    waveform, rate = read_audio(path)
    channels = len(waveform)
    if channels > 2 or (channels == 2 and not ear):
        raise ValueError(
            f"{path} has {channels} channels; one ear needs 1, or 2 and the ear's name"
        )
    channel = waveform[EARS.index(ear) if channels == 2 else 0]
    if not bool(channel.any()):
        raise ValueError(f"{path} is silent: every sample of the {ear} channel is zero")
    return channel.double(), rate


def haspi_report(
    clean: str | Path | None = None,
    before: str | Path | None = None,
    after: str | Path | None = None,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    manifest: str | Path | None = None,
    root: str | Path | None = None,
    measures: Iterable[str] = ("haspi",),
    baseline: str | None = None,
    better_ear: bool = False,
    store: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Score recorded speech by HASPI v2 and other measures, and compare its conditions.

    Files are scored as they are, one channel for one ear. A stopped run continues where it was. A file
    that cannot be scored is listed with the reason, and the others are scored.

    Args:
        clean, before, after: folders, see ``read_folders``. Without ``before`` there is one condition, and scores
            without a comparison.
        audiogram, audiograms: the ear of all files, or a CSV file of ears.
        manifest, root: a CSV file in place of the folders, see ``read_manifest``.
        measures: names of measures, the most important first: ``haspi``, ``hasqi``, ``haaqi``, ``stoi``, ``pesq`` or
            ``package.module:name``.
        baseline: the condition that comes first and that all others are compared with; by default the
            manifest's first comes first, and all conditions are compared with each other.
        better_ear: take the better ear's score of each utterance; needs a manifest with both ears.
        store: file of scores, which is created if it does not exist; None stores nothing.
        full_scale_spl: level in dB SPL of a file with RMS 1.0.
        spl: level of every clean file in dB SPL, in place of ``full_scale_spl``.
        seed: seed of the noise that HASPI, HASQI and HAAQI add.
        running: ``jobs``, ``dask`` and ``progress``, as in ``run_study``.

    Returns: the evaluation; the comparison of the first with the last condition is planned.

    Raises:
        ValueError: files do not match, a row of the manifest is wrong, or nothing could be scored.
        MissingExtraError: the package of a measure is not installed.
    """
    check_seed(seed)
    check_full_scale(full_scale_spl if spl is None else spl)
    ears: dict[str, Any] = {"audiogram": audiogram, "audiograms": audiograms}
    levels: dict[str, Any] = {"full_scale_spl": full_scale_spl, "spl": spl}
    no_folders = clean is None and before is None and after is None
    if manifest is not None and no_folders:
        recordings = read_manifest(manifest, root, **ears, **levels)
    elif manifest is None and clean is not None and after is not None:
        folders = {"before": before, "after": after}
        recordings = read_folders(clean, folders, **ears, **levels)
    else:
        raise ValueError("give either the folders clean and after (and before), or a manifest")
    found = dict.fromkeys(name for recording in recordings for name in recording.outputs)
    names = [*found] if baseline is None else [baseline, *(n for n in found if n != baseline)]
    if baseline is not None and baseline not in found:
        raise ValueError(f"there is no condition {baseline!r}; expected {', '.join(found)}")
    return score_recordings(
        [replace(recording, seed=seed) for recording in recordings],
        [Condition(name, kind="recorded") for name in names],
        measures,
        baseline=baseline,
        better_ear=better_ear,
        store=store,
        **running,
    )


def score_recordings(
    recordings: Sequence[Recording],
    conditions: Sequence[Condition],
    measures: Iterable[str],
    *,
    baseline: str | None = None,
    better_ear: bool = False,
    planned: Sequence[Pair] = (),
    **running: Any,
) -> Evaluation:
    """Score recordings and compare their conditions; all else as ``haspi_report``.

    Args:
        planned: planned comparisons; by default the first with the last condition by the first measure.
        running: ``store``, ``jobs``, ``dask`` and ``progress`` of ``run_study``.

    Returns: the evaluation; with ``better_ear`` its group ``ears`` has the scores of each ear.
    """
    if better_ear:
        check_both_ears(recordings)
    settings = {"seed": recordings[0].seed, "baseline": baseline, "better_ear": better_ear}
    chosen = [*find_measures(measures), LEVELS]
    evaluation = Evaluation.run(recordings, conditions, chosen, settings=settings, **running)
    columns = evaluation.scores
    if better_ear:
        ears = {"ears": evaluation}
        evaluation = replace(evaluation, table=better_ears(evaluation.table, columns), groups=ears)
    planned = planned or [(columns[0], evaluation.names[0], evaluation.names[-1])]
    comparisons = compare(evaluation.table, columns, baseline=baseline, planned=planned)
    return replace(evaluation, comparisons=comparisons)


def check_both_ears(recordings: Iterable[Recording]) -> None:
    """Raise ValueError unless each utterance of each listener has one left and one right ear."""
    found: dict[str, list[str]] = {}
    for r in recordings:
        found.setdefault(_name(r.listener, r.utterance, r.snr), []).append(r.ear)
    for name, ears in found.items():
        if sorted(ears) != sorted(EARS):
            raise ValueError(
                f"{name} has the ears {', '.join(ear or 'none' for ear in ears)}; the better ear needs "
                "the left and the right ear of each utterance, once"
            )


def better_ears(table: DataFrame, measures: Sequence[str]) -> DataFrame:
    """Return one row per utterance and condition in place of one for each ear.

    A score is that of the ear which scores higher by its measure; the level is that of the ear which scores
    higher by the first measure. Facts of an item are those of the better ear under the last condition, whose
    number is in the column ``source``.
    """
    places = {name: place for place, name in enumerate(dict.fromkeys(table["condition"]))}
    utterance = ["listener", "utterance", "snr"]
    numbers = table.groupby(utterance, sort=False, dropna=False).ngroup()
    row = ["item", "place"]
    table = table.assign(source=table["item"], item=numbers, place=table["condition"].map(places))
    order = [*row, measures[0], "ear"]
    table = table.sort_values(order, ascending=[True, True, False, True], kind="stable")
    best = table.drop_duplicates(row).set_index(row)
    for measure in measures:
        best[measure] = table.groupby(row)[measure].max()
    last = best.xs(len(places) - 1, level="place")
    best = best.reset_index()
    for fact in ("source", "ear", "severity", "audiogram", "full_scale_spl", "clean_level"):
        best[fact] = best["item"].map(last[fact])
    best["name"] = [_name(*parts) for parts in zip(*(best[key] for key in utterance), strict=True)]
    return best.drop(columns="place")


def read_folders(
    clean: str | Path,
    folders: Mapping[str, str | Path | None],
    *,
    audiogram: Audiogram | None = None,
    audiograms: str | Path | None = None,
    **levels: Any,
) -> list[Recording]:
    """Read the recordings of folders, one per file name, sorted by name.

    Args:
        clean: folder of clean speech.
        folders: folder of the outputs of each condition; one that is None is left out. The files of all folders have
            the same names, whatever their extension.
        audiogram: the ear of all files.
        audiograms: in its place a CSV file with the columns ``file`` (name below the folder, with or without
            extension) and ``hl_250``, ``hl_500``, .... Rows of other files are ignored.
        levels: ``full_scale_spl`` or ``spl``, as in ``Recording``.

    Raises:
        ValueError: the names differ, or a file has no audiogram.
    """
    if (audiogram is None) == (audiograms is None):
        raise ValueError("give either audiogram, the ear of all files, or audiograms, a CSV file")
    speech = _by_name(clean)
    outputs = {name: _by_name(folder) for name, folder in folders.items() if folder is not None}
    names = sorted({*speech, *(name for files in outputs.values() for name in files)})
    for folder, files in ((clean, speech), *((folders[name], outputs[name]) for name in outputs)):
        _check_complete(names, files, f"{folder}: no file for")
    if audiogram is not None:
        ears = dict.fromkeys(names, audiogram)
    else:
        rows = _read_ears(str(audiograms), _file_name)
        _check_complete(names, rows, f"{audiograms}: no audiogram for")
        ears = {name: rows[name]() for name in names}
    return [
        Recording(
            utterance=name,
            clean=speech[name].absolute(),
            outputs={condition: files[name].absolute() for condition, files in outputs.items()},
            audiogram=ears[name],
            **levels,
        )
        for name in names
    ]


def read_manifest(
    path: str | Path,
    root: str | Path | None = None,
    *,
    audiogram: Audiogram | None = None,
    audiograms: str | Path | None = None,
    **levels: Any,
) -> list[Recording]:
    """Read the recordings of a manifest, in the order of their first rows.

    Args:
        root: folder that the paths are relative to and may not leave; by default that of the manifest.
        audiogram: the ear of rows that name none.
        audiograms: a CSV file with columns ``listener``, ``ear`` (if left and right differ) and ``hl_250``, ....
        levels: ``full_scale_spl`` or ``spl``, as in ``Recording``.

    Raises:
        ValueError: a row is wrong; the message names its line.
    """
    folder = resolve_links(Path(path).parent if root is None else root)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; the paths of the manifest are relative to it")
    ears = {} if audiograms is None else _read_ears(audiograms, _listener_and_ear)
    rows = read_table(path, "the manifest")
    columns = rows[0][1].keys() if rows else set()
    if not columns >= {*_REQUIRED} or columns & {"spl", "full_scale_spl"}:
        raise ValueError(
            f"{path} needs rows with the columns {', '.join(_REQUIRED)}, and the level as an option, not a column"
        )
    recordings: dict[tuple[str, str], Recording] = {}
    for line, row in rows:
        try:
            found = _read_row(row, folder, ears, audiogram, levels)
            known = recordings.setdefault(
                (found.name, str(found.clean)), replace(found, outputs={})
            )
            if known.audiogram != found.audiogram:
                raise ValueError(f"the audiogram differs from that of other rows of {known.name}")
            if twice := known.outputs.keys() & found.outputs.keys():
                raise ValueError(f"a second row of {known.name} under {twice.pop()}")
            outputs = {**known.outputs, **found.outputs}
            recordings[found.name, str(found.clean)] = replace(known, outputs=outputs)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
    return list(recordings.values())


def _read_row(
    row: Mapping[str, str],
    root: Path,
    ears: Mapping[Any, Callable[[], Audiogram]],
    default: Audiogram | None,
    levels: Mapping[str, Any],
) -> Recording:
    condition, listener, ear = row["condition"], row.get("listener", ""), _ear_name(row)
    if not condition.isprintable() or not condition:
        raise ValueError(f"the condition {condition!r} is not a printable name")
    thresholds = {key: value for key, value in row.items() if key.lower().startswith("hl")}
    if any(thresholds.values()):
        audiogram: Audiogram | None = Audiogram.from_row(thresholds)
    elif row.get("audiogram"):
        audiogram = Audiogram.standard(row["audiogram"])
    else:
        read_ear = ears.get((listener, ear)) or ears.get((listener, ""))
        audiogram = read_ear() if read_ear else default
    if audiogram is None:
        raise ValueError(
            f"no audiogram of listener {listener!r}, ear {ear!r}: add columns hl_250, hl_500, ... or a "
            "column audiogram, or name a file of audiograms"
        )
    return Recording(
        utterance=row.get("item") or PurePosixPath(row["clean"]).with_suffix("").as_posix(),
        clean=_below(root, row["clean"]),
        outputs={condition: _below(root, row["processed"])},
        audiogram=audiogram,
        listener=listener,
        ear=ear,
        snr=_number(row.get("snr") or "nan"),
        **levels,
    )


def _below(root: Path, name: str) -> Path:
    """Return a path below the root, with links followed; ValueError if it leaves it."""
    path = resolve_links(root / name)
    if not name or not path.is_relative_to(root):
        raise ValueError(f"{name!r} is not a path below {root}")
    return path


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"the SNR is {text!r}, not a number of dB") from None


def _ear_name(row: Mapping[str, str]) -> str:
    text = row.get("ear", "").lower()
    if text not in _EAR_NAMES:
        raise ValueError(f"the ear is {text!r}; expected left or right")
    return _EAR_NAMES[text]


def _read_ears(
    path: str | Path, name_of: Callable[[Mapping[str, str]], Any]
) -> dict[Any, Callable[[], Audiogram]]:
    """Read the rows of a CSV file of ears.

    Args:
        name_of: function that returns the name of the ear in a row.

    Returns: for each name a function that returns the audiogram, so that only ears in use are validated.
    """
    ears: dict[Any, Callable[[], Audiogram]] = {}
    for line, row in read_rows(path):
        place = f"{path}, line {line}"
        name = convert_at(place, name_of, row)
        if name in ears:
            raise ValueError(f"{place}: a second row of {name}")
        ears[name] = partial(convert_at, place, Audiogram.from_row, row)
    return ears


def _listener_and_ear(row: Mapping[str, str]) -> tuple[str, str]:
    if not row.get("listener"):
        raise ValueError("no listener is named; the file needs a column listener")
    return row["listener"], _ear_name(row)


def _file_name(row: Mapping[str, str]) -> str:
    if not row.get("file"):
        raise ValueError("no file is named; the file needs a column file")
    return _stem(PurePath(row["file"]))


def _stem(path: PurePath) -> str:
    """Return the path in POSIX form without the extension of an audio file."""
    return (path.with_suffix("") if path.suffix.lower() in EXTENSIONS else path).as_posix()


def _by_name(folder: str | Path) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in find_audio(folder):
        name = _stem(path.relative_to(folder))
        if name in files:
            raise ValueError(f"{files[name]} and {path} have the same name; keep one of them")
        files[name] = path
    return files


def _check_complete(names: Sequence[str], found: Iterable[str], lack: str) -> None:
    """Raise ValueError with the first few names that are missing."""
    missing = sorted(set(names) - set(found))
    if missing:
        few = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise ValueError(
            f"{lack} {few} ({len(missing)} of {len(names)}); all folders need the same names"
        )
