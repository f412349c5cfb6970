"""Manifests: CSV files that list the utterances of a corpus, with their speakers and splits."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from hlsim.files import convert_at, path_below, read_table, warn_of_unused, write_atomically

SPLITS = ("train", "valid", "test")
"""Names of the splits: parts of a corpus for training, validation and test."""

COLUMNS = ("path", "noisy", "speaker", "split")
"""Columns of a manifest."""

_NON_SPEECH_WORDS = {"noise", "noises", "noisy", "mix", "mixture", "mixtures", "rir", "rirs"}
"""Words in the names of folders that contain no clean speech."""


@dataclass(frozen=True)
class Utterance:
    """Row of a manifest: one file of clean speech, usually one sentence.

    Attributes:
        path: Path of the clean speech, relative to the folder of the corpus, with forward slashes.
        noisy: Path of the noisy version, time-aligned and equally long; empty if there is none.
        speaker: Name of the speaker; empty if unknown.
        split: ``train``, ``valid`` or ``test``.

    >>> Utterance("clean/p226_001.wav", speaker="p226").split
    'train'
    """

    path: str
    noisy: str = ""
    speaker: str = ""
    split: str = "train"


def read_manifest(path: str | Path, root: str | Path | None = None) -> list[Utterance]:
    """Read and validate a manifest. The returned paths contain no ``.`` and ``..``.

    Args:
        path: CSV file with a column ``path`` and optional columns ``noisy`` (path of the noisy
            version), ``speaker`` and ``split``; their names may be in upper or lower case. A split
            is ``train``, ``valid`` or ``test``. Without the column ``split``, all utterances are in
            the split ``train``. Other columns cause a warning.
        root: Folder to which the paths are relative; by default the folder of the manifest.

    Raises:
        ValueError: The file is not such a table, a path leads out of the root, the rows contradict
            each other, see ``check_utterances``, or the first file is not in the root.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     Path(folder, "1.wav").touch()
    ...     _ = Path(folder, "manifest.csv").write_text("path,speaker\\n1.wav,ann\\n")
    ...     read_manifest(f"{folder}/manifest.csv")
    [Utterance(path='1.wav', noisy='', speaker='ann', split='train')]
    """
    folder = Path(path).parent if root is None else Path(root)
    rows = read_table(path, "the manifest", COLUMNS)
    warn_of_unused({*rows[0][1]} - {*COLUMNS}, str(path), COLUMNS)
    utterances = []
    for place, row in rows:
        values = {name: text for name, text in row.items() if name in COLUMNS}
        if not values.get("path") or values.get("split", "train") not in SPLITS:
            raise ValueError(
                f"{place}: expected a file in the column 'path', and train, valid or "
                f"test in the column 'split', got {values}; correct the row"
            )
        for column in ("path", "noisy"):
            if values.get(column):
                file = convert_at(place, path_below, folder, values[column])
                values[column] = Path(os.path.relpath(file, folder)).as_posix()
        utterances.append(Utterance(**values))
    try:
        check_utterances(utterances)
    except ValueError as error:
        raise ValueError(f"{path}: the manifest is not valid: {error}") from error
    if not (folder / utterances[0].path).is_file():
        raise ValueError(
            f"{path}: its first file, {utterances[0].path}, is not in {folder}; set the root "
            "(--root) to the folder to which the paths are relative"
        )
    return utterances


def write_manifest(path: str | Path, utterances: Sequence[Utterance]) -> None:
    """Write a manifest atomically, in place of an older manifest of this name.

    Args:
        path: CSV file to write.
        utterances: Rows of the manifest.

    Raises:
        ValueError: The file cannot be written, its name does not end in .csv, or it exists and is
            no manifest.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_manifest(f"{folder}/manifest.csv", [Utterance("1.wav")])
    ...     print(Path(folder, "manifest.csv").read_text(), end="")
    path,noisy,speaker,split
    1.wav,,,train
    """
    target = Path(path)
    if target.suffix != ".csv":
        raise ValueError(f"{path}: expected the name of a manifest, which ends in .csv")
    if target.is_file() and not target.read_bytes().startswith(",".join(COLUMNS).encode()):
        raise ValueError(f"{path}: would replace a file that is no manifest; choose another name")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(utterance) for utterance in utterances)
    write_atomically(path, text.getvalue())


def check_utterances(utterances: Sequence[Utterance]) -> None:
    """Validate the rows of a manifest.

    Args:
        utterances: Rows of the manifest.

    Raises:
        ValueError: There are no rows, a file is both clean and noisy, a noisy file or a clean file
            without a noisy one is listed twice, a clean file is in a folder of noises, mixtures or
            impulse responses by its name, or a file or a speaker is in two splits.

    >>> check_utterances([Utterance("noise/1.wav")])
    Traceback (most recent call last):
    ValueError: noise/1.wav is listed as clean speech, but is in a folder 'noise'
    """
    if not utterances:
        raise ValueError("there are no utterances, expected one per row")
    clean = {utterance.path for utterance in utterances}
    splits: dict[tuple[str, str], str] = {}
    listed = set()
    for utterance in utterances:
        file = utterance.noisy or utterance.path
        if file in listed:
            raise ValueError(f"{file} is listed twice; remove one of the rows")
        listed.add(file)
        if utterance.noisy in clean:
            raise ValueError(f"{utterance.noisy} is listed both as clean and as noisy speech")
        for folder in utterance.path.split("/")[:-1]:
            if _NON_SPEECH_WORDS & set(re.split("[^a-z]+", folder.lower())):
                raise ValueError(
                    f"{utterance.path} is listed as clean speech, but is in a folder {folder!r}"
                )
        for kind, name in (("file", utterance.path), ("speaker", utterance.speaker)):
            split = splits.setdefault((kind, name), utterance.split)
            if name and split != utterance.split:
                raise ValueError(f"{kind} {name} is in the splits {split} and {utterance.split}")
