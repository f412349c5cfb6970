"""Preparing a corpus: every file is checked, and manifest, plan of instances and report of faults are written."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from hlsim.audio import check_rate, read_audio
from hlsim.audiogram import SEVERITIES
from hlsim.data.active_level import active_level_db
from hlsim.data.corpora import (
    LAYOUTS,
    Fault,
    assign_splits,
    detect_layout,
    find_below,
    walk_audio,
)
from hlsim.data.ears import Ears, plan_ears
from hlsim.data.files import Whole
from hlsim.data.manifest import SPLITS, UTTERANCE_COLUMNS, Rows, Utterance, csv_line, inside
from hlsim.data.noises import TEST_SNRS_DB, TRAIN_SNRS_DB, Noises, find_noises
from hlsim.data.samples import INSTANCE_COLUMNS, INSTANCES, MANIFEST, SETTINGS
from hlsim.parallel import run_parallel
from hlsim.settings import refuse_unknown

FAULTS = "faults.csv"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PlanSettings:
    """What a plan is made of.

    Attributes:
        corpus, noise: folders; the noises are mixed into clean speech.
        root: folder that holds both; by default the corpus, or with noise their common parent.
        layout: ``auto``, or one of ``LAYOUTS``.
        table: CSV file that lists the corpus.
        train_snrs, test_snrs: dB by active speech level.
        train_types, test_types: how many types of noise.
        audiograms, test_audiograms: CSV files of ears; without any they are drawn.
        ears: an utterance.
        severities: proportions; None for equal ones of mild, moderate and severe, or as in the file.
        level: lowest and highest active speech level at which ears are given the speech, dB SPL.
        rate: of the instances, Hz.
        test_share, valid_share: of speakers, see ``assign_splits``.
        shortest: seconds; what is shorter is left out.
        seed: of every draw.
    """

    corpus: Path
    noise: Path | None = None
    root: Path | None = None
    layout: str = "auto"
    table: Path | None = None
    train_snrs: Sequence[float] = TRAIN_SNRS_DB
    test_snrs: Sequence[float] = TEST_SNRS_DB
    train_types: int = 8
    test_types: int = 2
    audiograms: Path | None = None
    test_audiograms: Path | None = None
    ears: int = 2
    severities: Mapping[str, float] | None = None
    level: tuple[float, float] = (65.0, 65.0)
    rate: int = 16000
    test_share: float = 0.1
    valid_share: float = 0.0
    shortest: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_unknown([self.layout], ("auto", *LAYOUTS), "layouts")
        check_rate(self.rate)
        for name, share in (("test_share", self.test_share), ("valid_share", self.valid_share)):
            if not 0.0 <= share < 1.0:
                raise ValueError(f"{name} {share}; allowed: 0 to less than 1")
        if min(self.ears, self.train_types, self.test_types) < 1 or self.shortest < 0.1:
            raise ValueError(
                f"ears {self.ears}, train_types {self.train_types}, test_types {self.test_types}, shortest "
                f"{self.shortest} s; allowed: counts from 1 up, 0.1 s or more"
            )
        low, high = self.level
        if not 20.0 <= low <= high <= 110.0:
            raise ValueError(f"level {low:g} to {high:g} dB SPL; allowed: ascending, 20 to 110")

    def places(self) -> tuple[Path, str, str]:
        """Root, and corpus and noise below it. Raises ValueError where the root does not hold them."""
        folders = [folder.resolve() for folder in (self.corpus, self.noise) if folder is not None]
        for folder in folders:
            if not folder.is_dir():
                raise ValueError(f"{folder}: no such folder")
        root = self.root.resolve() if self.root else Path(os.path.commonpath(folders))
        if root == Path(root.anchor):
            raise ValueError(f"{folders[0]} and {folders[-1]} have only {root} in common; allowed: a --root")
        for folder in folders:
            if not folder.is_relative_to(root):
                raise ValueError(f"{folder}: not in the root {root}; allowed: folders below it")
        names = ["" if folder == root else folder.relative_to(root).as_posix() for folder in folders]
        return root, names[0], names[-1]


@dataclass
class Prepared:
    """What ``prepare`` found.

    Attributes:
        utterances, seconds, instances: by split.
        severities: instances by split and severity, as "train severe".
        faults: files left out.
        first_fault: path and reason of the first.
    """

    utterances: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=dict)
    instances: Counter[str] = field(default_factory=Counter)
    severities: Counter[str] = field(default_factory=Counter)
    faults: int = 0
    first_fault: str = ""

    def to_text(self) -> str:
        """A line a split."""
        lines = []
        for split in (split for split in SPLITS if self.utterances.get(split)):
            shares = ", ".join(
                f"{100.0 * self.severities[key] / self.instances[split]:.0f} % {name}"
                for name in SEVERITIES
                if self.severities.get(key := f"{split} {name}")
            )
            lines.append(
                f"{split}: {self.utterances[split]} utterances, {self.seconds[split] / 3600.0:.2f} h, "
                f"{self.instances[split]} instances; ears {shares}"
            )
        return "\n".join(lines)


def prepare(
    settings: PlanSettings,
    out: str | Path,
    *,
    strict: bool = False,
    jobs: int | None = None,
    backend: str = "loky",
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Prepared:
    """Check a corpus file by file and write the plan of a data set.

    ``out`` gets ``faults.csv`` (path, reason), and if there is anything left to use ``manifest.csv`` (a row an
    utterance), ``instances.csv`` (a row an instance: utterance, input, ear, level) and ``plan.json`` (settings and root).
    The same files, settings and seed give the same bytes; what is there already is kept.

    Args:
        strict: a fault is an error; nothing but the report is written then.
        jobs, backend, scheduler: see ``run_parallel``.
        progress: called with the utterances checked and all.

    Raises:
        ValueError: settings or folders that cannot be used, nothing left to use, faults with ``strict``, or instances of
            another plan in ``out``.
    """
    root, corpus, noise = settings.places()
    folder = Path(out)
    layout = detect_layout(root / corpus) if settings.layout == "auto" else settings.layout
    listing = _Listing()
    find = partial(find_below, root, corpus, layout, settings.table, noise if settings.noise else None)
    for found in find():
        listing.add(root, found)
    if not listing.total:
        raise ValueError(f"{root / corpus}: no audio in it that the layout {layout} knows")
    about: dict[str, Any] = {
        "root": str(root),
        "layout": layout,
        "settings": {name: _plain(value) for name, value in asdict(settings).items()},
        "files_sha256": listing.digest(root / noise if settings.noise else None, settings),
    }
    if prepared := _unchanged(folder, about, strict):
        return prepared
    splits = assign_splits(
        listing.speakers, test_share=settings.test_share, valid_share=settings.valid_share, seed=settings.seed
    )
    used = set(splits.values())
    ears = plan_ears(settings.severities, settings.audiograms, settings.test_audiograms, used, settings.seed)
    ears.check(used, settings.ears)
    noises, faults = _noises(settings, root, noise, used, listing.paired)

    folder.mkdir(parents=True, exist_ok=True)
    (folder / SETTINGS).unlink(missing_ok=True)  # it is written last: without it the folder is not prepared
    prepared = Prepared()
    with Whole(folder / FAULTS) as report, Whole(folder / MANIFEST) as manifest:
        report.write(csv_line(("path", "reason")))
        manifest.write(csv_line(UTTERANCE_COLUMNS))

        def tell(fault: Fault) -> None:
            report.write(csv_line((fault.path, fault.reason)))
            prepared.faults += 1
            prepared.first_fault = prepared.first_fault or f"{fault.path}: {fault.reason}"

        for fault in faults:
            tell(fault)
        check = partial(examine, root, shortest=settings.shortest, pairs=listing.paired > 0)
        examined = run_parallel(
            partial(_numbered, check), enumerate(find()), jobs=jobs, backend=backend, scheduler=scheduler
        )
        for number, found in enumerate(_in_order(examined), start=1):
            if isinstance(found, Fault):
                tell(found)
            else:
                utterance = replace(found, split=splits[found.speaker])
                if noises is not None:
                    utterance = noises.choose(utterance, settings.seed)
                manifest.write(csv_line(utterance.to_row().values()))
                prepared.utterances[utterance.split] += 1
                sums = prepared.seconds
                sums[utterance.split] = sums.get(utterance.split, 0.0) + utterance.seconds
            if progress is not None:
                progress(number, listing.total)
        report.keep()
        _refuse_faults(prepared, strict, folder)
        if not prepared.utterances:
            raise ValueError(f"{root / corpus}: nothing in it can be used; {folder / FAULTS} says why")
        manifest.keep()
    inputs = ["clean", "noisy"] if listing.paired or noises is not None else ["clean"]
    _write_instances(settings, folder, prepared, ears, inputs)
    about |= {
        "inputs": inputs,
        "manifest_sha256": _digest(folder / MANIFEST),
        "instances_sha256": _digest(folder / INSTANCES),
        "prepared": vars(prepared),
    }
    with Whole(folder / SETTINGS) as file:
        file.write(json.dumps(about, indent=2) + "\n")
        file.keep()
    return prepared


def examine(root: Path, found: Utterance | Fault, *, shortest: float, pairs: bool) -> Utterance | Fault:
    """The utterance with rate, seconds and active level, or what is at fault with its files, which are read whole."""
    if isinstance(found, Fault):
        return found
    path = found.clean
    try:
        clean, rate = read_audio(inside(root, path))
        seconds = clean.shape[-1] / rate
        if seconds < shortest:
            return Fault(path, f"{seconds:.3g} s; {shortest:g} s or more are asked for")
        if not bool(clean[0].any()):
            return Fault(path, "silent first channel")
        if pairs and not found.noisy:
            return Fault(path, "no noisy counterpart, and others have one")
        if found.noisy:
            path = found.noisy
            noisy, noisy_rate = read_audio(inside(root, path))
            if not bool(noisy[0].any()):
                return Fault(path, "silent first channel")
            if noisy_rate != rate:
                return Fault(path, f"{noisy_rate} Hz, its clean speech has {rate} Hz")
            if noisy.shape[-1] != clean.shape[-1]:
                return Fault(
                    path,
                    f"{noisy.shape[-1]} samples, its clean speech has {clean.shape[-1]}: unequal lengths",
                )
    except ValueError as error:
        return Fault(path, str(error).removeprefix(f"{root / path}: "))
    level = active_level_db(clean[0], rate)
    return replace(found, rate=rate, seconds=seconds, active_level=level)


def _numbered(
    check: Callable[[Utterance | Fault], Utterance | Fault], task: tuple[int, Utterance | Fault]
) -> Utterance | Fault:
    return check(task[1])


def _in_order(
    examined: Iterable[tuple[tuple[int, Utterance | Fault], Utterance | Fault | None]],
) -> Iterator[Utterance | Fault]:
    """Results in the order of the corpus, however they come; a process that died is a fault of its file."""
    waiting: dict[int, Utterance | Fault] = {}
    wanted = 0
    for (number, item), found in examined:
        path = item.path if isinstance(item, Fault) else item.clean
        waiting[number] = found or Fault(path, "the process that read it died")
        while wanted in waiting:
            yield waiting.pop(wanted)
            wanted += 1


def _noises(
    settings: PlanSettings, root: Path, noise: str, splits: set[str], paired: int
) -> tuple[Noises | None, list[Fault]]:
    if settings.noise is None:
        return None, []
    if paired:
        raise ValueError(
            f"{settings.corpus}: has noisy speech of its own; allowed: no folder of noise with it, or only the "
            "clean speech as the corpus"
        )
    return find_noises(
        root,
        noise,
        splits,
        train_snrs=settings.train_snrs,
        test_snrs=settings.test_snrs,
        train_types=settings.train_types,
        test_types=settings.test_types,
        seed=settings.seed,
    )


class _Listing:
    """What a first look at the corpus tells: its speakers, and a digest of names, sizes and times of change."""

    def __init__(self) -> None:
        self.speakers: dict[str, set[str]] = {}
        self.paired = self.total = 0
        self._digest = hashlib.sha256()

    def add(self, root: Path, found: Utterance | Fault) -> None:
        self.total += 1
        if isinstance(found, Fault):
            self._digest.update(f"{found}\n".encode())
            return
        self.speakers.setdefault(found.speaker, set()).add(found.split)
        self.paired += bool(found.noisy)
        self._digest.update(f"{found} {_state(root / found.clean)} {_state(root / found.noisy)}\n".encode())

    def digest(self, noise: Path | None, settings: PlanSettings) -> str:
        for path in walk_audio(noise) if noise is not None else ():
            self._digest.update(f"{path} {_state(noise / path)}\n".encode())  # type: ignore[operator]
        for table in (settings.audiograms, settings.test_audiograms):
            self._digest.update(f"{table and _state(table)}\n".encode())
        return self._digest.hexdigest()


def _state(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except OSError:
        return None
    return about.st_size, about.st_mtime_ns


def _unchanged(folder: Path, about: Mapping[str, Any], strict: bool) -> Prepared | None:
    """What an earlier run found, where it had the same settings and files; None where there is none."""
    try:
        kept = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
        same = all(kept[name] == json.loads(json.dumps(value)) for name, value in about.items())
        for name, file in (("manifest_sha256", MANIFEST), ("instances_sha256", INSTANCES)):
            same = same and kept[name] == _digest(folder / file)
        prepared = Prepared(**kept["prepared"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if same:
        _refuse_faults(prepared, strict, folder)
    return prepared if same else None


def _refuse_faults(prepared: Prepared, strict: bool, folder: Path) -> None:
    if strict and prepared.faults:
        raise ValueError(
            f"{prepared.faults} faults, the first {prepared.first_fault}; all are in {folder / FAULTS}; without --strict "
            "they are left out"
        )


def _write_instances(
    settings: PlanSettings, folder: Path, prepared: Prepared, ears: Ears, inputs: Sequence[str]
) -> None:
    assigned = {
        split: ears.assign(split, count, settings.ears) for split, count in prepared.utterances.items()
    }
    manifest = Rows(folder / MANIFEST, UTTERANCE_COLUMNS)
    with Whole(folder / INSTANCES) as file:
        file.write(csv_line(INSTANCE_COLUMNS))
        for number, cells in enumerate(_instances(manifest, assigned, inputs, settings)):
            file.write(csv_line((number, *cells)))
            prepared.instances[cells[1]] += 1
            prepared.severities[f"{cells[1]} {cells[4]}"] += 1
        file.keep()


def _instances(
    manifest: Rows, assigned: Mapping[str, Iterator[list[Any]]], inputs: Sequence[str], settings: PlanSettings
) -> Iterator[tuple[str, ...]]:
    for row in manifest:
        draw = Random(f"{settings.seed}:level:{row['id']}")
        for ear in next(assigned[row["split"]]):
            level = f"{draw.uniform(*settings.level):.2f}"
            for name in inputs:
                yield (row["id"], row["split"], name, level, ear.severity, *ear.to_row().values())


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value
