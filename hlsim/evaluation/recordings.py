"""Recorded outputs as the items of a study: ``haspi-report`` scores files, from folders or a manifest.

A manifest is a CSV file with one row for each output file::

    listener,ear,condition,clean,processed,snr,hl_250,hl_500,...,hl_8000
    L1,left,unaided,clean/s01.flac,noisy/s01.flac,5,35,35,...,65
    L1,left,NAL-R,clean/s01.flac,nalr/L1-left/s01.flac,5,35,35,...,65

It needs the columns ``condition``, ``clean`` and ``processed``; paths are relative to the root. It may have
``listener``, ``ear`` (left or right), ``item`` and ``snr`` (dB). Rows that agree in listener, ear, clean
file, item and SNR form one item. The audiogram stands in columns ``hl_250`` and so on, in a column
``audiogram`` by its standard name, or in a second CSV file by ``listener`` and ``ear``. The level is
that of the column ``spl`` (clean file, dB SPL) or ``full_scale_spl`` (RMS 1.0, dB SPL), or the same for all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import TYPE_CHECKING, Any

from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EAR_NAMES, EARS
from hlsim.audiogram.table import numbered_audiograms
from hlsim.calibration import check_full_scale, dbfs
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.measures import LEVELS, find_measures
from hlsim.evaluation.result import Evaluation, check_scored, score_columns
from hlsim.evaluation.store import ScoreStore, content_hash, key_of
from hlsim.evaluation.study import Condition, Item, run_study
from hlsim.files import EXTENSIONS, read_table, resolve_links
from hlsim.metrics.pair import check_seed
from hlsim.parallel import Progress

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

    @property
    def name(self) -> str:
        """Listener, ear, utterance and SNR, as far as they are known."""
        return _name(self.listener, self.ear, self.utterance, self.snr)

    @property
    def facts(self) -> dict[str, Any]:
        """What the table says of the item beside its name."""
        return {
            "listener": self.listener,
            "ear": self.ear,
            "utterance": self.utterance,
            "snr": self.snr,
            "severity": self.audiogram.severity,
            "audiogram": list(self.audiogram.thresholds),
        }

    def digest(self, condition: str) -> str:
        """Return the SHA-256 of both files, the ear, the level and the seed."""
        files = [content_hash(self.clean), content_hash(self.output_file(condition))]
        level = [self.full_scale_spl if self.spl is None else None, self.spl]
        ear = [self.ear, list(self.audiogram.thresholds)]
        return key_of({"files": files, "ear": ear, "level": level, "seed": self.seed})

    def output_file(self, condition: str) -> Path:
        """Return the file of one condition; ValueError if there is none."""
        if condition not in self.outputs:
            raise ValueError(f"no file is named for {self.name} under {condition}")
        return self.outputs[condition]

    def load(self) -> RecordedItem:
        """Read the clean speech, of which the channel and the level are those of the ear."""
        clean, rate = read_channel(self.clean, self.ear)
        full_scale = self.full_scale_spl
        if self.spl is not None:
            full_scale = check_full_scale(self.spl - float(dbfs(clean)))
        return RecordedItem(
            self.name,
            clean,
            clean,
            self.audiogram,
            sample_rate=rate,
            full_scale_spl=full_scale,
            seed=(self.seed + int(content_hash(self.clean)[:8], 16)) % 2**32,
            facts=self.facts,
            recording=self,
        )


@dataclass(frozen=True, kw_only=True)
class RecordedItem(Item):
    """An item whose outputs were recorded."""

    recording: Recording

    def output(self, condition: str) -> Tensor:
        """Read the output of a condition, which has to fit the clean speech. Shape: -> (time,)."""
        path = self.recording.output_file(condition)
        output, rate = read_channel(path, self.recording.ear)
        if rate != self.sample_rate or len(output) != len(self.clean):
            raise ValueError(
                f"{path} has {len(output)} samples at {rate} Hz and {self.recording.clean} "
                f"{len(self.clean)} at {self.sample_rate} Hz; both need the same rate and length"
            )
        return output


def _name(*parts: str | float) -> str:
    """Join the known parts of an item's name; a number is an SNR in dB."""
    texts = [part if isinstance(part, str) else f"{part:g} dB" for part in parts if part == part]
    return " ".join(filter(None, texts))


class Recorded(Condition):
    """A condition whose outputs are files."""

    fingerprint = "files"

    def output(self, item: Item) -> Tensor:
        """Read the file of this condition."""
        assert isinstance(item, RecordedItem)
        return item.output(self.name)


def recorded_condition(name: str) -> Recorded:
    """Return the condition of this name; its outputs are read and not processed."""
    return Recorded(name, process=_already_processed, kind="recorded")


