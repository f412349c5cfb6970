"""Manifests: CSV files that list the utterances of a corpus, with their speakers and splits."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path, PurePosixPath

from hlsim.files import read_table, resolve_links, write_atomically

SPLITS = ("train", "valid", "test")
COLUMNS = ("path", "noisy", "speaker", "split")
NOT_SPEECH = {"noise", "noises", "noisy", "mix", "mixture", "mixtures", "rir", "rirs"}
"""Words in the name of a folder that cannot hold clean speech."""


@dataclass(frozen=True)
class Utterance:
    """One row of a manifest.

    Attributes:
        path: clean speech, relative to the root, with forward slashes.
        noisy: noisy version of the same utterance, aligned and equally long; empty if there is none.
        speaker: name of the speaker; empty if unknown.
        split: ``train``, ``valid`` or ``test``.
    """

    path: str
    noisy: str = ""
    speaker: str = ""
    split: str = "train"


def read_manifest(path: str | Path, root: str | Path | None = None) -> list[Utterance]:
    """Read and check a manifest.

    Args:
        path: CSV file with a column ``path`` and optional columns ``noisy``, ``speaker`` and ``split``. Without the
            column ``split``, every utterance is for training.
        root: folder that the paths are relative to; by default the folder of the manifest.

    Raises:
        ValueError: the file is not such a table, its rows contradict each other, or a path is outside the root.
    """
    table = read_table(path, "the manifest")
    utterances = []
    for line, row in table:
        if not row.get("path"):
            raise ValueError(
                f"{path}, line {line}: no path; expected a CSV file with a column 'path' and optional columns 'noisy', "
                "'speaker' and 'split'"
            )
        if (split := row.get("split", "train")) not in SPLITS:
            raise ValueError(f"{path}, line {line}: split {split!r}; write train, valid or test")
        utterances.append(
            Utterance(row["path"], row.get("noisy", ""), row.get("speaker", ""), split)
        )
    if not utterances:
        raise ValueError(f"{path}: has no rows; expected one row per utterance")
    folder = Path(path).parent if root is None else Path(root)
    try:
        check_utterances(utterances)
        check_paths(utterances, folder)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not (folder / utterances[0].path).is_file():
        raise ValueError(
            f"{path}: its first file, {utterances[0].path}, is not in {folder}; give the folder that the paths are "
            "relative to as the root (--root)"
        )
    return utterances


def write_manifest(path: str | Path, utterances: Sequence[Utterance]) -> None:
    """Write a manifest, whole or not at all.

    Raises:
        ValueError: the file cannot be written, or exists and is not a manifest.
    """
    header = ",".join(COLUMNS)
    if Path(path).exists():
        with open(path, encoding="utf-8", errors="replace") as file:
            if file.readline().strip() != header:
                raise ValueError(f"{path}: exists and is not a manifest; choose another name")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(utterance) for utterance in utterances)
    write_atomically(path, text.getvalue())


def check_utterances(utterances: Sequence[Utterance]) -> None:
    """Raise ValueError where utterances contradict each other, or noise is listed as speech."""
    clean = {utterance.path for utterance in utterances}
    splits: dict[str, dict[str, str]] = {"file": {}, "speaker": {}}
    pairs = Counter((utterance.path, utterance.noisy) for utterance in utterances)
    for utterance in utterances:
        if utterance.noisy in clean:
            raise ValueError(f"{utterance.noisy} is listed both as clean and as noisy speech")
        if pairs[utterance.path, utterance.noisy] > 1:
            raise ValueError(f"{utterance.path} is listed twice")
        for folder in utterance.path.split("/")[:-1]:
            if NOT_SPEECH & set(re.split("[^a-z]+", folder.lower())):
                raise ValueError(
                    f"{utterance.path} would be clean speech, but is in a folder {folder}"
                )
        for kind, name in (("file", utterance.path), ("speaker", utterance.speaker)):
            other = splits[kind].setdefault(name, utterance.split)
            if name and other != utterance.split:
                raise ValueError(f"{kind} {name} is in the splits {other} and {utterance.split}")


def check_paths(utterances: Sequence[Utterance], root: Path) -> None:
    """Raise ValueError where a path leads out of the root, through ``..`` or a link."""
    inside = resolve_links(root)
    for utterance in utterances:
        for name in (utterance.path, utterance.noisy):
            path = PurePosixPath(name)
            outside = path.is_absolute() or ".." in path.parts
            if outside or not resolve_links(root / path).is_relative_to(inside):
                raise ValueError(
                    f"{name} is outside {root}; paths are relative to that folder and stay in it"
                )
