"""The study of ``haspi-report``: outputs that were recorded in files are scored and compared.

The files are in folders, or in a manifest, a CSV file with one row for each output file::

    listener,ear,condition,clean,processed,snr,hl_250,hl_500,...,hl_8000
    L1,left,unaided,clean/s01.flac,noisy/s01.flac,5,35,35,...,65
    L1,left,NAL-R,clean/s01.flac,nalr/L1-left/s01.flac,5,35,35,...,65

A manifest needs the columns ``condition``, ``clean`` and ``processed``; paths are relative to the
root. It may have ``listener``, ``ear`` (left or right), ``item`` and ``snr`` (dB). Rows with the
same listener, ear, clean file, item and SNR form one item. Its audiogram is in columns ``hl_250``
and so on, in a column ``audiogram`` by its standard name, or in a second file by ``listener`` and
``ear``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EAR_NAMES, EARS, Listener
from hlsim.audiogram.table import read_listeners
from hlsim.audiogram.value import convert_at
from hlsim.calibration import check_full_scale, dbfs
from hlsim.evaluation.comparison import PlannedComparison, compare
from hlsim.evaluation.fingerprint import value_hash
from hlsim.evaluation.measures import LEVELS, find_measures
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition, Item
from hlsim.extras import require
from hlsim.files import path_below, read_table, sha256

if TYPE_CHECKING:
    from pandas import DataFrame

_REQUIRED_COLUMNS = ("condition", "clean", "processed")
"""Columns that every row of a manifest must fill."""

_UTTERANCE_COLUMNS = ["listener", "utterance", "snr"]
"""Columns of the table that both ears of an utterance share."""

_EAR_FACTS = ["source", "ear", "severity", "audiogram", "full_scale_spl", "clean_level"]
"""Columns of the table that describe the item of one ear."""


@dataclass(frozen=True)
class Recording:
    """Recorded outputs of one or more conditions for one utterance and one ear, in files.

    Args:
        utterance: Name of the utterance, the same for both ears of a listener.
        clean: File of clean speech.
        outputs: File of the output under each condition, by the name of the condition, or the error
            because of which there is none.
        audiogram: The ear.
        listener: Name of the listener; empty if unknown.
        ear: ``"left"``, ``"right"`` or empty, which selects the channel of a file with two
            channels.
        snr: Signal-to-noise ratio in dB; NaN if unknown.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        spl: Level of the clean file in dB SPL, which replaces ``full_scale_spl``; None uses
            ``full_scale_spl``.
        seed: Seed of the study. The seed of an item depends on this seed and on the contents of its
            clean file.

    >>> ear = Audiogram.standard("N3")
    >>> Recording("s01", Path("s01.wav"), {}, ear, listener="L1", ear="left", snr=5.0).name
    'L1 left s01 5 dB'
    """

    utterance: str
    clean: Path
    outputs: Mapping[str, Path | ValueError]
    audiogram: Audiogram
    listener: str = ""
    ear: str = ""
    snr: float = math.nan
    full_scale_spl: float = 94.0
    spl: float | None = None
    seed: int = 0

    @property
    def name(self) -> str:
        """Listener, ear, utterance and SNR, if they are known."""
        return _join_name(self.listener, self.ear, self.utterance, self.snr)

    @property
    def facts(self) -> dict[str, Any]:
        """Columns of the table that describe the recording, without its name."""
        return {
            "listener": self.listener,
            "ear": self.ear,
            "utterance": self.utterance,
            "snr": self.snr,
            "severity": self.audiogram.severity,
            "audiogram": list(self.audiogram.thresholds),
        }

    def digest(self, condition: str) -> str:
        """Return a hash of both files, the ear, the level and the seed, which decide all scores."""
        files = [sha256(self.clean), sha256(self._output_file(condition))]
        level = [self.full_scale_spl, self.spl]
        return value_hash([files, level, self.ear, self.audiogram.thresholds, self.seed])

    def load(self) -> Item:
        """Read the clean speech. Outputs are read when they are measured.

        Raises:
            ValueError: The file cannot be read.
        """
        clean, rate = self._read_channel(self.clean)
        full_scale = self.full_scale_spl
        if self.spl is not None:
            full_scale = check_full_scale(self.spl - float(dbfs(clean)))
        return Item(
            self.name,
            clean,
            clean,
            self.audiogram,
            sample_rate=rate,
            full_scale_spl=full_scale,
            seed=(self.seed + int(sha256(self.clean)[:8], 16)) % 2**32,
            facts=self.facts,
            recorded=partial(self._read_output, rate),
        )

    def _output_file(self, condition: str) -> Path:
        file = self.outputs.get(condition)
        if file is None:
            raise ValueError(
                f"no output of {self.name} is recorded under {condition}; add its file, for "
                "example by a row of the manifest"
            )
        if isinstance(file, ValueError):
            raise file
        return file

    def _read_output(self, rate: int, condition: str) -> Tensor:
        path = self._output_file(condition)
        output, output_rate = self._read_channel(path)
        if output_rate != rate:
            raise ValueError(
                f"{path}: expected the sample rate of {self.clean}, {rate} Hz, got {output_rate} "
                "Hz; resample one of the files"
            )
        return output

    def _read_channel(self, path: Path) -> tuple[Tensor, int]:
        """Read the ear's channel, in float64 with shape (time,), and the sample rate in Hz."""
        waveform, rate = read_audio(path)
        channels = len(waveform)
        if channels > 2 or (channels == 2 and not self.ear):
            raise ValueError(
                f"{path}: expected one channel, or two if the ear is named left or right (column "
                f"ear of a manifest), got {channels}; write the ear's channel to a file"
            )
        return waveform[EARS.index(self.ear) if channels == 2 else 0].double(), rate


