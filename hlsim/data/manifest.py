"""Manifests: CSV files that list the utterances of a corpus, with their speakers and splits."""

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from hlsim.files import (
    convert_at,
    csv_text,
    path_below,
    read_table,
    warn_of_unused,
    write_atomically,
)

SPLITS = ("train", "valid", "test")
"""Names of the splits: parts of a corpus for training, validation and test."""

COLUMNS = ("path", "noisy", "speaker", "split", "reference")
"""Columns of a manifest. The last one is written only if an utterance has a reference."""

FILE_SEPARATOR = "|"
"""Text between the files of several microphones in the column ``noisy``."""

_NON_SPEECH_WORDS = {"noise", "noises", "noisy", "mix", "mixture", "mixtures", "rir", "rirs"}
"""Words in the names of folders that contain no clean speech."""


@dataclass(frozen=True)
class Utterance:
    """Row of a manifest: one file of clean speech, usually one sentence.

    Attributes:
        path: Path of the clean speech, relative to the folder of the corpus, with forward slashes.
        noisy: Path of the noisy version, time-aligned and equally long; empty if there is none.
            With ``reference``, also the paths of several files, separated by ``|``, whose channels
            count from the first file to the last.
        speaker: Name of the speaker; empty if unknown.
        split: ``train``, ``valid`` or ``test``.
        reference: Number of the channel of ``noisy``, from 1, whose microphone receives the speech
            as ``path`` has it, if the channels are several microphones; two numbers, such as
            ``1 2``, for the left and the right ear. Then the channels are left and right in turn.

    >>> Utterance("clean/p226_001.wav", speaker="p226").split
    'train'
    """

    path: str
    noisy: str = ""
    speaker: str = ""
    split: str = "train"
    reference: str = ""

    @property
    def noisy_files(self) -> list[str]:
        """Paths of the noisy version, the parts of ``noisy`` between ``|``; none if it is empty."""
        return self.noisy.split(FILE_SEPARATOR) if self.noisy else []

    @property
    def references(self) -> tuple[int, ...]:
        """Numbers in ``reference``.

        Raises:
            ValueError: The text is neither empty nor one number nor two as in ``1 2``.
        """
        texts = self.reference.split()
        numbers = tuple(int(text) for text in texts if text.isdecimal())
        is_pair = len(numbers) == 2 and numbers[0] % 2 == 1 and numbers[1] == numbers[0] + 1
        if len(numbers) < len(texts) or 0 in numbers or not (len(numbers) < 2 or is_pair):
            raise ValueError(
                f"{self.noisy}: expected the number of a channel in the column 'reference', or two "
                f"as in 1 2 or 3 4 for the left and the right ear, got {self.reference!r}"
            )
        return numbers


def read_manifest(path: str | Path, root: str | Path | None = None) -> list[Utterance]:
    """Read and validate a manifest. The returned paths contain no ``.`` and ``..``.

    Args:
        path: CSV file with a column ``path`` and optional columns ``noisy`` (path of the noisy
            version), ``speaker``, ``split`` and ``reference``, see ``Utterance``; their names may
            be in upper or lower case. Without the column ``split``, all utterances are in the split
            ``train``. Other columns cause a warning.
        root: Folder to which the paths are relative; by default the folder of the manifest.

    Raises:
        ValueError: The file is not such a table, a path leads out of the root, the rows contradict
            each other, see ``check_utterances``, or the first file is not in the root.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     Path(folder, "1.wav").touch()
    ...     _ = Path(folder, "manifest.csv").write_text("path,speaker\\n1.wav,ann\\n")
    ...     read_manifest(f"{folder}/manifest.csv")
    [Utterance(path='1.wav', noisy='', speaker='ann', split='train', reference='')]
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
            texts = values[column].split(FILE_SEPARATOR) if values.get(column) else []
            files = [convert_at(place, path_below, folder, text.strip()) for text in texts]
            names = [Path(os.path.relpath(file, folder)).as_posix() for file in files]
            values[column] = FILE_SEPARATOR.join(names)
        utterances.append(Utterance(**values))
    try:
        check_utterances(utterances)
    except ValueError as error:
        raise ValueError(f"{path}: the manifest is not valid: {error}") from error
    if not (folder / utterances[0].path).is_file():
        raise ValueError(
            f"{path}: its first file, {utterances[0].path}, is not in {folder}; move the manifest "
            "to the folder to which the paths are relative, or pass this folder as root (--root)"
        )
    return utterances


def write_manifest(path: str | Path, utterances: Sequence[Utterance]) -> None:
    """Write a manifest atomically, in place of an older manifest of this name.

    The file has the column ``reference`` only if an utterance has a reference.

    Args:
        path: CSV file to write.
        utterances: Rows of the manifest.

    Raises:
        ValueError: The file cannot be written, its name does not end in .csv, or it exists and does
            not begin with the columns of a manifest in this order.

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
    columns = COLUMNS if any(row.reference for row in utterances) else COLUMNS[:-1]
    if target.is_file() and not target.read_bytes().startswith(",".join(COLUMNS[:-1]).encode()):
        raise ValueError(f"{path}: would replace a file that is no manifest; choose another name")
    rows = [astuple(utterance)[: len(columns)] for utterance in utterances]
    write_atomically(path, csv_text([columns, *rows]))


