"""Preparing a corpus: every file is checked, and manifest, plan of instances and report of faults are written."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from hlsim.audiogram import SEVERITIES
from hlsim.data.checking import Listing, examine_all
from hlsim.data.corpora import Fault, assign_splits, detect_layout, find_below
from hlsim.data.ears import Ears, plan_ears
from hlsim.data.instances import CLAIM, INSTANCE_COLUMNS, INSTANCES, MANIFEST, SETTINGS
from hlsim.data.manifest import SPLITS, UTTERANCE_COLUMNS, Rows, csv_line, no_formula
from hlsim.data.noises import Noises, find_noises
from hlsim.data.plan_settings import PlanSettings
from hlsim.files import PARTIAL, Whole, sha256, write_whole
from hlsim.parallel import Backend

FAULTS = "faults.csv"
FAULT_COLUMNS = ("path", "reason")


@dataclass
class Prepared:
    """What ``prepare`` found: by split, and instances also by split and severity, as "train severe"; files left out, and
    path and reason of the first."""

    utterances: Counter[str] = field(default_factory=Counter)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    instances: Counter[str] = field(default_factory=Counter)
    severities: Counter[str] = field(default_factory=Counter)
    faults: int = 0
    first_fault: str = ""

    def to_text(self) -> str:
        """A line a split."""
        lines = []
        for split in (split for split in SPLITS if self.utterances.get(split)):
            count = self.instances[split]
            counts = {name: self.severities.get(f"{split} {name}") for name in SEVERITIES}
            ears = ", ".join(f"{100.0 * n / count:.0f} % {name}" for name, n in counts.items() if n)
            told = f"{self.utterances[split]} utterances, {self.seconds[split] / 3600.0:.2f} h"
            lines.append(f"{split}: {told}, {count} instances; ears {ears}")
        return "\n".join(lines)


def prepare(
    settings: PlanSettings,
    out: str | Path,
    *,
    strict: bool = False,
    jobs: int | None = None,
    backend: Backend = "loky",
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
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
        ValueError: settings or folders that cannot be used, nothing left to use, faults with ``strict``, or ``out`` holds
            instances of another plan, or tables that are not of ``prepare``.
    """
    root, corpus, noise = settings.places()
    folder = Path(out)
    _spare_what_is_not_ours(settings, folder)
    layout = detect_layout(root / corpus) if settings.layout == "auto" else settings.layout
    listing = Listing()
    find = partial(
        find_below, root, corpus, layout, settings.table, noise if settings.noise else None
    )
    for found in find():
        listing.add(root, found)
    if not listing.total:
        raise ValueError(f"{root / corpus}: no audio in it that the layout {layout} knows")
    about: dict[str, Any] = {
        "root": str(root),
        "layout": layout,
        "settings": {n: str(v) if isinstance(v, Path) else v for n, v in asdict(settings).items()},
        "files_sha256": listing.digest(root / noise, settings),
    }
    if prepared := _unchanged(folder, about, strict):
        return prepared
    if (folder / SETTINGS).is_file() and (folder / CLAIM).is_file():  # of no use without their plan
        raise ValueError(
            f"{(folder / CLAIM).parent}: holds instances of another plan, with other settings or files; choose another "
            "--out, or remove it"
        )
    shares = {"test_share": settings.test_share, "valid_share": settings.valid_share}
    splits = assign_splits(listing.speakers, **shares, seed=settings.seed)
    used = set(splits.values())
    ears = plan_ears(settings, used)
    noises: Noises | None = None
    faults: list[Fault] = []
    if settings.noise is not None:
        if listing.paired:
            raise ValueError(
                f"{settings.corpus}: has noisy speech of its own; allowed: no folder of noise with it, or only the clean "
                "speech as the corpus"
            )
        noises, faults = find_noises(root, noise, used, settings)
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f".*{PARTIAL}"):  # of a run that was killed
        leftover.unlink(missing_ok=True)
    prepared = Prepared()
    with Whole(folder / FAULTS) as report, Whole(folder / MANIFEST) as manifest:
        report.write(csv_line(FAULT_COLUMNS))
        manifest.write(csv_line(UTTERANCE_COLUMNS))

        def tell(fault: Fault) -> None:
            report.write(csv_line((no_formula(fault.path), fault.reason)))
            prepared.faults += 1
            prepared.first_fault = prepared.first_fault or f"{fault.path}: {fault.reason}"

        for fault in faults:
            tell(fault)
        checks = (root, settings.shortest, listing.paired > 0)
        examined = examine_all(find(), *checks, jobs=jobs, backend=backend, scheduler=scheduler)
        for number, found in enumerate(examined, start=1):
            if isinstance(found, Fault):
                tell(found)
            else:
                utterance = replace(found, split=splits[found.speaker])
                if noises is not None:
                    utterance = noises.choose(utterance, settings.seed)
                manifest.write(csv_line(utterance.to_row().values()))
                prepared.utterances[utterance.split] += 1
                prepared.seconds[utterance.split] += utterance.seconds
            if progress is not None:
                progress(number, listing.total)
        report.keep()
        _refuse_faults(prepared, strict, folder)
        if not prepared.utterances:
            raise ValueError(
                f"{root / corpus}: nothing in it can be used; {folder / FAULTS} says why"
            )
        (folder / SETTINGS).unlink(
            missing_ok=True
        )  # it is written last: without it the folder is not prepared
        manifest.keep()
    inputs = ["clean", "noisy"] if listing.paired or noises is not None else ["clean"]
    _write_instances(settings, folder, prepared, ears, inputs)
    about |= {"inputs": inputs, **_digests(folder), "prepared": vars(prepared)}
    write_whole(folder / SETTINGS, json.dumps(about, indent=2) + "\n")
    return prepared


