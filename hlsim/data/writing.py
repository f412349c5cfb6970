"""Instances on disk: one file each, the same bytes however often the work was interrupted and however many did it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from hlsim.data.instances import CLAIM, MANIFEST, Plan, is_whole
from hlsim.data.manifest import csv_line, no_formula
from hlsim.data.teacher import Alignment, Reference, Teacher, name_of
from hlsim.files import PARTIAL, file_lock, write_whole
from hlsim.parallel import Backend, Failed, Progress, make_missing, one_thread

WRITE_FAULTS = "write-faults.csv"


@dataclass(frozen=True)
class Recipe:
    """How the targets are made."""

    alignment: Alignment = "structural"
    reference: Reference | None = None

    def teacher(self, rate: int) -> Teacher:
        return Teacher(rate, alignment=self.alignment, reference=self.reference)

    def __str__(self) -> str:
        return f"teacher {name_of(self.reference)}, alignment {self.alignment}"


def write_instances(
    folder: str | Path,
    recipe: Recipe,
    *,
    root: str | Path | None = None,
    jobs: int | None = None,
    backend: Backend = "loky",
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> int:
    """Write all instances of a plan that are not there yet.

    Every file is written whole or not at all, and depends on the plan and the recipe alone: stopped in any way and
    started again, it ends with the same bytes.

    Args:
        folder: what ``prepare`` wrote.
        progress: called with the instances made and all; those found count as made.

    Returns: how many are there.

    Raises:
        ValueError: another process writes there, the folder holds instances of another plan or recipe, the disk is
            full, or audio cannot be read any more or its teacher fails on it: then what remains is written first, and
            ``write-faults.csv`` names the files.
    """
    plan = Plan(folder, root)
    report = plan.folder / WRITE_FAULTS
    # what others have begun would look like leftovers
    with file_lock(plan.folder / MANIFEST), one_thread():
        _claim(plan, recipe)
        for leftover in (plan.folder / "instances").rglob(f".*{PARTIAL}"):
            leftover.unlink(missing_ok=True)
        # a worker on another machine has another working folder
        task = partial(
            make, str(plan.folder.absolute()), str(plan.root.absolute()), plan.digest, recipe
        )
        failed = make_missing(
            task,
            range(len(plan.utterances)),
            lambda number: [str(number)] * plan.each,
            None,  # but the folder: whoever makes an utterance's instances looks which are there
            progress=progress,
            jobs=jobs,
            backend=backend,
            scheduler=scheduler,
        )
        faults = [
            (no_formula(plan.utterance(int(n) * plan.each).clean), failed[n])
            for n in sorted(failed, key=int)
        ]
        if faults:
            write_whole(report, "".join(map(csv_line, [("path", "reason"), *faults])))
            raise ValueError(
                f"{len(faults)} of {len(plan.utterances)} utterances have no instances, the first "
                f"{': '.join(faults[0])}; all are in {report}; the others are written"
            )
        report.unlink(missing_ok=True)
    return len(plan)


def make(
    folder: str, root: str, digest: str, recipe: Recipe, number: int, keys: Sequence[str]
) -> dict[str, dict[str, Any] | Failed]:
    """Write the instances of one utterance that are missing; its key with what is at fault, if its audio is."""
    torch.set_num_threads(
        1
    )  # which sums in one order; for good, for a worker may have other threads
    plan, teacher = _opened(folder, root, digest, recipe)
    for index in range(number * plan.each, (number + 1) * plan.each):
        if is_whole(plan.path(index)):
            continue
        try:  # one at a time, for the last bits of a batch depend on what else is in it
            instance = plan.instance(index)
            heard = teacher(instance.signal[None], instance.thresholds[None])[0]
        except ValueError as error:
            return {keys[0]: Failed(str(error))}
        write_whole(plan.path(index), replace(instance, impaired=heard).to_bytes())
    return {}


@lru_cache(maxsize=2)
def _opened(folder: str, root: str, digest: str, recipe: Recipe) -> tuple[Plan, Teacher]:
    """What lies in the folder may be another plan than before: the digest says which."""
    plan = Plan(folder, root)
    return plan, recipe.teacher(plan.rate)


def _claim(plan: Plan, recipe: Recipe) -> None:
    path, text = plan.folder / CLAIM, f"{plan.digest}\n{recipe}\n"
    if not path.is_file():
        write_whole(path, text)
    elif path.read_text(encoding="utf-8") != text:
        raise ValueError(
            f"{path.parent}: holds instances of another plan, teacher or alignment; choose another --out, or remove it"
        )


def claimed(plan: Plan) -> str:
    """What the instances on disk are made of: plan, teacher and alignment.

    Raises ValueError unless those of this very plan are all there.
    """
    path = plan.folder / CLAIM
    found = path.read_text(encoding="utf-8") if path.is_file() else ""
    if found.splitlines()[:1] != [plan.digest]:
        raise ValueError(
            f"{path.parent}: no instances of this plan; 'hlsim prepare --write' makes them"
        )
    if missing := sum(not plan.path(index).is_file() for index in range(len(plan))):
        what = f"{missing} of {len(plan)} instances missing"
        raise ValueError(f"{path.parent}: {what}; 'hlsim prepare --write' goes on with them")
    return found.strip()
