"""Corpora of known layouts, from which manifests are made.

A layout is recognised by the names of folders and files. Corpora that deviate from it are rejected.
"""

import os
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

from hlsim.audio import find_audio
from hlsim.data.manifest import (
    FILE_SEPARATOR,
    SPLITS,
    Utterance,
    check_utterances,
    read_manifest,
    write_manifest,
)

_SPLIT_NAMES = {
    "train": ("train", "training", "tr"),
    "valid": ("valid", "validation", "val", "dev", "cv", "eval"),
    "test": ("test", "testing", "tt"),
}
"""Names that the folder of each split may have."""

_SPLIT_OF = {name: split for split, names in _SPLIT_NAMES.items() for name in names}

_LEVELS = {
    "split": rf"(?P<split>{'|'.join(_SPLIT_OF)})",
    "speaker": r"(?P<speaker>[^/]+)",
    "condition": r"(?P<condition>clean|noisy|noises?)",
    "other": r"[^/]+",
}
"""Meanings that a level of folders can have, each with a pattern of the folders' names."""

_LAYOUTS = {
    "VoiceBank-DEMAND": (
        r"(?P<condition>clean|noisy)_(?P<split>train|test)set(_28spk|_56spk)?_wav"
        r"(?P<rate>_16k|_48k)?/(?P<speaker>p\d+)_\d+\.\w+"
    ),
    "LibriSpeech or LibriTTS": (
        r"(?P<split>train|dev|test)-(clean|other)(-\d+)?/(?P<speaker>\d+)/\d+/[^/]+"
    ),
    "folders clean and noisy in train, valid, test": (
        rf"{_LEVELS['split']}/{_LEVELS['condition']}/({_LEVELS['speaker']}/(.*/)?)?[^/]+"
    ),
    "folders train, valid, test": rf"{_LEVELS['split']}/({_LEVELS['speaker']}/(.*/)?)?[^/]+",
}
"""Patterns of the paths of audio files by layout, ignoring case.

The two files of a pair differ in the group ``condition``.
"""

CLARITY_REFERENCES = ("_target_anechoic_CH1.wav", "_target_anechoic.wav", "_reference.wav")
"""Ends of the names of the clean speech in Clarity's scenes.

The first two have the target without its room, and its level in the room is that of another file.
"""

_CLARITY = "scenes of the Clarity challenges"
"""Name of the layout of ``_read_clarity_scenes``."""

_CLARITY_MIXTURE = re.compile(r"(?P<scene>.+)_(mix|mixed)_CH(?P<microphone>[1-9])\.wav")
"""Pattern of the path of a file with the signals of a microphone at both ears."""

_CLARITY_SPLITS = {"train": "train", "dev": "valid", "eval": "test"}
"""Splits of Clarity's scenes by the names of folders."""

_ADVICE = (
    "correct the corpus, or use a CSV file with the columns path, noisy, speaker and split "
    "instead, or name the levels of folders, such as --folders split/speaker, or --folders split "
    "if the speakers are unknown"
)
"""Advice on corpora that are rejected."""


