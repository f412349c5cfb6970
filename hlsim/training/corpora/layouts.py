"""Corpora of known layouts, turned into manifests.

A layout is recognised by the names of folders and files alone. What does not fit a layout exactly is rejected.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

from hlsim.audio import check_name
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
LEVELS = ("split", "speaker", "condition", "other")
"""Meanings that a level of folders can have."""

WAYS_OUT = (
    "remove what does not belong to the corpus and complete what does, or list the files in a CSV file with the columns "
    "path, noisy, speaker and split and give that instead of the folder, or say what the folders are, such as --folders "
    "split/speaker, or --folders split if the speakers are unknown"
)

_SPLIT_OF = {name: split for split, names in SPLIT_NAMES.items() for name in names}
_VOICEBANK_FOLDER = re.compile(r"(clean|noisy)_((train|test)set(_28spk|_56spk)?)_wav(_16k|_48k)?")
_VOICEBANK_FILE = re.compile(r"(p\d+)_\d+")
_LIBRISPEECH_FILE = re.compile(r"(train|dev|test)-(clean|other)(-\d+)?/(\d+)/\d+/[^/]+")
_TIMIT_REGION = re.compile(r"dr\d")
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
        if not set(folders) <= set(LEVELS):
            raise ValueError(
                f"folders {'/'.join(folders)}; write {', '.join(LEVELS)}, with / between"
            )
        return f"folders {'/'.join(folders)}", _read_folders(files, folders)
    for pattern, advice in _UNSUPPORTED.items():
        if any(pattern.search(file) for file in files):
            raise ValueError(advice)
    top = _names(files, 0)
    prefixes = ["", f"{top[0]}/"] if len(top) == 1 else [""]
    for prefix in prefixes:
        inner = [file.removeprefix(prefix) for file in files]
        for layout, read in LAYOUTS.items():
            if utterances := read(inner):
                return layout, [_below(prefix, row) for row in utterances]
    raise ValueError(f"its layout is none of {', '.join(LAYOUTS)}")


def read_voicebank(files: Sequence[str]) -> list[Utterance]:
    """VoiceBank-DEMAND: ``clean_trainset_28spk_wav/p226_001.wav`` and so on; empty for another layout."""
    matches = {name: _VOICEBANK_FOLDER.fullmatch(name) for name in _names(files, 0)}
    if not any(matches.values()):
        return []
    folders: dict[tuple[str, str], str] = {}
    for name, match in matches.items():
        if match is None or (match[2], match[1]) in folders:
            raise ValueError(
                f"the folder {name} does not belong to VoiceBank-DEMAND, or is a second version of one set"
            )
        folders[match[2], match[1]] = name
    utterances = []
    for part in sorted({part for part, _ in folders}):
        clean, noisy = (
            _files_by_stem(files, folders.get((part, kind))) for kind in ("clean", "noisy")
        )
        _check_pairs(clean, noisy, part)
        split = part.partition("set")[0]
        for stem, path in clean.items():
            match = _VOICEBANK_FILE.fullmatch(stem)
            if match is None:
                raise ValueError(f"{path} has no name such as p226_001.wav")
            utterances.append(Utterance(path, noisy[stem], match[1], split))
    return utterances


def read_librispeech(files: Sequence[str]) -> list[Utterance]:
    """LibriSpeech and LibriTTS: ``train-clean-100/SPEAKER/CHAPTER/NAME``; empty for another layout."""
    matches = [_LIBRISPEECH_FILE.fullmatch(file) for file in files]
    if not any(matches):
        return []
    utterances = []
    for file, match in zip(files, matches, strict=True):
        if match is None:
            raise ValueError(f"{file} is not where LibriSpeech and LibriTTS have files")
        utterances.append(Utterance(file, "", match[4], _SPLIT_OF[match[1]]))
    return utterances


def read_split_folders(files: Sequence[str]) -> list[Utterance]:
    """Folders ``train``, ``valid`` and ``test``, with speakers, or ``clean`` and ``noisy``, below them; empty for another
    layout."""
    if not any(name.lower() in _SPLIT_OF for name in _names(files, 0)):
        return []
    below = {name.lower() for name in _names(files, 1)}
    if below & {"clean", "noisy"}:
        return _read_folders(files, ("split", "condition", "speaker"), optional=1)
    if below and all(map(_TIMIT_REGION.fullmatch, below)):
        return _read_folders(files, ("split", "other", "speaker"))
    return _read_folders(files, ("split", "speaker"), optional=1)


LAYOUTS = {
    "VoiceBank-DEMAND": read_voicebank,
    "LibriSpeech or LibriTTS": read_librispeech,
    "folders train, valid, test": read_split_folders,
}


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


def _read_folders(
    files: Sequence[str], levels: Sequence[str], optional: int = 0
) -> list[Utterance]:
    """Utterances of files whose first folders have the meanings ``levels``, the last ``optional`` of which may lack."""
    required = len(levels) - optional
    split_names: dict[str, str] = {}
    clean: dict[str, Utterance] = {}
    noisy: dict[str, str] = {}
    for file in files:
        folders = file.split("/")[:-1]
        if len(folders) < required:
            raise ValueError(f"{file} is not in folders {'/'.join(levels[:required])}")
        meaning = dict(zip(levels, folders, strict=False))
        split = "train"
        if "split" in levels:
            name = meaning["split"]
            split = _SPLIT_OF.get(name.lower(), "")
            if split_names.setdefault(split, name) != name or not split:
                raise ValueError(
                    f"the folder {name} is no split, or a second folder for the same split"
                )
        row = Utterance(file, "", meaning.get("speaker", ""), split)
        if "condition" not in levels:
            clean[file] = row
            continue
        level = list(levels).index("condition")
        condition = folders.pop(level)
        key = "/".join([*folders, Path(file).stem])
        if condition.lower() == "clean":
            clean[key] = row
        elif condition.lower() == "noisy":
            noisy[key] = file
        elif condition.lower() not in ("noise", "noises"):
            raise ValueError(f"the folder {condition} is neither clean nor noisy nor noise")
    if "condition" in levels:
        _check_pairs(clean, noisy, "the corpus")
    return [replace(row, noisy=noisy.get(key, "")) for key, row in clean.items()]


def _check_pairs(clean: Iterable[str], noisy: Iterable[str], place: str) -> None:
    unpaired = sorted(set(clean) ^ set(noisy))
    if unpaired:
        raise ValueError(
            f"{place}: {len(unpaired)} files are in clean or in noisy speech only, the first {unpaired[0]}"
        )


def _files_by_stem(files: Sequence[str], folder: str | None) -> dict[str, str]:
    """Files in a folder, or in a folder of the same name in it, by their names without extension."""
    places = (folder, f"{folder}/{folder}")
    return {Path(file).stem: file for file in files if os.path.dirname(file) in places}


def _names(files: Sequence[str], level: int) -> list[str]:
    """Sorted names of the folders at a level."""
    parts = (file.split("/")[:-1] for file in files)
    return sorted({folders[level] for folders in parts if len(folders) > level})


def _below(prefix: str, row: Utterance) -> Utterance:
    return replace(row, path=prefix + row.path, noisy=row.noisy and prefix + row.noisy)


def _list_files(root: Path) -> tuple[list[str], list[str]]:
    """Sorted relative paths of the audio files below a folder, and of all other files, without hidden ones.

    Raises:
        ValueError: there is no audio, a folder is a link, or a name is not UTF-8.
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
        check_name(path)
        is_audio = path.suffix.lower() in EXTENSIONS
        (audio if is_audio else others).append(name)
    if not audio:
        raise ValueError(f"{root}: no audio in it; looked for {', '.join(EXTENSIONS)}")
    return audio, others
