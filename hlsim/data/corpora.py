"""Utterances of a corpus: VoiceBank-DEMAND's published layout, LibriSpeech's, or any folder with an optional CSV file.

Each layout is a generator that never holds the whole corpus.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Literal

from hlsim.data.manifest import SPLITS, Utterance, inside, printable, storable
from hlsim.files import EXTENSIONS, read_rows

Layout = Literal["auto", "voicebank-demand", "librispeech", "folder"]

_VOICEBANK = (("trainset_28spk", "train"), ("trainset_56spk", "train"), ("testset", "test"))
_LIBRISPEECH = {"train": "train", "dev": "valid", "test": "test"}
SPLIT_FOLDERS = {"train": "train", "valid": "valid", "dev": "valid", "test": "test"}


@dataclass(frozen=True, slots=True)
class Fault:
    """A file that is left out, and why."""

    path: str
    reason: str


Found = Utterance | Fault

BAD_NAME = "its name is not UTF-8 or has a line break in it; rename it"


def detect_layout(corpus: Path) -> Layout:
    """Which layout a folder has. Raises ValueError where there is no such folder."""
    if not corpus.is_dir():
        raise ValueError(f"{corpus}: no such folder")
    if any((corpus / f"clean_{name}_wav").is_dir() for name, _ in _VOICEBANK):
        return "voicebank-demand"
    return "librispeech" if _librispeech_parts(corpus) else "folder"


def find_utterances(corpus: Path, layout: Layout, table: Path | None = None) -> Iterator[Found]:
    """Utterances with paths below ``corpus``, and what is at fault; split is empty where the corpus does not say.

    Args:
        layout: the corpus's.
        table: CSV file with a column ``file`` (path below the corpus) and any of ``id``, ``speaker``, ``split``,
            ``noisy``, ``noise``, ``snr``; then only what it lists is taken.

    Raises:
        ValueError: the table cannot be read or holds what it cannot.
    """
    if table is not None:
        return _listed(corpus, table)
    layouts = {"voicebank-demand": _voicebank, "librispeech": _librispeech, "folder": _folder}
    return _named_once(layouts[layout](corpus))


def assign_splits(
    speakers: dict[str, set[str]], *, test_share: float, valid_share: float, seed: int
) -> dict[str, str]:
    """The split of every speaker.

    Where the corpus gives no split at all, ``test_share`` of the speakers are for test; ``valid_share`` of those to
    train with are for validation. Both are drawn from the seed; at least one speaker each, where the share is not 0 and
    another remains to train with.

    Args:
        speakers: the splits in which the corpus has each; "" where it does not say.

    Raises:
        ValueError: a speaker is in two splits.
    """
    for speaker, splits in sorted(speakers.items()):
        if len(splits - {""}) > 1:
            raise ValueError(
                f"speaker {speaker} is in {' and '.join(sorted(splits - {''}))}; allowed: one split a speaker "
                "(a --table with a column speaker or split says otherwise)"
            )
    assigned = {speaker: max(splits) or "train" for speaker, splits in speakers.items()}
    given = any(splits != {""} for splits in speakers.values())
    for split, share in (("test", 0.0 if given else test_share), ("valid", valid_share)):
        training = sorted(speaker for speaker, given_to in assigned.items() if given_to == "train")
        count = (
            min(max(1, round(share * len(training))), len(training) - 1)
            if share and training
            else 0
        )
        for speaker in Random(f"{seed}:{split}").sample(training, count):
            assigned[speaker] = split
    return assigned


def _stem(path: str) -> str:
    return path.removesuffix(Path(path).suffix)


def _unknown(split: str) -> str:
    """A speaker: what the corpus has in two splits cannot be one."""
    return f"unknown {split}".rstrip()


def walk_audio(folder: Path) -> Iterator[str]:
    """Paths of wav, flac and ogg files below a folder in POSIX form, folder by folder in order of names."""
    for place, _, names in _walk(folder):
        for name in names:
            if Path(name).suffix.lower() in EXTENSIONS:
                yield (Path(place).relative_to(folder) / name).as_posix()


def _walk(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """As ``os.walk``, in order of names and without hidden ones."""
    for place, folders, names in os.walk(folder):
        for found in (folders, names):
            found[:] = sorted(name for name in found if not name.startswith("."))
        yield place, folders, names


def linked_folders(folder: Path, prefix: str = "") -> Iterator[Fault]:
    """The links to folders below a folder, which ``walk_audio`` does not follow."""
    for place, folders, _ in _walk(folder):
        for path in (Path(place, name) for name in folders):
            if path.is_symlink():
                name = (prefix / path.relative_to(folder)).as_posix()
                yield Fault(name, "a link to a folder; put the folder itself there")


def _named_once(found: Iterator[Found]) -> Iterator[Found]:
    """With a fault for a file whose folder has had its name already, with another ending."""
    folder, names = "", set[str]()
    for one in found:
        if isinstance(one, Utterance):
            place, _, name = _stem(one.clean).rpartition("/")
            if place != folder:
                folder, names = place, set()
            if name in names:
                one = Fault(one.clean, f"a second file of the name {one.id}")
            names.add(name)
        yield one


def _voicebank(corpus: Path) -> Iterator[Found]:
    """``clean_trainset_28spk_wav/p226_001.wav`` and so on; ``log_trainset_28spk.txt`` tells noise and SNR."""
    for name, split in _VOICEBANK:
        clean, noisy = f"clean_{name}_wav", f"noisy_{name}_wav"
        if not (corpus / clean).is_dir():
            continue
        noises = _voicebank_log(corpus, name)
        for path in walk_audio(corpus / clean):
            if not (corpus / noisy / path).is_file():
                yield Fault(f"{clean}/{path}", f"no noisy counterpart {noisy}/{path}")
                continue
            key = Path(path).stem
            noise = noises.get(key, ("", None))
            yield Utterance(
                key, key.split("_")[0], split, f"{clean}/{path}", f"{noisy}/{path}", *noise
            )
        for path in walk_audio(corpus / noisy):
            if not (corpus / clean / path).is_file():
                yield Fault(f"{noisy}/{path}", f"no clean counterpart {clean}/{path}")
        for side in (clean, noisy):
            yield from linked_folders(corpus / side, side)


def _voicebank_log(corpus: Path, name: str) -> dict[str, tuple[str, float | None]]:
    """Noise and SNR by utterance: lines such as ``p226_001 office 15``."""
    noises: dict[str, tuple[str, float | None]] = {}
    for place in (corpus / f"log_{name}.txt", corpus / "logfiles" / f"log_{name}.txt"):
        if place.is_file():
            for line in place.read_text(encoding="utf-8", errors="replace").splitlines():
                parts = line.split()
                if len(parts) == 3:
                    noises[parts[0]] = (parts[1], None)
                    with suppress(ValueError):
                        noises[parts[0]] = (parts[1], float(parts[2]))
    return noises


def _librispeech_parts(corpus: Path) -> list[tuple[str, str]]:
    """Folders such as ``train-clean-100`` with the split of each."""
    inner = "LibriSpeech/" if (corpus / "LibriSpeech").is_dir() else ""
    heads = {
        path: path.name.partition("-")[0]
        for path in sorted((corpus / inner).glob("*-*"))
        if path.is_dir()
    }
    return [
        (inner + path.name, _LIBRISPEECH[head])
        for path, head in heads.items()
        if head in _LIBRISPEECH
    ]


def _librispeech(corpus: Path) -> Iterator[Found]:
    """``train-clean-100/<speaker>/<chapter>/<speaker>-<chapter>-<number>.flac`` and so on."""
    for part, split in _librispeech_parts(corpus):
        for path in walk_audio(corpus / part):
            key = Path(path).stem
            yield Utterance(key, key.split("-")[0], split, f"{part}/{path}")
        yield from linked_folders(corpus / part, part)


def _folder(corpus: Path) -> Iterator[Found]:
    """Any folder: the speaker is the folder that holds a file; a folder train, valid, dev or test on top is the split.

    Where a folder ``clean`` has a neighbour ``noisy``, files of equal names in them are pairs.
    """
    for path in walk_audio(corpus):
        *folders, name = path.split("/")
        split = SPLIT_FOLDERS.get("".join(folders[:1]), "")
        for side, other in (("clean", "noisy"), ("noisy", "clean")):
            place = folders.index(side) if side in folders else -1
            if place >= 0 and corpus.joinpath(*folders[:place], other).is_dir():
                counterpart = "/".join([*folders[:place], other, *folders[place + 1 :], name])
                break
        else:
            side, counterpart, place = "", "", -1
        if counterpart and not (corpus / counterpart).is_file():
            yield Fault(path, f"no {other} counterpart {counterpart}")
        elif side != "noisy":
            passed = {place, 0 if split else place}
            speaker = "/".join(part for i, part in enumerate(folders) if i not in passed)
            yield Utterance(_stem(path), speaker or _unknown(split), split, path, counterpart)
    yield from linked_folders(corpus)


def _listed(corpus: Path, table: Path) -> Iterator[Found]:
    """What a CSV file lists."""
    seen: set[str] = set()
    try:
        for number, row in read_rows(table):
            path, where = row.get("file", ""), f"{table}, line {number}"
            if not path:
                raise ValueError(f"{where}: no file named; needs a column 'file' with a path a row")
            if row.get("split", "") not in ("", *SPLITS):
                raise ValueError(
                    f"{where}: split {row['split']!r}; allowed: {', '.join(SPLITS)}, or none"
                )
            key = row.get("id") or _stem(path)
            try:
                snr = float(row["snr"]) if row.get("snr") else None
            except ValueError:
                raise ValueError(f"{where}: snr {row['snr']!r}; allowed: a number of dB") from None
            if key in seen:
                raise ValueError(f"{where}: a second row of {key}; allowed: one row an utterance")
            seen.add(key)
            split, noisy = row.get("split", ""), row.get("noisy", "")
            for name in filter(None, (path, noisy)):
                inside(corpus, name)
            speaker = row.get("speaker") or path.rpartition("/")[0] or _unknown(split)
            noise = (noisy, row.get("noise", ""), snr) if noisy else ()
            yield Utterance(key, speaker, split, path, *noise)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{table}: cannot be read as CSV ({error})") from error


def find_below(
    root: Path, corpus: str, layout: Layout, table: Path | None = None, noise: str | None = None
) -> Iterator[Found]:
    """As ``find_utterances`` of ``root / corpus``, with paths below the root, and without what is in the folder noise.

    What has a name that does not fit a CSV file is a fault, with a name that does.
    """
    prefix = f"{corpus}/" if corpus else ""
    for found in find_utterances(root / corpus, layout, table):
        path = prefix + (found.path if isinstance(found, Fault) else found.clean)
        if noise is not None and path.startswith(f"{noise}/"):
            continue
        if isinstance(found, Fault):
            fits = storable(path) and storable(found.reason)
            yield (
                Fault(path, found.reason)
                if fits
                else Fault(printable(path), printable(found.reason))
            )
            continue
        noisy = found.noisy and prefix + found.noisy
        wrong = [Fault(printable(name), BAD_NAME) for name in (path, noisy) if not storable(name)]
        yield wrong[0] if wrong else replace(found, clean=path, noisy=noisy)