def prepare(
    source: str | Path,
    out: str | Path,
    *,
    folders: Sequence[str] | None = None,
    valid_share: float = 0.0,
    microphones: Sequence[int] = (),
) -> str:
    """Recognise a corpus and write its manifest, the CSV file that training runs read.

    Args:
        source: Folder of a known layout, or a CSV file, see ``read_manifest``.
        out: CSV file to write. Its paths are relative to the folder of the corpus, or to that of
            the CSV file.
        folders: Meaning of each level of folders, see ``recognise``.
        valid_share: Share of the training speakers that are moved to the validation split, which
            the corpus must not have; 0 moves none.
        microphones: Numbers of the microphones that are used of Clarity's scenes, the reference
            first; by default all.

    Returns:
        Text to print: the name of the layout, a table of the splits and, if files of noise were
        left out, their number and one of them.

    Raises:
        ValueError: The layout is unknown or contradictory, the CSV file is not a manifest, levels
            of folders are named for a CSV file, a scene lacks one of the microphones, a microphone
            is named twice, the share is not from 0 to below 1 or cannot be moved (see
            ``hold_out_speakers``), or the manifest cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     for name in ("ann", "bob"):
    ...         Path(folder, "train", name).mkdir(parents=True)
    ...         Path(folder, "train", name, "1.wav").touch()
    ...     print(prepare(folder, f"{folder}/manifest.csv", valid_share=0.5))
    layout: folders train, valid, test
    split  speakers  utterances  pairs
    train         1           1      0
    valid         1           1      0
    """
    noise_files = []
    if Path(source).is_dir():
        layout, utterances = find_corpus(source, folders)
        listed_files = {file for row in utterances for file in (row.path, row.noisy)}
        if layout != _CLARITY:
            noise_files = [file for file in _relative_files(source) if file not in listed_files]
    elif folders is None:
        layout, utterances = "CSV file", read_manifest(source)
    else:
        raise ValueError(
            f"{source}: expected a folder, because levels of folders are named; leave them out "
            "(--folders), or pass the folder"
        )
    if microphones:
        utterances = [_choose_microphones(row, microphones) for row in utterances]
        check_utterances(utterances)
    if valid_share:
        utterances = hold_out_speakers(utterances, valid_share)
    write_manifest(out, utterances)
    lines = [f"layout: {layout}", "split  speakers  utterances  pairs"]
    for split in SPLITS:
        rows = [row for row in utterances if row.split == split]
        speakers = {row.speaker.casefold() for row in rows}
        speaker_count = "unknown" if "" in speakers else len(speakers)
        pairs = sum(bool(row.noisy) for row in rows)
        if rows:
            lines.append(f"{split:<5}  {speaker_count:>8}  {len(rows):>10}  {pairs:>5}")
    if noise_files:
        lines.append(f"left out: {len(noise_files)} files of noise, such as {noise_files[0]}")
    return "\n".join(lines)


def find_corpus(
    root: str | Path, folders: Sequence[str] | None = None
) -> tuple[str, list[Utterance]]:
    """Recognise the layout of a folder, and list its utterances, without reading audio.

    Args:
        root: Folder of the corpus.
        folders: Meaning of each level of folders, see ``recognise``.

    Returns:
        The name of the layout, and the utterances.

    Raises:
        ValueError: The folder does not exist or contains no audio, the layout is unknown or
            contradictory, or the utterances contradict each other, see ``check_utterances``.

    >>> from hlsim.data.bundled import SPEECH
    >>> layout, utterances = find_corpus(SPEECH)
    >>> layout
    'folders train, valid, test'
    """
    try:
        layout, utterances = recognise(_relative_files(root), folders)
        check_utterances(utterances)
    except ValueError as error:
        raise ValueError(f"{root}: {error}; {_ADVICE}") from error
    return layout, utterances


def _relative_files(root: str | Path) -> list[str]:
    """Return the paths of the audio files in a folder, relative to it, with forward slashes."""
    return [path.relative_to(root).as_posix() for path in find_audio(root)]


