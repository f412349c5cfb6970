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
"""Names of the splits."""

COLUMNS = ("path", "noisy", "speaker", "split")
"""Columns of a manifest."""

NON_SPEECH_WORDS = {"noise", "noises", "noisy", "mix", "mixture", "mixtures", "rir", "rirs"}
"""Words in the names of folders that contain no clean speech."""


@dataclass(frozen=True)
class Utterance:
    """Row of a manifest.

    Attributes:
        path: Path of the clean speech relative to the root, with forward slashes.
        noisy: Path of the noisy version, aligned and equally long; empty if there is none.
        speaker: Name of the speaker; empty if unknown.
        split: ``train``, ``valid`` or ``test``.
    """

    path: str
    noisy: str = ""
    speaker: str = ""
    split: str = "train"


def read_manifest(path: str | Path, root: str | Path | None = None) -> list[Utterance]:
    """Read and check a manifest.

    Args:
        path: CSV file with a column ``path`` and optional columns ``noisy`` (path of the noisy
            version), ``speaker`` and ``split``. Without the column ``split``, all utterances are in
            the split ``train``.
        root: Folder to which the paths are relative; by default the folder of the manifest.

    Raises:
        ValueError: The file is not such a table, a path is listed twice or is outside the root, or
            a speaker or a file is in two splits.
    """
    table = read_table(path, "the manifest")
    utterances = []
    for line, row in table:
        if not row.get("path"):
            raise ValueError(
                f"{path}, line {line}: the path is missing; expected a CSV file with a column "
                "'path' and optional columns 'noisy', 'speaker' and 'split'"
            )
        split = row.get("split", "train")
        if split not in SPLITS:
            raise ValueError(
                f"{path}, line {line}: expected the split train, valid or test, got {split!r}"
            )
        utterances.append(
            Utterance(row["path"], row.get("noisy", ""), row.get("speaker", ""), split)
        )
    if not utterances:
        raise ValueError(f"{path}: the manifest is empty, expected one row per utterance")
    folder = Path(path).parent if root is None else Path(root)
    try:
        check_utterances(utterances)
        check_paths(utterances, folder)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not (folder / utterances[0].path).is_file():
        raise ValueError(
            f"{path}: {folder} does not contain its first file, {utterances[0].path}; set the root "
            "(--root) to the folder to which the paths are relative"
        )
    return utterances


def write_manifest(path: str | Path, utterances: Sequence[Utterance]) -> None:
    """Write a manifest atomically; an older manifest is replaced.

    Raises:
        ValueError: The file cannot be written, or exists and is not a manifest.
    """
    header = ",".join(COLUMNS)
    if Path(path).exists():
        with open(path, encoding="utf-8", errors="replace") as file:
            if file.readline().strip() != header:
                raise ValueError(
                    f"{path}: refusing to overwrite a file that is no manifest; choose another name"
                )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(astuple(utterance) for utterance in utterances)
    write_atomically(path, text.getvalue())


def check_utterances(utterances: Sequence[Utterance]) -> None:
    """Raise ValueError if utterances contradict each other, or noise is listed as speech."""
    clean = {utterance.path for utterance in utterances}
    splits: dict[str, dict[str, str]] = {"file": {}, "speaker": {}}
    pairs = Counter((utterance.path, utterance.noisy) for utterance in utterances)
    for utterance in utterances:
        if utterance.noisy in clean:
            raise ValueError(f"{utterance.noisy} is listed both as clean and as noisy speech")
        if pairs[utterance.path, utterance.noisy] > 1:
            raise ValueError(f"{utterance.path} is listed twice")
        for folder in utterance.path.split("/")[:-1]:
            if NON_SPEECH_WORDS & set(re.split("[^a-z]+", folder.lower())):
                raise ValueError(
                    f"{utterance.path} is listed as clean speech, but is in a folder {folder!r}"
                )
        for kind, name in (("file", utterance.path), ("speaker", utterance.speaker)):
            other = splits[kind].setdefault(name, utterance.split)
            if name and other != utterance.split:
                raise ValueError(f"{kind} {name} is in the splits {other} and {utterance.split}")


def check_paths(utterances: Sequence[Utterance], root: Path) -> None:
    """Raise ValueError if a path leads out of the root, through ``..`` or a link."""
    inside = resolve_links(root)
    for utterance in utterances:
        for name in (utterance.path, utterance.noisy):
            path = PurePosixPath(name)
            leads_out = path.is_absolute() or ".." in path.parts
            if leads_out or not resolve_links(root / path).is_relative_to(inside):
                raise ValueError(
                    f"{name} is outside {root}; expected a path relative to that folder, "
                    "without '..'"
                )
