"""Corpora of known layouts, turned into manifests.

A layout is recognised by the names of folders and files alone. What does not fit a layout exactly is rejected.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from hlsim.files import EXTENSIONS
from hlsim.training.corpora.manifest import (
    SPLITS,
    Utterance,
    check_paths,
    check_utterances,
    read_manifest,
    write_manifest,
)

SPLIT_NAMES = {
    "train": ("train", "training", "tr"),
    "valid": ("valid", "validation", "val", "dev", "cv", "eval"),
    "test": ("test", "testing", "tt"),
}
_SPLIT_OF = {name: split for split, names in SPLIT_NAMES.items() for name in names}
LEVELS = {
    "split": rf"(?P<split>{'|'.join(_SPLIT_OF)})",
    "speaker": r"(?P<speaker>[^/]+)",
    "condition": r"(?P<condition>clean|noisy|noises?)",
    "other": r"[^/]+",
}
"""Meanings that a level of folders can have, with the pattern of its names."""

LAYOUTS = {
    "VoiceBank-DEMAND": (
        r"(?P<condition>clean|noisy)(?P<set>_(?P<split>train|test)set(_28spk|_56spk)?_wav(?P<version>_16k|_48k)?)/"
        r"(?P<doubled>(?P=condition)(?P=set)/)?(?P<speaker>p\d+)_\d+\.\w+"
    ),
    "LibriSpeech or LibriTTS": (
        r"(?P<split>train|dev|test)-(clean|other)(-\d+)?/(?P<speaker>\d+)/\d+/[^/]+"
    ),
    "TIMIT": r"(?P<split>train|test)/dr\d/(?P<speaker>\w+)/[^/]+",
    "folders clean and noisy in train, valid, test": (
        rf"{LEVELS['split']}/{LEVELS['condition']}/({LEVELS['speaker']}/(.*/)?)?[^/]+"
    ),
    "folders train, valid, test": rf"{LEVELS['split']}/({LEVELS['speaker']}/(.*/)?)?[^/]+",
}
"""Patterns of paths of audio files, in any case. Files of a pair differ in ``condition``; all have one ``version``."""

WAYS_OUT = (
    "correct the corpus, or give a CSV file with the columns path, noisy, speaker and split instead of it, or say what "
    "its folders are, such as --folders split/speaker, or --folders split if the speakers are unknown"
)

_UNSUPPORTED = {
    re.compile(r"(^|/)mix_(clean|both|single)/"): (
        "this looks like LibriMix, whose s1 would be the column path and mix_single the column noisy"
    ),
    re.compile(r"(^|/)clean_fileid_\d+\."): (
        "this looks like the DNS challenge, whose clean_fileid_N would be the column path and the noisy file of the same "
        "number the column noisy"
    ),
}


@dataclass(frozen=True)
class Corpus:
    """Utterances that were found in a folder, and the files that were not used.

    Attributes:
        layout: name of the layout that was recognised.
        utterances: rows of the manifest.
        unused_audio: number of audio files that are in no row, by folder.
        other_files: number of files that are not audio, by extension.
    """

    layout: str
    utterances: Sequence[Utterance]
    unused_audio: Counter[str]
    other_files: Counter[str]

    def to_text(self) -> str:
        """A table of the splits, and what was passed over."""
        lines = [f"layout: {self.layout}", "split  speakers  utterances  pairs"]
        for split in SPLITS:
            rows = [row for row in self.utterances if row.split == split]
            speakers = {row.speaker for row in rows}
            known = "unknown" if "" in speakers else str(len(speakers))
            pairs = sum(bool(row.noisy) for row in rows)
            if rows:
                lines.append(f"{split:<5}  {known:>8}  {len(rows):>10}  {pairs:>5}")
        for folder, count in sorted(self.unused_audio.items()):
            lines.append(f"passed over: {count} audio files in {folder}")
        for extension, count in sorted(self.other_files.items()):
            lines.append(f"passed over: {count} other files, {extension}")
        return "\n".join(lines)


def prepare(
    source: str | Path,
    out: str | Path,
    *,
    folders: Sequence[str] | None = None,
    valid_share: float = 0.0,
) -> Corpus:
    """Recognise a corpus and write its manifest.

    Args:
        source: folder of a known layout, or a CSV file as ``read_manifest`` takes it.
        out: CSV file to write. Its paths are relative to the source folder, or to the folder of the CSV file.
        folders: meaning of each level of folders, instead of a known layout: ``split``, ``speaker``, ``condition``
            (``clean`` and ``noisy``), or ``other``.
        valid_share: share of the training speakers to validate on, for a corpus without a validation split.

    Raises:
        ValueError: the layout is not recognised, or contradicts itself, or the manifest cannot be written.
    """
    path = Path(source)
    if Path(out).suffix != ".csv":
        raise ValueError(f"{out}: the manifest is a CSV file; choose a name that ends in .csv")
    if path.is_dir():
        corpus = find_corpus(path, folders)
    else:
        if Path(out).exists() and path.samefile(out):
            raise ValueError(f"{out}: is the table that is read; choose another name to write")
        corpus = Corpus("CSV file", read_manifest(path), Counter(), Counter())
    utterances = corpus.utterances
    if valid_share:
        utterances = hold_out_speakers(utterances, valid_share)
    write_manifest(out, utterances)
    return replace(corpus, utterances=utterances)


def find_corpus(root: Path, folders: Sequence[str] | None = None) -> Corpus:
    """List the files of a folder, recognise their layout and check the result; errors as in ``prepare``."""
    audio, others = _list_files(root)
    try:
        layout, utterances = recognise(audio, folders)
        check_utterances(utterances)
        check_paths(utterances, root)
    except ValueError as error:
        raise ValueError(f"{root}: {error}; {WAYS_OUT}") from error
    used = {name for row in utterances for name in (row.path, row.noisy)}
    unused = Counter(
        os.path.dirname(name) or "the top folder" for name in audio if name not in used
    )
    extensions = Counter(Path(name).suffix or "without extension" for name in others)
    return Corpus(layout, utterances, unused, extensions)


def recognise(
    files: Sequence[str], folders: Sequence[str] | None = None
) -> tuple[str, list[Utterance]]:
    """Name of the layout, and its utterances.

    Args:
        files: paths of audio files relative to the corpus, with forward slashes.
        folders: see ``prepare``.

    Raises:
        ValueError: the files have no known layout, or one that contradicts itself.
    """
    if folders is not None:
        layout = f"folders {'/'.join(folders)}"
        meanings = [level for level in folders if level != "other"]
        if not set(folders) <= set(LEVELS) or len(set(meanings)) < len(meanings):
            raise ValueError(f"{layout}; write {', '.join(LEVELS)}, with / between, each once")
        pattern = "/".join(LEVELS[level] for level in folders) + "/(.*/)?[^/]+"
        return layout, _read(files, pattern, layout)
    for unsupported, advice in _UNSUPPORTED.items():
        if any(unsupported.search(file) for file in files):
            raise ValueError(advice)
    top = {file.split("/")[0] for file in files}
    only_folder = f"({re.escape(top.pop())}/)?" if len(top) == 1 else ""
    for layout, pattern in LAYOUTS.items():
        pattern = only_folder + pattern
        if any(re.fullmatch(pattern, file, re.IGNORECASE) for file in files):
            return layout, _read(files, pattern, layout)
    raise ValueError(f"its layout is none of {', '.join(LAYOUTS)}")


def hold_out_speakers(utterances: Sequence[Utterance], share: float) -> list[Utterance]:
    """Move a share of the training speakers, at least one, to the validation split; always the same ones.

    Raises:
        ValueError: there is a validation split already, or a speaker is unknown, or none would be left to train with.
    """
    speakers = sorted({row.speaker for row in utterances if row.split == "train"})
    if any(row.split == "valid" for row in utterances):
        raise ValueError("the corpus has a validation split already; leave --valid-share out")
    if "" in speakers:
        raise ValueError(f"--valid-share needs speakers, and some are unknown; {WAYS_OUT}")
    count = max(1, round(share * len(speakers)))
    if count >= len(speakers):
        raise ValueError(
            f"{count} of {len(speakers)} speakers to validate on would leave none to train with"
        )
    held_out = set(Random(0).sample(speakers, count))
    return [
        replace(row, split="valid") if row.speaker in held_out and row.split == "train" else row
        for row in utterances
    ]


def _read(files: Sequence[str], pattern: str, layout: str) -> list[Utterance]:
    """Utterances of files whose paths all have the pattern of a layout."""
    clean: dict[str, Utterance] = {}
    noisy: dict[str, str] = {}
    names: dict[str, str] = {}
    for file in files:
        match = re.fullmatch(pattern, file, re.IGNORECASE)
        if match is None:
            raise ValueError(f"{file} does not fit the layout {layout!r}")
        groups = match.groupdict(default="")
        split_name = groups.get("split", "train")
        split = _SPLIT_OF[split_name.lower()]
        for kind, name in ((split, split_name), ("version", groups.get("version", ""))):
            if names.setdefault(kind, name) != name:
                raise ValueError(
                    f"{file}: two names for one part of the corpus, {names[kind]!r} and {name!r}"
                )
        key = os.path.splitext(file)[0]
        for group in ("doubled", "condition"):  # the later part of the path first
            if groups.get(group):
                key = key[: match.start(group)] + key[match.end(group) :]
        condition = groups.get("condition", "clean").lower()
        if condition == "clean":
            clean[key] = Utterance(file, "", groups.get("speaker", ""), split)
        elif condition == "noisy":
            noisy[key] = file
    unpaired = sorted(set(clean) ^ set(noisy))
    if "(?P<condition>" in pattern and unpaired:
        first = noisy.get(unpaired[0]) or clean[unpaired[0]].path
        raise ValueError(
            f"{len(unpaired)} files have no counterpart of the same name in clean or noisy speech, the first {first}"
        )
    return [replace(row, noisy=noisy.get(key, "")) for key, row in clean.items()]


def _list_files(root: Path) -> tuple[list[str], list[str]]:
    """Sorted relative paths of the audio files below a folder, and of all other files, without hidden ones.

    Raises:
        ValueError: there is no audio, or a folder is a link.
    """
    audio: list[str] = []
    others: list[str] = []
    for path in sorted(root.rglob("*")):
        name = path.relative_to(root).as_posix()
        is_hidden = any(part.startswith(".") for part in name.split("/"))
        if is_hidden:
            continue
        if path.is_dir():
            if path.is_symlink():
                raise ValueError(f"{path}: a link to a folder; put the folder itself there")
            continue
        is_audio = path.suffix.lower() in EXTENSIONS
        (audio if is_audio else others).append(name)
    if not audio:
        raise ValueError(f"{root}: no audio in it; looked for {', '.join(EXTENSIONS)}")
    return audio, others