def recognise(
    files: Sequence[str], folders: Sequence[str] | None = None
) -> tuple[str, list[Utterance]]:
    """Recognise the layout of a corpus by the paths of its files, without reading them.

    Args:
        files: Paths of audio files relative to the corpus, with forward slashes.
        folders: Meaning of each level of folders, the top first, instead of a known layout:
            ``split``, ``speaker``, ``condition`` (``clean``, ``noisy``, or ``noise``, which is
            left out), or ``other``.

    Returns:
        The name of the layout, and the utterance of each clean file.

    Raises:
        ValueError: The layout is unknown or contradictory, or ``folders`` has an unknown meaning,
            or twice the same except ``other``.

    >>> layout, utterances = recognise(["ann/1.wav", "bob/1.wav"], folders=["speaker"])
    >>> [row.speaker for row in utterances]
    ['ann', 'bob']
    """
    if folders is not None:
        layout = f"folders {'/'.join(folders)}"
        meanings = [level for level in folders if level != "other"]
        if not _LEVELS.keys() >= set(folders) or len(set(meanings)) < len(meanings):
            raise ValueError(
                f"{layout}: expected each of {', '.join(_LEVELS)} once at most, or other several "
                "times, separated by /; write, for example, --folders split/speaker"
            )
        pattern = "/".join(_LEVELS[level] for level in folders) + "/(.*/)?[^/]+"
        return layout, _read_utterances(files, pattern, layout)
    if any(map(_CLARITY_MIXTURE.fullmatch, files)):
        return _CLARITY, _read_clarity_scenes(files)
    top = {file.split("/")[0] for file in files}
    only_folder = f"({re.escape(top.pop())}/)?" if len(top) == 1 else ""
    for layout, pattern in _LAYOUTS.items():
        pattern = only_folder + pattern
        if any(re.fullmatch(pattern, file, re.IGNORECASE) for file in files):
            return layout, _read_utterances(files, pattern, layout)
    raise ValueError(f"unknown layout, expected one of {', '.join((*_LAYOUTS, _CLARITY))}")


def hold_out_speakers(utterances: Sequence[Utterance], share: float) -> list[Utterance]:
    """Move some training speakers to the validation split.

    The speakers are random, but the same in every call.

    Args:
        utterances: Rows of a manifest.
        share: Share of the training speakers to move, above 0 and below 1. At least one is moved.

    Returns:
        New rows in the same order; the rows that were passed do not change.

    Raises:
        ValueError: The share is not between 0 and 1, there is a validation split already, a
            training speaker is unknown, or none would remain.

    >>> rows = [Utterance("ann/1.wav", speaker="ann"), Utterance("bob/1.wav", speaker="bob")]
    >>> [row.split for row in hold_out_speakers(rows, 0.5)]
    ['train', 'valid']
    """
    if not 0.0 < share < 1.0:
        raise ValueError(f"expected a share between 0 and 1 (--valid-share), got {share}")
    if any(row.split == "valid" for row in utterances):
        raise ValueError("the corpus has a validation split already; leave --valid-share out")
    speakers = sorted({row.speaker.casefold() for row in utterances if row.split == "train"})
    count = max(1, round(share * len(speakers)))
    if "" in speakers or count >= len(speakers):
        raise ValueError(
            f"cannot move {count} of {len(speakers)} training speakers to the validation split, "
            "because the speaker of some utterances is unknown, or none would remain; lower "
            f"--valid-share, or {_ADVICE}"
        )
    valid_speakers = set(Random(0).sample(speakers, count))
    rows = []
    for row in utterances:
        is_moved = row.split == "train" and row.speaker.casefold() in valid_speakers
        rows.append(replace(row, split="valid") if is_moved else row)
    return rows


def _read_clarity_scenes(files: Sequence[str]) -> list[Utterance]:
    """Convert the paths of Clarity's scenes to utterances, one per scene.

    The clean speech is the anechoic target. The files of all microphones are the noisy recording,
    whose reference is microphone 1 at both ears. Interferers and other files are not used. Scenes
    in a folder ``train``, ``dev`` or ``eval`` are in the split train, valid or test, and others in
    train.

    Raises:
        ValueError: A scene lacks its clean speech or its first microphone, or has two files of a
            microphone.
    """
    known_files = set(files)
    mixtures: dict[str, dict[str, str]] = defaultdict(dict)  # files by scene and microphone
    for file in sorted(files):
        match = _CLARITY_MIXTURE.fullmatch(file)
        if match is None:
            continue
        first = mixtures[match["scene"]].setdefault(match["microphone"], file)
        if first != file:
            raise ValueError(
                f"{first} and {file} are one microphone of one scene; remove one of the two"
            )
    utterances = []
    for scene, by_microphone in mixtures.items():
        microphones = [*by_microphone.values()]
        candidates = [scene + ending for ending in CLARITY_REFERENCES]
        clean = next((path for path in candidates if path in known_files), None)
        if clean is None or not microphones[0].endswith("_CH1.wav"):
            raise ValueError(
                f"{microphones[0]}: expected a file of microphone 1 (_CH1.wav) and clean speech, "
                f"such as {candidates[0]}"
            )
        splits = [_CLARITY_SPLITS.get(folder.lower()) for folder in scene.split("/")[:-1]]
        split = next(filter(None, splits), "train")
        noisy = FILE_SEPARATOR.join(microphones)
        utterances.append(Utterance(clean, noisy, split=split, reference="1 2"))
    return utterances


