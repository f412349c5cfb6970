"""Trainings with Lightning, which resume, save the best network, and stop after a time limit."""

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

from hlsim.checkpoint import read_record
from hlsim.training.callbacks import CHECKPOINT, BestCheckpoint
from hlsim.training.data_module import BatchData
from hlsim.training.module import TrainingModule
from hlsim.training.recipes import TrainingRecipe
from hlsim.version import __version__

_LAST_STATE = "last.ckpt"
"""Name of the file from which a training resumes."""

_EXPECTED_WARNINGS = (
    "many workers|directory .* exists|not used|before the epoch ended|logging interval|LeafSpec"
)
"""Pattern of Lightning's warnings about choices that hlsim makes on purpose."""


class TrainerOptions(TypedDict, total=False):
    """Options that state where and how long a training runs, and what it shows.

    Attributes:
        max_minutes: Time limit in minutes, including the time before a resumption. A training that
            reaches it ends before the recipe's last step. By default, there is no limit.
        accelerator: Type of device, "auto" (default), "cpu" or "gpu", see Lightning's ``Trainer``.
        devices: Number of devices, 1 by default. Each draws a batch of its own at every step, so
            that N devices train with N batches per step.
        progress: Whether a terminal shows a progress bar, which it does by default.

    >>> TrainerOptions(max_minutes=5.0)
    {'max_minutes': 5.0}
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
    """Train a network, or resume its training, and save the weights with the best validation score.

    Args:
        module: Network, loss and recipe.
        data: Batches for training and validation.
        kind: Kind of the checkpoint, such as ``"hearing-aid"``.
        out: Folder for the checkpoint, Lightning's states and TensorBoard's events. If it contains
            a state, the training resumes from it.
        identity: Description of data and teacher. A training resumes only with the same description
            and recipe.
        about: Further entries for the checkpoint's ``config.json``.
        callbacks: Additional callbacks of Lightning.
        options: Device, time limit and progress, see ``TrainerOptions``.

    Returns:
        The folder ``checkpoint`` below ``out``.

    Raises:
        ValueError: The folder contains another training or a broken state, there is no such device,
            or the loss is not finite.
        KeyboardInterrupt: The training was interrupted. It resumes from its last validation.
    """
    recipe = module.recipe
    folder = Path(out)
    start = {"start_sha256": read_record(recipe.start)["sha256"]} if recipe.start else {}
    record = {"hlsim": __version__, "recipe": asdict(recipe), **start, **about}
    module.description = asdict(recipe) | start | dict(identity)

    last_path = folder / _LAST_STATE
    last_state = _read_state(last_path) if last_path.exists() else None
    if last_state is not None:
        _check_description(last_path, last_state["description"], module.description)
        module.start_validation = last_state["start_validation"]

    best = BestCheckpoint(folder, kind, record)
    with _quiet_lightning():
        trainer = _make_trainer(folder, recipe, [*callbacks, best], options)
        try:
            if last_state is None:
                trainer.validate(module, datamodule=data, verbose=False)
                module.start_validation = module.validation
            if recipe.start:
                # The start is the best network until training finds a better one.
                best.score_to_beat = module.start_validation["score"]
                if last_state is None and trainer.is_global_zero:
                    best.write_checkpoint(module, module.state_dict(), step=0, seconds=0.0)
            ckpt_path = None if last_state is None else last_path
            trainer.fit(module, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
        except SystemExit:
            if trainer.interrupted:  # Lightning raises SystemExit after Ctrl-C.
                raise KeyboardInterrupt from None
            raise
    return folder / CHECKPOINT


def _make_trainer(
    folder: Path, recipe: TrainingRecipe, callbacks: Sequence[Callback], options: TrainerOptions
) -> L.Trainer:
    """Make a Trainer of Lightning that takes the steps of a recipe and saves its state.

    Raises:
        ValueError: There is no such device.
    """
    max_minutes = options.get("max_minutes")
    duration = None if max_minutes is None else timedelta(minutes=max_minutes)
    last = ModelCheckpoint(
        dirpath=folder,
        filename=Path(_LAST_STATE).stem,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    # The state includes those of all callbacks, if it is saved after they have run.
    all_callbacks = [Timer(duration, verbose=False), *callbacks, last]
    accelerator = options.get("accelerator", "auto")
    devices = options.get("devices", 1)
    try:
        return L.Trainer(
            accelerator=accelerator,
            devices=devices,
            use_distributed_sampler=False,  # Each process draws its own batches.
            max_epochs=-1,
            max_steps=recipe.steps,
            val_check_interval=recipe.validate_every,
            check_val_every_n_epoch=None,  # The interval may be longer than the training.
            num_sanity_val_steps=0,
            gradient_clip_val=1.0,
            callbacks=all_callbacks,
            enable_progress_bar=options.get("progress", True) and sys.stdout.isatty(),
            enable_model_summary=False,
            logger=TensorBoardLogger(str(folder), name="", version="events"),
            log_every_n_steps=10,
            default_root_dir=folder,
        )
    except MisconfigurationException as error:
        raise ValueError(
            f"cannot train on {devices} devices of type {accelerator!r}: {error}"
        ) from error


def _read_state(path: Path) -> dict[str, Any]:
    """Read the state of a training. A broken file raises ValueError."""
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        state["description"]
    except Exception as error:  # torch, zipfile and pickle raise various exceptions.
        raise ValueError(
            f"{path}: cannot be read as the state of a training; delete it to start from the "
            "beginning"
        ) from error
    return state


def _check_description(path: Path, actual: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Raise ValueError unless a state belongs to the training that should resume.

    Args:
        path: File of the state, for the error message.
        actual: Description of the training that wrote the state.
        expected: Description of the training that should resume.
    """
    names = sorted({*actual, *expected})
    differences = [name for name in names if actual.get(name) != expected.get(name)]
    if differences:
        raise ValueError(
            f"{path}: the state belongs to a training that differs in {', '.join(differences)}; "
            "choose another output folder"
        )


@contextmanager
def _quiet_lightning() -> Iterator[None]:
    """Silence Lightning's messages about devices, and the warnings in ``_EXPECTED_WARNINGS``."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", f".*({_EXPECTED_WARNINGS})")
            yield
    finally:
        logger.setLevel(level)