def _join_name(*parts: str | float) -> str:
    """Join the known parts of an item's name. A number is an SNR in dB."""
    texts = [part if isinstance(part, str) else f"{part:g} dB" for part in parts if part == part]
    return " ".join(filter(None, texts))


def haspi_report(
    clean: str | Path | None = None,
    before: str | Path | None = None,
    after: str | Path | None = None,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    manifest: str | Path | None = None,
    root: str | Path | None = None,
    measures: Sequence[str] = ("haspi",),
    baseline: str | None = None,
    better_ear: bool = False,
    store: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Score recorded speech by HASPI v2 and other measures, and compare its conditions.

    An interrupted run can be continued. A file that cannot be scored is listed with the reason.

    Args:
        clean: Folder of clean speech.
        before, after: Folders of the speech before and after a treatment, such as an aid, with
            files of the same names. Without ``before``, there are scores and no comparison.
        audiogram: The ear of all files, or of those rows of the manifest that have no ear.
        audiograms: File of the ears of a manifest's listeners, see ``read_listeners``.
        manifest: CSV file instead of the folders, with one row per output file and the columns
            ``condition``, ``clean`` and ``processed``, and optionally ``listener``, ``ear``,
            ``item``, ``snr`` (dB), and ``hl_250``, ... or ``audiogram``.
        root: Folder to which the paths in the manifest are relative; by default the manifest's.
        measures: Names of measures, the most important first: ``haspi``, ``hasqi``, ``haaqi``,
            ``stoi``, ``pesq`` or ``package.module:name``.
        baseline: Condition with which all other conditions are compared. By default, all
            conditions are compared with each other.
        better_ear: Whether to use the better ear's score of each utterance, for which a manifest
            with both ears is needed.
        store: File of scores, which is created if it does not exist; None stores nothing.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        spl: Level of every clean file in dB SPL, which replaces ``full_scale_spl``.
        seed: Seed of the noise that HASPI, HASQI and HAAQI add.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation. The comparison of the last condition with the first by the first measure
        counts as planned before the scores were known, so its p values are not adjusted.

    Raises:
        ValueError: Files do not match, a row of the manifest is not valid, or nothing could be
            scored.
        MissingExtraError: The package of a measure is not installed.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ear = EXAMPLE_FILE.parent, Audiogram.standard("N3")
    >>> report = haspi_report(folder, after=folder, audiogram=ear, measures=["stoi"], jobs=1)
    >>> round(float(report.table["stoi"].mean()), 3)
    1.0
    """
    settings: dict[str, Any] = {"full_scale_spl": full_scale_spl, "spl": spl, "seed": seed}
    if manifest and not any((clean, before, after)):
        recordings = _read_manifest(manifest, root, audiogram, audiograms, **settings)
    elif clean and after and audiogram and not (manifest or audiograms):
        folders = {
            name: folder for name, folder in (("before", before), ("after", after)) if folder
        }
        recordings = _read_folders(clean, folders, audiogram, **settings)
    else:
        raise ValueError(
            "expected either a manifest, or the folders clean and after (and before) with their "
            "audiogram; pass one of the two"
        )
    names = list(dict.fromkeys(name for r in recordings for name in r.outputs))
    if baseline is not None:
        if baseline not in names:
            raise ValueError(
                f"there is no condition {baseline!r} for the baseline; pass one of "
                f"{', '.join(names)}"
            )
        names.sort(key=lambda name: name != baseline)
    return score_recordings(
        recordings,
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
    measures: Sequence[str],
    *,
    baseline: str | None = None,
    better_ear: bool = False,
    planned: Sequence[PlannedComparison] = (),
    **running: Any,
) -> Evaluation:
    """Score recordings and compare their conditions.

    Args:
        recordings: One recording per utterance and ear.
        conditions: Conditions under which outputs were recorded.
        measures: Names of measures, the most important first.
        baseline: Condition with which all others are compared; by default, all pairs are compared.
        better_ear: Whether to use the better ear's score of each utterance.
        planned: Planned comparisons; by default that of the first with the last condition by the
            first measure.
        running: Argument ``store``, a file of scores or None, and the arguments ``jobs``, ``dask``
            and ``progress`` of ``run_study``.

    Returns:
        The evaluation. With ``better_ear``, its table has one row per utterance and condition.

    Raises:
        ValueError: Nothing could be scored, or ``better_ear`` is set and an utterance lacks an ear.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> outputs = {"unaided": EXAMPLE_FILE}
    >>> recording = Recording("s01", EXAMPLE_FILE, outputs, Audiogram.standard("N3"))
    >>> evaluation = score_recordings(
    ...     [recording], [Condition("unaided")], ["stoi"], store=None, jobs=1
    ... )
    >>> evaluation.names
    ['unaided']
    """
    if better_ear:
        facts = require("pandas", "eval").DataFrame([recording.facts for recording in recordings])
        ears = facts.groupby(_UTTERANCE_COLUMNS, dropna=False)["ear"].nunique()
        if (ears < 2).any():
            raise ValueError(
                "expected one left and one right ear of each utterance for the better ear, but "
                f"{_join_name(*ears.idxmin())} lacks one; add the missing rows, or leave out "
                "better_ear (--better-ear)"
            )
    settings = {"seed": recordings[0].seed, "baseline": baseline, "better_ear": better_ear}
    columns = [*find_measures(measures), LEVELS]
    evaluation = Evaluation.run(recordings, conditions, columns, settings=settings, **running)
    scores = evaluation.scores
    if better_ear:
        evaluation = replace(evaluation, table=_better_ears(evaluation.table, scores))
    planned = planned or [(scores[0], evaluation.names[0], evaluation.names[-1])]
    comparisons = compare(evaluation.table, scores, baseline=baseline, planned=planned)
    return replace(evaluation, comparisons=comparisons)


def _better_ears(table: DataFrame, measures: Sequence[str]) -> DataFrame:
    """Keep the better ear's score of each utterance and condition.

    Each measure chooses its own better ear. Values that are not scores are those of the better ear
    by the first measure.

    Args:
        table: Table of ``run_study`` for recordings of both ears of each utterance.
        measures: Columns of scores.

    Returns:
        The table with one row per utterance and condition. Facts of the item are those of the
        better ear in the last condition, whose number is in the column ``source``.
    """
    numbers = table.groupby(_UTTERANCE_COLUMNS, sort=False, dropna=False).ngroup()
    table = table.assign(source=table["item"], item=numbers)
    row = ["item", "condition"]
    rows = table.set_index(row).index.unique()
    # The left ear counts if both ears have the same score.
    order = table.sort_values([measures[0], "ear"], ascending=[False, True], kind="stable")
    best = order.drop_duplicates(row).set_index(row).loc[rows]
    best = best.assign(**table.groupby(row)[list(measures)].max()).reset_index()
    best[_EAR_FACTS] = best.groupby("item")[_EAR_FACTS].transform("last")
    utterances = best[_UTTERANCE_COLUMNS].itertuples(index=False)
    return best.assign(name=[_join_name(*utterance) for utterance in utterances])


def _read_folders(
    clean: str | Path, folders: Mapping[str, str | Path], audiogram: Audiogram, **settings: Any
) -> list[Recording]:
    """Return one recording per file of a folder of clean speech.

    Args:
        clean: Folder of clean speech.
        folders: Folder of the outputs by condition. The files of all folders have the same names,
            whatever their extension.
        audiogram: The ear of all files.
        settings: Arguments ``full_scale_spl``, ``spl`` and ``seed`` of the recordings.

    Raises:
        ValueError: The names differ.
    """
    speech = _files_by_name(clean)
    outputs = {condition: _files_by_name(folder) for condition, folder in folders.items()}
    for condition, files in outputs.items():
        different_names = sorted(files.keys() ^ speech.keys())
        if different_names:
            raise ValueError(
                f"{clean} and {folders[condition]}: expected files with the same names, but only "
                f"one of them has {different_names[0]} ({len(different_names)} differences); "
                "rename, add or remove files"
            )
    return [
        Recording(
            name, path, {c: files[name] for c, files in outputs.items()}, audiogram, **settings
        )
        for name, path in speech.items()
    ]


def _files_by_name(folder: str | Path) -> dict[str, Path]:
    """Return the audio files of a folder by their path below it, without extension."""
    files: dict[str, Path] = {}
    for path in find_audio(folder):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name in files:
            raise ValueError(f"{files[name]} and {path} differ in their extension; keep one")
        files[name] = path
    return files


def _read_manifest(
    path: str | Path,
    root: str | Path | None = None,
    audiogram: Audiogram | None = None,
    audiograms: str | Path | None = None,
    **settings: Any,
) -> list[Recording]:
    """Return the recordings of a manifest, in the order of their first rows.

    Args:
        path: CSV file with one row per output and the columns that the top of this module
            describes: ``condition``, ``clean`` and ``processed``, and others if they are known.
        root: Folder to which the paths are relative; by default that of the manifest.
        audiogram: The ear of rows without an audiogram.
        audiograms: File of listeners, see ``read_listeners``.
        settings: Arguments ``full_scale_spl``, ``spl`` and ``seed`` of the recordings.

    Raises:
        ValueError: A row is not valid; the message names its line.
    """
    folder = Path(path).parent if root is None else Path(root)
    rows = read_table(path, "the manifest")
    if "spl" in rows[0][1]:
        raise ValueError(
            f"{path}: expected no column spl, because all files have one level; remove it, and "
            "pass the option --spl (spl in Python)"
        )
    listeners: dict[str, Listener] = {}
    if audiograms is not None:
        listeners = read_listeners(audiograms, {row.get("listener", "") for _, row in rows})
    recordings: dict[tuple[str, Path], Recording] = {}
    for line, row in rows:
        place = f"{path}, line {line}"
        recording = convert_at(place, _read_row, row, folder, listeners, audiogram, settings)
        key = recording.name, recording.clean
        earlier = recordings.get(key)
        if earlier is not None:
            if row["condition"] in earlier.outputs:
                raise ValueError(
                    f"{place}: expected one row of {recording.name} under condition "
                    f"{row['condition']}, got a second one; remove one of them, or give both "
                    "different values in the column item"
                )
            if recording.audiogram != earlier.audiogram:
                raise ValueError(
                    f"{place}: expected the audiogram of earlier rows of {recording.name}, got "
                    "another one; write one audiogram in all its rows"
                )
            recording = replace(recording, outputs={**earlier.outputs, **recording.outputs})
        recordings[key] = recording
    return list(recordings.values())


def _read_row(
    row: Mapping[str, str],
    root: Path,
    listeners: Mapping[str, Listener],
    audiogram: Audiogram | None,
    settings: Mapping[str, Any],
) -> Recording:
    """Return the recording of a row of a manifest, which has one output.

    Args:
        row: The row.
        root: Folder to which the paths are relative.
        listeners: Listeners by their name.
        audiogram: The ear if neither the row nor ``listeners`` has an audiogram.
        settings: Further arguments of the recording.
    """
    for column in _REQUIRED_COLUMNS:
        if not row.get(column):
            raise ValueError(f"expected a value in the column {column}, got none; fill it in")
    listener, text = row.get("listener", ""), row.get("ear", "")
    ear = EAR_NAMES.get(text.lower(), "")
    if text and not ear:
        raise ValueError(f"expected left or right in the column ear, got {text!r}; correct it")
    thresholds = {name: text for name, text in row.items() if name.lower().startswith("hl")}
    if any(thresholds.values()):
        audiogram = Audiogram.from_row(thresholds)
    elif row.get("audiogram"):
        audiogram = Audiogram.standard(row["audiogram"])
    elif listener in listeners:
        audiogram = getattr(listeners[listener], ear, None) or audiogram
    if audiogram is None:
        raise ValueError(
            f"there is no audiogram of listener {listener!r}, ear {text!r}; add columns hl_250, "
            "hl_500, ... or a column audiogram, or pass a file of audiograms with a row for this "
            "ear"
        )
    return Recording(
        utterance=row.get("item") or str(Path(row["clean"]).with_suffix("")),
        clean=path_below(root, row["clean"]),
        outputs={row["condition"]: path_below(root, row["processed"])},
        audiogram=audiogram,
        listener=listener,
        ear=ear,
        snr=float(row.get("snr") or "nan"),
        **settings,
    )