def check_utterances(utterances: Sequence[Utterance]) -> None:
    """Validate the rows of a manifest.

    Args:
        utterances: Rows of the manifest.

    Raises:
        ValueError: There are no rows, a file is both clean and noisy, two rows have the same noisy
            files, or the same clean file and none noisy, a clean file is in a folder of noises,
            mixtures or impulse responses by its name, a clean file or a speaker is in two splits, a
            row names a microphone twice, or a reference is not valid, has no noisy file, is missing
            where there are several noisy files, or names another number of channels than other
            rows.

    >>> check_utterances([Utterance("noise/1.wav")])
    Traceback (most recent call last):
    ValueError: noise/1.wav is listed as clean speech, but is in a folder 'noise'
    """
    if not utterances:
        raise ValueError("there are no utterances, expected one per row")
    clean = {utterance.path for utterance in utterances}
    splits: dict[tuple[str, str], str] = {}
    listed = set()
    ears = {len(utterance.references) for utterance in utterances}
    if len(ears) > 1 or (ears != {0} and not all(utterance.noisy for utterance in utterances)):
        raise ValueError(
            "expected a noisy file and the same number of references (column 'reference') in every "
            "row, or no references; correct the rows"
        )
    for utterance in utterances:
        file = utterance.noisy or utterance.path
        if file in listed:
            raise ValueError(f"{file} is listed twice; remove one of the rows")
        listed.add(file)
        if len({*utterance.noisy_files}) < len(utterance.noisy_files):
            raise ValueError(f"{utterance.noisy}: a microphone is listed twice; remove one of them")
        if len(utterance.noisy_files) > 1 and not utterance.references:
            raise ValueError(
                f"{utterance.noisy}: several noisy files are those of several microphones, and "
                "need the number of the reference (column 'reference'); add it"
            )
        if clean.intersection(utterance.noisy_files):
            raise ValueError(f"{utterance.noisy} is listed both as clean and as noisy speech")
        folder = _non_speech_folder(utterance.path)
        if folder:
            raise ValueError(
                f"{utterance.path} is listed as clean speech, but is in a folder {folder!r}"
            )
        for kind, name in (("file", utterance.path), ("speaker", utterance.speaker.casefold())):
            split = splits.setdefault((kind, name), utterance.split)
            if name and split != utterance.split:
                raise ValueError(f"{kind} {name} is in the splits {split} and {utterance.split}")


def warn_of_non_speech(folder: str | Path, files: Sequence[Path]) -> None:
    """Warn if files of clean speech are in subfolders with names such as ``noise`` or ``noisy``.

    Args:
        folder: Folder of clean speech. Its own name has no influence.
        files: Files in this folder.

    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warn_of_non_speech("corpus", [Path("corpus/clean/a.wav"), Path("corpus/noise/b.wav")])
    >>> len(caught)
    1
    """
    folders = [_non_speech_folder(file.relative_to(folder).as_posix()) for file in files]
    non_speech = [name for name in folders if name]
    if non_speech:
        warnings.warn(
            f"{folder}: {len(non_speech)} of {len(files)} files are used as clean speech, but are "
            f"in folders such as {non_speech[0]!r}; pass the folder of clean speech alone, or a "
            "manifest (hlsim prepare)",
            stacklevel=3,
        )


def _non_speech_folder(path: str) -> str:
    """Return the first folder of a path whose name is that of other sounds, or an empty text."""
    for folder in path.split("/")[:-1]:
        if _NON_SPEECH_WORDS & set(re.split("[^a-z]+", folder.lower())):
            return folder
    return ""
