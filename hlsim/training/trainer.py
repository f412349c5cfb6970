"""Running a training with Lightning: it resumes, keeps the best network, and stops when it is told to."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any, TypedDict, Unpack

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from hlsim.pretrained import checkpoint_digest
from hlsim.training.callbacks import CHECKPOINT, BestCheckpoint, ProgressBar
from hlsim.training.data_module import BatchData
from hlsim.training.module import TrainingModule
from hlsim.training.recipes import TrainingRecipe
from hlsim.version import __version__

LAST_STATE = "last.ckpt"
"""File of the state from which a training resumes."""

EXPECTED_WARNINGS = (
    "many workers|directory .* exists|not used|before the epoch ended|logging interval|LeafSpec"
)
"""What Lightning warns of, of things that hlsim does on purpose."""


class TrainerOptions(TypedDict, total=False):
    """How a training runs.

    Attributes:
        max_minutes: minutes after which training stops, those before a resumption included. By default it ends after
            the recipe's steps.
        accelerator: as for Lightning's ``Trainer``, by default "auto".
        devices: number of devices, by default 1. Each draws its own batches, so that the batch grows with their number.
        progress: whether a terminal shows a progress bar, as by default.
    """

    max_minutes: float | None
    accelerator: str
    devices: int
    progress: bool


def train_network(
    module: TrainingModule,
    data: BatchData,
    kind: str,
    *,
    out: str | Path,
    identity: Mapping[str, Any],
    about: Mapping[str, Any],
    callbacks: Sequence[Callback] = (),
    **options: Unpack[TrainerOptions],
) -> Path:
    """Train a network, or resume its training, and keep the best one by validation.

    Args:
        module, data: network and batches.
        kind: kind of the checkpoint.
        out: folder for checkpoint, states and TensorBoard's events. If it holds a state, training resumes from it.
        identity: description of data and teacher. A training does not resume with another identity or recipe.
        about: what the checkpoint's ``config.json`` says beside recipe, steps and validation.
        callbacks: further callbacks.

    Returns:
        The checkpoint's folder.

    Raises:
        ValueError: the folder holds another training or a broken state, there is no such device, or the loss is not
            finite.
        KeyboardInterrupt: the training was interrupted. It resumes from its last validation.
    """
    recipe = module.recipe
    folder = Path(out)
    start = {"start_sha256": checkpoint_digest(recipe.start)} if recipe.start else {}
    record = {"hlsim": __version__, "recipe": asdict(recipe), **start, **about}
    module.description = asdict(recipe) | start | dict(identity)

    last_path = folder / LAST_STATE
    last_state = read_state(last_path) if last_path.exists() else None
    if last_state is not None:
        check_description(last_path, last_state["description"], module.description)
        module.start_validation = last_state["start_validation"]

    best = BestCheckpoint(folder, kind, record)
    with quiet_lightning():
        trainer = make_trainer(folder, recipe, [*callbacks, best], options)
        try:
            if last_state is None:
                trainer.validate(module, datamodule=data, verbose=False)
                module.start_validation = module.validation
            if recipe.start:
                # that network is the best one until training finds a better one
                best.score_to_beat = module.start_validation["score"]
                if last_state is None and trainer.is_global_zero:
                    best.release(module, module.state_dict(), step=0, seconds=0.0)
            ckpt_path = None if last_state is None else last_path
            trainer.fit(module, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
        except SystemExit:
            if trainer.interrupted:  # Lightning exits after Ctrl-C
                raise KeyboardInterrupt from None
            raise
    return folder / CHECKPOINT


def make_trainer(
    folder: Path, recipe: TrainingRecipe, callbacks: Sequence[Callback], options: TrainerOptions
) -> L.Trainer:
    """Make a Trainer of a recipe's steps. Raises ValueError if the options do not fit the machine."""
    max_minutes = options.get("max_minutes")
    duration = None if max_minutes is None else timedelta(minutes=max_minutes)
    last = ModelCheckpoint(
        dirpath=folder,
        filename=Path(LAST_STATE).stem,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    # the last state holds what the callbacks before it have done
    all_callbacks = [Timer(duration, verbose=False), *callbacks, last]
    show_progress = options.get("progress", True) and sys.stdout.isatty()
    if show_progress:
        all_callbacks.append(ProgressBar())
    accelerator, devices = options.get("accelerator", "auto"), options.get("devices", 1)
    try:
        return L.Trainer(
            accelerator=accelerator,
            devices=devices,
            use_distributed_sampler=False,  # each process draws its own batches
            max_epochs=-1,
            max_steps=recipe.steps,
            val_check_interval=recipe.validate_every,
            check_val_every_n_epoch=None,  # the interval may be longer than the training
            num_sanity_val_steps=0,
            gradient_clip_val=1.0,
            callbacks=all_callbacks,
            enable_progress_bar=show_progress,
            enable_model_summary=False,
            logger=TensorBoardLogger(str(folder), name="", version="events"),
            log_every_n_steps=10,
            default_root_dir=folder,
        )
    except MisconfigurationException as error:
        raise ValueError(f"cannot train on {devices} of {accelerator}: {error}") from error


def read_state(path: Path) -> dict[str, Any]:
    """Read a training's state. Raises ValueError if the file is broken."""
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        state["description"]
    except Exception as error:  # torch, zip and pickle each have their own
        raise ValueError(
            f"{path} cannot be read as a training's state; delete it to start anew"
        ) from error
    return state


def check_description(path: Path, found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raise ValueError, naming what differs, unless a state is of the training that is to resume."""
    names = sorted({*found, *expected})
    differing = [name for name in names if found.get(name) != expected.get(name)]
    if differing:
        raise ValueError(
            f"{path} is the state of a training with other {', '.join(differing)}; choose another output folder"
        )


@contextmanager
def quiet_lightning() -> Iterator[None]:
    """Silence Lightning's remarks about devices and about what hlsim does on purpose."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", f".*({EXPECTED_WARNINGS})")
            yield
    finally:
        logger.setLevel(level)