def _already_processed(waveform: Tensor, ear: Audiogram) -> Tensor:
    return waveform


def read_channel(path: str | Path, ear: str = "") -> tuple[Tensor, int]:
    """Read the channel of one ear, as it is in the file.

    Returns: samples (time,) in float64, and the rate in Hz. Of a file with two channels, left is the
        first and right the second.

    Raises:
        ValueError: the file cannot be read or is silent, or its channels do not fit the ear.
    """
    waveform, rate = read_audio(path)
    channels = len(waveform)
    if channels > 2 or (channels == 2 and not ear):
        expected = "1 or 2" if ear else "1, or name the ear to select a channel"
        raise ValueError(f"{path} has {channels} channels; expected {expected}")
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
    jobs: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
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
        jobs, dask, progress: as in ``run_study``.

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
    return score_recordings(
        [replace(recording, seed=seed) for recording in recordings],
        measures,
        baseline=baseline,
        better_ear=better_ear,
        store=ScoreStore(store),
        jobs=jobs,
        dask=dask,
        progress=progress,
    )


def score_recordings(
    recordings: Sequence[Recording],
    measures: Iterable[str],
    *,
    conditions: Sequence[str] = (),
    baseline: str | None = None,
    better_ear: bool = False,
    **running: Any,
) -> Evaluation:
    """Score recordings and compare their conditions; all else as ``haspi_report``.

    Args:
        conditions: their order; by default that of the recordings.
        running: ``store``, ``jobs``, ``dask`` and ``progress`` of ``run_study``.
    """
    chosen = find_measures(measures)
    names = list(conditions or dict.fromkeys(name for r in recordings for name in r.outputs))
    if baseline is not None:
        if baseline not in names:
            raise ValueError(f"there is no condition {baseline!r}; expected {', '.join(names)}")
        names = [baseline, *(name for name in names if name != baseline)]
    if better_ear:
        check_both_ears(recordings)
    studied = [recorded_condition(name) for name in names]
    table = run_study(recordings, studied, [*chosen, LEVELS], **running)
    columns = score_columns(table, chosen, recordings[0].facts)
    check_scored(table, columns)
    if better_ear:
        table = better_ears(table, columns)
    planned = [(columns[0], names[0], names[-1])]
    return Evaluation(
        items=recordings,
        conditions=studied,
        measures=chosen,
        table=table,
        comparisons=compare(table, columns, baseline=baseline, planned=planned),
        settings={
            "seed": recordings[0].seed,
            "measures": columns,
            "baseline": baseline,
            "better_ear": better_ear,
        },
    )


def check_both_ears(recordings: Iterable[Recording]) -> None:
    """Raise ValueError unless each utterance of each listener has exactly one left and one right ear."""
    found: dict[tuple[str, str, str], list[str]] = {}
    for r in recordings:
        found.setdefault((r.listener, r.utterance, str(r.snr)), []).append(r.ear)
    for (listener, utterance, _), ears in found.items():
        if sorted(ears) != sorted(EARS):
            named = ", ".join(ear or "none" for ear in ears)
            raise ValueError(
                f"{listener} {utterance} has the ears {named}; the better ear needs one row for the "
                "left and one for the right ear of each utterance"
            )


def better_ears(table: DataFrame, measures: Sequence[str]) -> DataFrame:
    """Return one row per utterance and condition in place of one for each ear.

    A score is that of the ear which scores higher by its measure; the level is that of the ear which scores
    higher by the first measure. Facts of an item are those of the better ear under the last condition.
    """
    places = {name: number for number, name in enumerate(dict.fromkeys(table["condition"]))}
    utterance = ["listener", "utterance", "snr"]
    numbers = table.groupby(utterance, sort=False, dropna=False).ngroup()
    table = table.assign(item=numbers, place=table["condition"].map(places))
    order = ["item", "place", measures[0], "ear"]
    table = table.sort_values(order, ascending=[True, True, False, True], kind="stable")
    best = table.drop_duplicates(["item", "place"]).set_index(["item", "place"])
    for measure in measures:
        best[measure] = table.groupby(["item", "place"])[measure].max()
    last = best.xs(len(places) - 1, level="place")
    rows = best.reset_index()
    for fact in ("ear", "severity", "audiogram", "full_scale_spl", "clean_level"):
        rows[fact] = rows["item"].map(last[fact])
    rows["name"] = [_name(*parts) for parts in zip(*(rows[key] for key in utterance), strict=True)]
    return rows.drop(columns="place")


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
        ears = _read_ears(str(audiograms), _file_name)
        _check_complete(names, ears, f"{audiograms}: no audiogram for")
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
    full_scale_spl: float = 94.0,
    spl: float | None = None,
) -> list[Recording]:
    """Read the recordings of a manifest, in the order of their first rows.

    Args:
        root: folder that the paths are relative to and may not leave; by default that of the manifest.
        audiogram: the ear of rows that name none.
        audiograms: a CSV file with columns ``listener``, ``ear`` (if left and right differ) and ``hl_250``, ....
        full_scale_spl, spl: the level of rows that name none, as in ``Recording``.

    Raises:
        ValueError: a row is wrong; the message names its line.
    """
    folder = resolve_links(Path(path).parent if root is None else root)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; the paths of the manifest are relative to it")
    ears = {} if audiograms is None else _read_ears(audiograms, _listener_and_ear)
    rows = read_table(path, "the manifest")
    lacking = [column for column in _REQUIRED if not rows or column not in rows[0][1]]
    if lacking:
        raise ValueError(f"{path} has no rows with the columns {', '.join(lacking)}")
    recordings: dict[tuple[Any, ...], Recording] = {}
    for line, row in rows:
        try:
            found = _read_row(row, folder, ears, audiogram, full_scale_spl, spl)
            identity = found.listener, found.ear, found.utterance, found.clean, str(found.snr)
            known = recordings.get(identity)
            recordings[identity] = found if known is None else _joined(known, found)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
    return list(recordings.values())