def _choose_microphones(row: Utterance, numbers: Sequence[int]) -> Utterance:
    """Return a row with some microphones of a scene of Clarity, the first one as the reference.

    Raises:
        ValueError: The row is no such scene, or lacks a microphone.
    """
    matches = [_CLARITY_MIXTURE.fullmatch(file) for file in row.noisy_files]
    files = {int(match["microphone"]): match[0] for match in matches if match}
    if not files.keys() >= set(numbers):
        raise ValueError(
            f"{row.path}: expected microphones {numbers} of a scene of the Clarity challenges, got "
            f"{sorted(files) or 'no such scene'}; correct the numbers, or leave --microphones out"
        )
    return replace(row, noisy=FILE_SEPARATOR.join(files[number] for number in numbers))


def _read_utterances(files: Sequence[str], pattern: str, layout: str) -> list[Utterance]:
    """Convert the paths of files, which must all match the pattern of a layout, to utterances.

    Args:
        files: Paths relative to the corpus, with forward slashes.
        pattern: Regular expression for paths, with named groups as in ``_LAYOUTS``.
        layout: Name of the layout, for messages.

    Returns:
        One utterance per clean file. Files of noise are left out.

    Raises:
        ValueError: A file does not match the pattern, a split has two names or two sample rates,
            two files have the same place in a pair, or, in a layout with pairs, a file lacks its
            counterpart.
    """
    parts: dict[str, dict[str, Utterance]] = {"clean": {}, "noisy": {}}  # by condition and key
    folder_of: dict[str, tuple[str, str]] = {}  # by split, with a file
    for file in files:
        match = re.fullmatch(pattern, file, re.IGNORECASE)
        if match is None:
            raise ValueError(f"{file} does not match the layout {layout!r}")
        groups = match.groupdict(default="")
        key = file
        if "condition" in groups:
            stem = os.path.splitext(file)[0]
            key = stem[: match.start("condition")] + stem[match.end("condition") :]
        condition = groups.get("condition", "clean").lower()
        folder = groups.get("split", "train").lower()
        split = _SPLIT_OF[folder]
        folder += groups.get("rate", "").lower()  # copies of one corpus at two rates
        first_folder, first_file = folder_of.setdefault(split, (folder, file))
        if first_folder != folder:
            raise ValueError(
                f"{first_file} and {file} are in two folders for the split {split}; remove one of "
                "the folders, or rename it, for example to test"
            )
        if condition not in parts:
            continue
        row = Utterance(file, "", groups.get("speaker", ""), split)
        first = parts[condition].setdefault(key, row)
        if first is not row:
            raise ValueError(
                f"{first.path} and {file} belong to one pair, because they differ in their "
                "extension only; rename or remove one of them"
            )
    clean, noisy = parts["clean"], {key: row.path for key, row in parts["noisy"].items()}
    unpaired = sorted(clean.keys() ^ noisy.keys())
    if "(?P<condition>" in pattern and unpaired:
        path = noisy.get(unpaired[0]) or clean[unpaired[0]].path
        raise ValueError(
            f"{len(unpaired)} files of clean or noisy speech lack a counterpart of the same "
            f"name, such as {path}"
        )
    return [replace(row, noisy=noisy.get(key, "")) for key, row in clean.items()]
