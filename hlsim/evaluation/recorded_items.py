"""Items whose outputs were recorded in files, which folders, a manifest or a DataFrame list.

A manifest is a CSV file with one row for each output file::

    listener,ear,condition,clean,processed,snr,hl_250,hl_500,...,hl_8000
    L1,left,unaided,clean/s01.flac,noisy/s01.flac,5,35,35,...,65
    L1,left,NAL-R,clean/s01.flac,nalr/L1-left/s01.flac,5,35,35,...,65

It needs the columns ``condition``, ``clean`` and ``processed``, the file of the output; paths are
relative to the root. It may have ``listener``, ``ear`` (left or right), ``item`` (name of the
utterance) and ``snr`` (dB). Rows with the same listener, ear, clean file, item and SNR form one
item. Its audiogram is in columns ``hl_250`` and so on, as in tables of ears, in a column
``audiogram`` by its standard name, or in a second file by ``listener`` and ``ear``.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor

from hlsim.audio import find_audio, read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.columns import threshold_columns
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.scale import EAR_NAMES, EARS
from hlsim.audiogram.table import named_ear, read_audiograms, read_listeners
from hlsim.audiogram.value import ears_in_row
from hlsim.calibration import full_scale_at
from hlsim.evaluation.running.fingerprint import value_hash
from hlsim.evaluation.study import Item
from hlsim.files import (
    check_spellings,
    convert_at,
    path_below,
    read_table,
    sha256,
    warn_of_unused,
)

if TYPE_CHECKING:
    from pandas import DataFrame

_REQUIRED_COLUMNS = ("condition", "clean", "processed")
"""Columns of a manifest that need a value in every row."""

_COLUMNS = (*_REQUIRED_COLUMNS, "listener", "ear", "item", "snr", "audiogram", "spl")
"""Columns of a manifest that hlsim understands, beside those of thresholds."""


@dataclass(frozen=True)
class RecordedItem:
    """Recorded outputs of one or more conditions for one utterance and one ear, in files.

    Args:
        utterance: Name of the utterance, the same for both ears of a listener.
        clean: File of clean speech.
        outputs: File of the output under each condition, by the name of the condition, or the error
            that prevented this output.
        audiogram: Audiogram of the ear.
        listener: Name of the listener; empty if unknown.
        ear: ``"left"``, ``"right"`` or empty, which selects the channel of a file with two
            channels.
        snr: Signal-to-noise ratio in dB; NaN if unknown, infinite for speech in quiet.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        spl: Level of the clean file in dB SPL, over all its channels, from which its full scale and
            that of its outputs follow. None uses ``full_scale_spl``.
        seed: Seed of the study. The seed of an item depends on this seed and on the contents of its
            clean file.

    >>> ear = Audiogram.standard("N3")
    >>> RecordedItem("s01", Path("s01.wav"), {}, ear, listener="L1", ear="left", snr=5.0).name
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
        """Name in tables: listener, ear, utterance and SNR, as far as they are known."""
        return join_name(self.listener, self.ear, self.utterance, self.snr)

    @property
    def both_ears_name(self) -> str:
        """Name without the ear: listener, utterance and SNR, as far as they are known."""
        return join_name(self.listener, self.utterance, self.snr)

    @property
    def clean_name(self) -> str:
        """Path of the clean file and name of the ear as one text, which listeners may share."""
        return f"{self.clean} {self.ear}"

    @property
    def utterance_key(self) -> tuple[str, str, float | None]:
        """Listener, utterance and SNR, by which the two ears of an utterance are found.

        An unknown SNR is None here, because NaN does not equal itself.
        """
        snr = None if math.isnan(self.snr) else self.snr
        return self.listener, self.utterance, snr

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Listener, ear, utterance, SNR, degree of loss and thresholds, by column of the table."""
        return {
            "listener": self.listener,
            "ear": self.ear,
            "utterance": self.utterance,
            "snr": self.snr,
            "severity": self.audiogram.severity,
            "audiogram": list(self.audiogram.thresholds),
        }

    def digest(self, condition: str) -> str:
        """Return a hash of the clean file, the output under a condition, the ear, level and seed.

        Raises:
            ValueError: There is no output under this condition.
            OSError: A file cannot be read.
        """
        files = [_file_hash(self.clean), _file_hash(self._output_file(condition))]
        level = [self.full_scale_spl, self.spl]
        return value_hash([files, level, self.ear, self.audiogram.to_dict(), self.seed])

    def load(self) -> Item:
        """Read the clean speech, and return the item, whose outputs are read when they are scored.

        Raises:
            ValueError: The file cannot be read, it is not known which channel is that of the ear,
                or ``spl`` does not fit the file.
        """
        waveform, rate = read_audio(self.clean)
        clean = self._select_channel(self.clean, waveform)
        full_scale = self.full_scale_spl
        if self.spl is not None:
            full_scale = full_scale_at(self.spl, waveform)
        return Item(
            self.name,
            clean,
            clean,
            self.audiogram,
            sample_rate=rate,
            full_scale_spl=full_scale,
            seed=(self.seed + int(_file_hash(self.clean)[:8], 16)) % 2**32,
            facts=dict(self.facts),
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
        waveform, output_rate = read_audio(path)
        if output_rate != rate:
            raise ValueError(
                f"{path}: expected the sample rate of {self.clean}, {rate} Hz, got {output_rate} "
                "Hz; resample one of the files"
            )
        return self._select_channel(path, waveform)

    def _select_channel(self, path: Path, waveform: Tensor) -> Tensor:
        """Return the samples of the ear in float64. Shape: (channels, time) -> (time,).

        Of two channels, the first is the left ear. A single channel serves any ear.

        Args:
            path: File of the waveform, for the message.
            waveform: Samples of all channels.

        Raises:
            ValueError: There are more than two channels, or two and no name of the ear.
        """
        channels = len(waveform)
        if channels > 2 or (channels == 2 and not self.ear):
            raise ValueError(
                f"{path}: expected one channel, or two if the ear is named left or right (column "
                f"ear of a manifest), got {channels}; write the ear's channel to a file"
            )
        return waveform[EARS.index(self.ear) if channels == 2 else 0].double()


def _file_hash(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal.

    A file whose size and times have not changed is not read again, for up to 65536 files.
    """
    state = path.stat()
    # Copying may set the time of modification, but not that of the change.
    return _hash_of_state(path, state.st_size, state.st_mtime_ns, state.st_ctime_ns)