def _joined(known: Recording, found: Recording) -> Recording:
    """Add the output of a further row to a recording."""
    if twice := known.outputs.keys() & found.outputs.keys():
        raise ValueError(f"a second row of {known.name} under {twice.pop()}")
    same = (known.audiogram, known.full_scale_spl, known.spl)
    if same != (found.audiogram, found.full_scale_spl, found.spl):
        raise ValueError(f"audiogram or level differ from those of the other rows of {known.name}")
    return replace(known, outputs={**known.outputs, **found.outputs})


def _read_row(
    row: Mapping[str, str],
    root: Path,
    ears: Mapping[tuple[str, str], Audiogram],
    audiogram: Audiogram | None,
    full_scale_spl: float,
    spl: float | None,
) -> Recording:
    condition, listener, ear = row["condition"], row.get("listener", ""), _ear_name(row)
    if not condition.isprintable() or not condition:
        raise ValueError(f"the condition {condition!r} is not a printable name")
    if _number(row, "full_scale_spl") is not None:
        full_scale_spl, spl = float(row["full_scale_spl"]), None
    elif _number(row, "spl") is not None:
        spl = float(row["spl"])
    levels = {key: value for key, value in row.items() if key.lower().startswith("hl")}
    if any(levels.values()):
        audiogram = Audiogram.from_row(levels)
    elif row.get("audiogram"):
        audiogram = Audiogram.standard(row["audiogram"])
    else:
        audiogram = ears.get((listener, ear)) or ears.get((listener, "")) or audiogram
    if audiogram is None:
        raise ValueError(
            f"no audiogram of listener {listener!r}, ear {ear!r}: add columns hl_250, hl_500, ... or a "
            "column audiogram, or name a file of audiograms"
        )
    snr = _number(row, "snr")
    return Recording(
        utterance=row.get("item") or PurePosixPath(row["clean"]).with_suffix("").as_posix(),
        clean=_below(root, row["clean"]),
        outputs={condition: _below(root, row["processed"])},
        audiogram=audiogram,
        listener=listener,
        ear=ear,
        snr=math.nan if snr is None else snr,
        full_scale_spl=check_full_scale(full_scale_spl),
        spl=spl,
    )


def _below(root: Path, name: str) -> Path:
    """Return a path below the root, with links followed; ValueError if it leaves it."""
    path = resolve_links(root / name)
    if not name or not path.is_relative_to(root):
        raise ValueError(f"{name!r} is not a path below {root}")
    return path


def _number(row: Mapping[str, str], column: str) -> float | None:
    text = row.get(column, "")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{column} is {text!r}; expected a number of dB")
    return value


def _ear_name(row: Mapping[str, str]) -> str:
    text = row.get("ear", "").lower()
    if text not in _EAR_NAMES:
        raise ValueError(f"the ear is {text!r}; expected left or right")
    return _EAR_NAMES[text]


def _read_ears(
    path: str | Path, name_of: Callable[[Mapping[str, str]], Any]
) -> dict[Any, Audiogram]:
    """Read the audiograms of a CSV file by what ``name_of`` makes of a row."""
    ears: dict[Any, Audiogram] = {}
    for line, row, audiogram in numbered_audiograms(path):
        try:
            name = name_of(row)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from error
        if name in ears:
            raise ValueError(f"{path}, line {line}: a second row of {name}")
        ears[name] = audiogram
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
