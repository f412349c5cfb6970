"""One way to run a training: a number of steps, resumable, with progress, TensorBoard and the best checkpoint kept."""

from __future__ import annotations

import logging
import signal
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any, TypedDict, Unpack

import lightning as L
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from hlsim.pretrained import checkpoint_digest, save_checkpoint
from hlsim.training.callbacks import DataWait, History, KeepBest, ShowExamples, StepProgress
from hlsim.training.data_module import BatchData
from hlsim.training.module import ScheduledModule
from hlsim.training.recipes import TrainingRecipe
from hlsim.training.state import BEST, CHECKPOINT, LAST, WholeStates, claimed
from hlsim.version import __version__


class RunOptions(TypedDict, total=False):
    """How a training runs.

    Attributes:
        max_minutes: minutes after which training stops, those before a resumption included; by default
            only the recipe's number of steps ends it.
        max_steps: number of steps after which training stops, for a test that goes on later.
        accelerator, devices, nodes, strategy: as Lightning's Trainer takes them, by default "auto" and 1; each process
            has batches of its own, so that the batch grows with their number.
        report: is given a line a validation; by default it is printed.
        progress: show a line that tells how far it is, the default.
    """

    max_minutes: float | None
    max_steps: int | None
    accelerator: str
    devices: int
    nodes: int
    strategy: str
    report: Callable[[str], None]
    progress: bool


def train_network(
    module: ScheduledModule,
    data: BatchData,
    recipe: TrainingRecipe,
    kind: str,
    *,
    out: str | Path,
    identity: Mapping[str, Any],
    about: Mapping[str, Any],
    **options: Unpack[RunOptions],
) -> Path:
    """``run`` a recipe, keep the best network as a checkpoint of a kind, and return the checkpoint's folder.

    Args:
        identity: what makes this training this one, beside recipe and time.
        about: what the checkpoint is to tell, beside recipe and figures.
    """
    folder = Path(out) / CHECKPOINT
    # a folder may hold other weights next time
    start = {"start_sha256": checkpoint_digest(recipe.start)} if recipe.start else {}

    def write(figures: dict[str, Any]) -> None:
        network: Any = module.released()
        told = {"hlsim": __version__, "recipe": asdict(recipe), **start, **about, **figures}
        save_checkpoint(folder, kind, network, network.config.to_dict(), told)

    what = asdict(recipe) | dict(identity) | start
    how: dict[str, Any] = {"validate_every": recipe.validate_every, "begun": bool(recipe.start)}
    run(module, data, out=out, recipe=what, write=write, **how, **options)
    return folder


def run(
    module: ScheduledModule,
    data: BatchData,
    *,
    out: str | Path,
    recipe: Mapping[str, Any],
    write: Callable[[dict[str, Any]], None],
    validate_every: int,
    begun: bool = False,
    **options: Unpack[RunOptions],
) -> None:
    """Train for the module's number of steps; go on from ``out`` where a run of the same recipe lies there.

    Args:
        out: folder for ``last.ckpt``, TensorBoard's events and what ``write`` puts there.
        recipe: what makes this run this run; it is kept in ``recipe.json``.
        write: stores the released form of the model, given the figures of its validation.
        validate_every: steps from validation to validation; a kill loses no more than these and their validation.
        begun: with weights that are worth keeping: they are validated too, and the best until others are better.

    Raises:
        ValueError: ``out`` holds a run of another recipe or a broken state, there is no such device, the loss is not
            finite, or the disk is full.
        KeyboardInterrupt: it was stopped; the state is that of the last validation.
    """
    max_steps, max_minutes = options.get("max_steps"), options.get("max_minutes")
    max_steps = module.steps if max_steps is None else min(max_steps, module.steps)
    folder, last = Path(out), Path(out) / LAST
    accelerator, strategy = options.get("accelerator", "auto"), options.get("strategy", "auto")
    devices, nodes = options.get("devices", 1), options.get("nodes", 1)
    duration = None if max_minutes is None else timedelta(minutes=max_minutes)
    module.timer = Timer(duration, interval="step", verbose=False)
    # at the end of each validation, not before it: a run that goes on from a state does not validate it
    how: dict[str, Any] = {
        "save_top_k": 1,
        "save_on_train_epoch_end": False,
        "enable_version_counter": False,
    }
    states = ModelCheckpoint(dirpath=folder, filename="last", **how)
    callbacks: list[Callback] = [
        module.timer,
        KeepBest(write, folder / BEST),
        History(options.get("report", print)),
        ShowExamples(),
        DataWait(),
        states,
        *([StepProgress(max_steps)] if options.get("progress", True) else []),
    ]
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore",
            ".*(does not have many workers|Checkpoint directory|GPU available|before the epoch ended|LeafSpec).*",
        )
        try:
            trainer = L.Trainer(
                accelerator=accelerator,
                devices=devices,
                num_nodes=nodes,
                strategy=strategy,
                plugins=[WholeStates()],
                use_distributed_sampler=False,  # each process draws by its rank
                max_epochs=-1,  # steps limit it; an epoch that is over would not be resumed
                max_steps=max_steps,
                gradient_clip_val=1.0,
                callbacks=callbacks,
                default_root_dir=str(folder),  # for what SLURM's end of a job makes Lightning store
                logger=TensorBoardLogger(str(folder), name="", version="events"),
                val_check_interval=validate_every,
                num_sanity_val_steps=-int(
                    begun
                ),  # -1: all of it, as later ones; not where a run goes on
                log_every_n_steps=10,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
        except MisconfigurationException as error:
            raise ValueError(
                f"cannot train with device {accelerator}, devices {devices}, nodes {nodes}, strategy {strategy}: {error}"
            ) from error
        with claimed(
            folder, recipe, first=trainer.is_global_zero
        ):  # now that the training can begin
            # SLURM's end of a job leaves another state, newer than the last validation's
            left = [path for path in (last, *folder.glob("hpc_ckpt_*.ckpt")) if path.is_file()]
            newest = max(left, key=lambda path: path.stat().st_mtime_ns, default=None)
            try:
                trainer.fit(module, datamodule=data, ckpt_path=newest, weights_only=True)
                trainer.validate(module, datamodule=data, verbose=False)
            except SystemExit as end:
                # Lightning's answer to Ctrl-C, and, as another kind and as if all were done, to SIGTERM
                if type(end) is not SystemExit:
                    raise SystemExit(128 + signal.SIGTERM) from None
                if trainer.interrupted:
                    raise KeyboardInterrupt from None
                raise
            trainer.save_checkpoint(last)
