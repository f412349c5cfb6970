"""What a training's folder holds of its state, and whose state that is."""

import io
import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from hlsim.files import PARTIAL, file_lock, repair_folder, write_whole
from hlsim.pretrained import check_replaceable

CHECKPOINT, LAST, BEST, RECIPE = "checkpoint", "last.ckpt", "best.json", "recipe.json"
"""The folder with the best model in its released form; the state that a killed training goes on from; the best score so
far; and what the training is made of."""

_LOCK = "lock"


class WholeStates(TorchCheckpointIO):
    """Writes states whole or not at all: Lightning's own may copy one from another disk, and a kill then halves it."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_whole(path, buffer.getvalue())

    def load_checkpoint(self, path: str | Path, *options: Any, **others: Any) -> dict[str, Any]:
        """Raises ValueError where the file is broken or has changed."""
        try:
            with zipfile.ZipFile(path) as archive:  # torch does not look at the checksums
                if changed := archive.testzip():
                    raise ValueError(f"{changed} is not what was written")
            state: dict[str, Any] = super().load_checkpoint(path, *options, **others)
            state["state_dict"]
        except Exception as error:  # zip, pickle and torch each have others
            raise ValueError(f"{path}: not readable as a state; remove it to start anew") from error
        return state


@contextmanager
def claimed(folder: Path, recipe: Mapping[str, Any], *, first: bool) -> Iterator[None]:
    """Make a folder this training's, with its recipe in it, and the first of its processes the only one there.

    Raises:
        ValueError: another training is running in it, it holds the state of one of another recipe, or its checkpoint's
            folder holds something else.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _LOCK).touch()
    with file_lock(folder / _LOCK) if first else nullcontext():
        _claim(folder, recipe)
        repair_folder(folder / CHECKPOINT)
        check_replaceable(folder / CHECKPOINT)
        yield


def _claim(folder: Path, recipe: Mapping[str, Any]) -> None:
    for leftover in folder.glob(f".{LAST}.*{PARTIAL}"):  # of a run that was killed
        leftover.unlink(missing_ok=True)
    text = json.dumps(recipe, indent=2, sort_keys=True, default=str)
    note = folder / RECIPE
    # the second is what Lightning leaves where SLURM ends a job
    if (folder / LAST).is_file() or any(folder.glob("hpc_ckpt_*")):
        if note.is_file() and (found := note.read_text(encoding="utf-8")) != text:
            raise ValueError(
                f"{folder}: holds a training of another recipe (other {_differing(found, text)}; see {note.name}); "
                f"choose another --out, from its weights with --start {folder / CHECKPOINT}"
            )
        return
    (folder / BEST).unlink(missing_ok=True)
    write_whole(note, text)


def _differing(one: str, other: str) -> str:
    """Names of the settings that differ."""
    try:
        first, second = json.loads(one), json.loads(other)
        names = sorted(first | second)
        return ", ".join(name for name in names if first.get(name, ...) != second.get(name, ...))
    except (ValueError, TypeError):
        return "settings"  # the file is broken