def _spare_what_is_not_ours(settings: PlanSettings, folder: Path) -> None:
    """Raises ValueError where a table of the user's would be written over."""
    given = (settings.table, settings.audiograms, settings.test_audiograms)
    tables = [table for table in given if table is not None and table.exists()]
    ours = {
        MANIFEST: UTTERANCE_COLUMNS,
        INSTANCES: INSTANCE_COLUMNS,
        FAULTS: FAULT_COLUMNS,
        SETTINGS: None,
    }
    for path, columns in ((folder / name, columns) for name, columns in ours.items()):
        if not path.is_file():
            continue
        if any(map(path.samefile, tables)):
            raise ValueError(
                f"{path}: would be written over, and is read from; choose another --out"
            )
        with open(path, "rb") as file:
            if columns is not None and file.readline() != csv_line(columns).encode():
                raise ValueError(
                    f"{path}: not written by 'hlsim prepare'; choose another --out, or move it"
                )


def _unchanged(folder: Path, about: Mapping[str, Any], strict: bool) -> Prepared | None:
    """What an earlier run found, where it had the same settings and files; None where there is none."""
    try:
        kept = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
        if kept != kept | json.loads(json.dumps(about)) | _digests(folder):
            return None
        prepared = Prepared(**kept["prepared"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    _refuse_faults(prepared, strict, folder)
    return prepared


def _digests(folder: Path) -> dict[str, str]:
    return {f"{Path(name).stem}_sha256": sha256(folder / name) for name in (MANIFEST, INSTANCES)}


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
        split: ears.assign(split, n, settings.ears) for split, n in prepared.utterances.items()
    }
    number = 0
    with Whole(folder / INSTANCES) as file:
        file.write(csv_line(INSTANCE_COLUMNS))
        for row in Rows(folder / MANIFEST, UTTERANCE_COLUMNS):
            draw, split = Random(f"{settings.seed}:level:{row['id']}"), row["split"]
            for ear in next(assigned[split]):
                level = f"{draw.uniform(*settings.level):.2f}"
                for name in inputs:
                    cells = (number, row["id"], split, name, level, ear.severity)
                    file.write(csv_line((*cells, *ear.to_row().values())))
                    number += 1
                    prepared.instances[split] += 1
                    prepared.severities[f"{split} {ear.severity}"] += 1
        file.keep()