@lru_cache(maxsize=65536)
def _hash_of_state(path: Path, *state: int) -> str:
    return sha256(path)


def join_name(*parts: str | float) -> str:
    """Join the known parts of an item's name by spaces. A number is an SNR in dB; NaN is unknown.

    >>> join_name("L1", "", "s01", 5.0), join_name("s01", math.nan), join_name("s01", math.inf)
    ('L1 s01 5 dB', 's01', 's01 in quiet')
    """
    texts = []
    for part in parts:
        if isinstance(part, str):
            texts.append(part)
        elif part == math.inf:
            texts.append("in quiet")
        elif not math.isnan(part):
            texts.append(f"{part:g} dB")
    return " ".join(filter(None, texts))


def read_folders(
    clean: str | Path,
    folders: Mapping[str, str | Path],
    ears: Sequence[tuple[str, str, Audiogram]],
    **settings: Any,
) -> list[RecordedItem]:
    """Return one recording per ear and file of a folder of clean speech.

    Args:
        clean: Folder of clean speech, in which subfolders are searched, too.
        folders: Folder of the outputs by condition. A file has the same path in all folders, apart
            from its extension.
        ears: Name of the listener, name of the ear and audiogram of each ear; names may be empty.
        settings: Arguments ``full_scale_spl``, ``spl`` and ``seed`` of the recordings.

    Raises:
        ValueError: The names of the files differ between folders, two files of a folder differ only
            in their extension, or a folder does not exist or has no audio.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder, ears = EXAMPLE_FILE.parent, [("L1", "left", Audiogram.standard("N3"))]
    >>> [recording.name for recording in read_folders(folder, {"mine": folder}, ears)][:1]
    ['L1 left espeak-scotland-m7-01']
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
    recordings = []
    for listener, ear, audiogram in ears:
        for name, path in speech.items():
            files_of_name = {condition: files[name] for condition, files in outputs.items()}
            recordings.append(
                RecordedItem(name, path, files_of_name, audiogram, listener, ear, **settings)
            )
    return recordings


def read_named_ears(audiograms: Any) -> list[tuple[str, str, Audiogram]]:
    """Return name of the listener, name of the ear and audiogram of each ear of a table.

    The listener of an ear without a name is called ``row 3``, by the number of the ear in the
    table.

    Args:
        audiograms: Table of ears, see ``read_audiograms``, or Clarity's ``listeners.json``.

    Returns:
        One tuple (listener, ear, audiogram) per ear, where ``ear`` is ``"left"``, ``"right"`` or
        empty.

    Raises:
        ValueError: The table cannot be read, or an ear has several rows.

    >>> read_named_ears("standard")[0]
    ('N1', '', Audiogram('N1'))
    """
    is_file = isinstance(audiograms, str | Path)
    if is_file and str(audiograms).lower().endswith(".json"):
        listeners = read_listeners(audiograms).items()
        return [(name, side, ear) for name, both in listeners for side, ear in both.ears().items()]
    ears: dict[tuple[str, str], Audiogram] = {}
    for number, (row, audiogram) in enumerate(read_audiograms(audiograms), start=1):
        listener = row.get("listener") or f"row {number}"
        side = EAR_NAMES.get(row.get("ear", "").lower(), "")
        if (listener, side) in ears:
            raise ValueError(
                f"{audiograms if is_file else 'the table'}: expected one row for each ear, got "
                f"several of listener {listener!r}, ear {side!r}; name the listener and the ear of "
                "each row"
            )
        ears[listener, side] = audiogram
    return [(*names, audiogram) for names, audiogram in ears.items()]


def _files_by_name(folder: str | Path) -> dict[str, Path]:
    """Return the audio files of a folder, by their path below it without extension.

    Raises:
        ValueError: There is no such folder, it contains no audio, or two files differ only in their
            extension.
    """
    files: dict[str, Path] = {}
    for path in find_audio(folder, by_name=True):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if name in files:
            raise ValueError(f"{files[name]} and {path} differ in their extension; keep one")
        files[name] = path
    return files


def read_recordings(
    manifest: str | Path | DataFrame,
    root: str | Path | None = None,
    audiogram: Audiogram | None = None,
    audiograms: str | Path | None = None,
    **settings: Any,
) -> tuple[list[RecordedItem], list[str]]:
    """Return the recordings of a manifest and the names of its conditions, in order of their rows.

    Args:
        manifest: CSV file or DataFrame with one row per output and the columns that the top of this
            module describes: ``condition``, ``clean`` and ``processed``, and others if they are
            known.
        root: Folder to which the paths are relative; by default that of the manifest, or the
            current folder for a DataFrame.
        audiogram: The ear of rows without an audiogram, if ``audiograms`` is not passed. If no row
            uses it, there is a warning.
        audiograms: File of listeners, see ``read_listeners``. It must have the listeners of all
            rows, and the ear of each row that has no audiogram of its own.
        settings: Arguments ``full_scale_spl``, ``spl`` and ``seed`` of the recordings.

    Raises:
        ValueError: A file cannot be read, a required column is missing, there is a column ``spl``
            (pass the argument ``spl`` instead), the names of two listeners or conditions differ
            only in case, a listener is unknown, or a row is not valid; for a row, the message names
            its place.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "m.csv"
    ...     _ = path.write_text("condition,clean,processed,audiogram\\nmine,c/1.wav,p/1.wav,N3\\n")
    ...     recordings, conditions = read_recordings(path)
    >>> [recording.name for recording in recordings], conditions
    (['c/1'], ['mine'])
    """
    is_file = isinstance(manifest, (str, Path))
    rows = read_table(manifest, "the manifest", _COLUMNS)
    folder = root if root is not None else (Path(manifest).parent if is_file else Path())
    columns = rows[0][1]
    if "spl" in columns:
        raise ValueError(
            f"{rows[0][0]}: expected no column spl, because all files have one level; remove it, "
            "and pass the option --spl (spl in Python)"
        )
    for column in _REQUIRED_COLUMNS:
        if column not in columns:
            raise ValueError(
                f"{rows[0][0]}: there is no column {column}, only {', '.join(columns)}; add it"
            )
    known = [column for column in _COLUMNS if column != "spl"]
    warn_of_unused({*columns} - {*known, *threshold_columns(columns)}, "the manifest", known)
    for column in ("listener", "condition"):
        check_spellings(rows, column)
    listeners: dict[str, Listener] = {}
    if audiograms is not None:
        listeners = read_listeners(audiograms, {row.get("listener", "") for _, row in rows})
    recordings: dict[tuple[Any, ...], RecordedItem] = {}
    for place, row in rows:
        recording = convert_at(place, _read_row, row, folder, listeners, audiogram, settings)
        key = (*recording.utterance_key, recording.ear, recording.clean)
        if key in recordings:
            recording = convert_at(place, _merge, recordings[key], recording)
        recordings[key] = recording
    if audiogram is not None and all(r.audiogram is not audiogram for r in recordings.values()):
        warnings.warn(
            "audiogram (--audiogram) is not used, because every row of the manifest has an ear, in "
            "its columns or in the file of audiograms; leave it out, or remove these",
            stacklevel=2,
        )
    # The first recording may lack a condition, so its outputs do not have the order of the rows.
    conditions = dict.fromkeys(row["condition"] for _, row in rows)
    return list(recordings.values()), list(conditions)


def _merge(earlier: RecordedItem, recording: RecordedItem) -> RecordedItem:
    """Return a recording with its own outputs and those of an earlier one of the same item.

    Raises:
        ValueError: Both have an output under one condition, or their audiograms differ.
    """
    for condition in earlier.outputs.keys() & recording.outputs.keys():
        raise ValueError(
            f"expected one row of {recording.name} under condition {condition}, got a second one; "
            "remove one of them, or give both different values in the column item"
        )
    if recording.audiogram != earlier.audiogram:
        raise ValueError(
            f"expected the audiogram of earlier rows of {recording.name}, got another one; write "
            "one audiogram in all its rows"
        )
    return replace(recording, outputs={**earlier.outputs, **recording.outputs})


def _read_row(
    row: Mapping[str, str],
    root: str | Path,
    listeners: Mapping[str, Listener],
    audiogram: Audiogram | None,
    settings: Mapping[str, Any],
) -> RecordedItem:
    """Return the recording that a row of a manifest describes, with one output.

    Args:
        row: Texts by column.
        root: Folder to which the paths are relative.
        listeners: Listeners by their name.
        audiogram: The ear if the row has no audiogram and ``listeners`` does not have its listener.
        settings: Arguments ``full_scale_spl``, ``spl`` and ``seed`` of the recording.

    Raises:
        ValueError: A value is missing or not valid, or the ear is given twice or not at all.
    """
    for column in _REQUIRED_COLUMNS:
        if not row[column]:
            raise ValueError(f"expected a value in the column {column}, got none; fill it in")
    listener, ear = row.get("listener", ""), named_ear(row) or ""
    has_thresholds = any(row[column] for column in threshold_columns(row))
    if has_thresholds and row.get("audiogram"):
        raise ValueError(
            "expected either thresholds or a name in the column audiogram, got both; remove one"
        )
    if has_thresholds:
        ears: dict[Any, Audiogram] = {**ears_in_row(row)}
        audiogram = ears.get(None) or ears.get(ear)
    elif row.get("audiogram"):
        audiogram = Audiogram.standard(row["audiogram"])
    elif listener in listeners:
        audiogram = getattr(listeners[listener], ear, None)
    if audiogram is None:
        raise ValueError(
            f"there is no audiogram of listener {listener!r}, ear {ear!r}; add columns hl_250, "
            "hl_500, ... or a column audiogram, or pass a file of audiograms with a row for this "
            "ear"
        )
    clean = path_below(root, row["clean"])
    clean_name = clean.relative_to(os.path.abspath(root)).with_suffix("").as_posix()
    return RecordedItem(
        utterance=row.get("item") or clean_name,
        clean=clean,
        outputs={row["condition"]: path_below(root, row["processed"])},
        audiogram=audiogram,
        listener=listener,
        ear=ear,
        snr=_parse_snr(row.get("snr", "")),
        **settings,
    )


def _parse_snr(text: str) -> float:
    """Return the SNR in dB of a text such as "5", "2,5 dB" or "inf" (in quiet); NaN if it is empty.

    Raises:
        ValueError: The text is not a number, or is NaN or minus infinity.
    """
    if not text.strip():
        return math.nan
    number = text.strip().lower().removesuffix("db").replace(",", ".")
    try:
        snr = float(number)
    except ValueError:
        snr = math.nan
    if not snr > -math.inf:
        raise ValueError(
            f"expected a number in dB in the column snr, such as 5, or inf for speech in quiet, "
            f"got {text!r}; correct it, or leave it empty if the ratio is unknown"
        )
    return snr
