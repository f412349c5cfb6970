"""Training with Lightning: it can resume, saves the best network, and stops after a time limit."""

import copy
import io
import logging
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import Tensor

from hlsim.checkpoint import CONFIG, read_record, read_weights
from hlsim.files import lock_folder, write_atomically
from hlsim.progress import ProgressLine, clear_line
from hlsim.training.batches import MAX_DEVICES, BatchData
from hlsim.training.module import TrainingModule
from hlsim.version import __version__

_EXPECTED_WARNINGS = (
    "many workers|directory .* exists|not used|before the epoch ended|logging interval|LeafSpec"
)
"""Pattern of Lightning's warnings about choices that hlsim makes on purpose."""

STATE = "last.ckpt"
"""Name of the file with Lightning's state, from which a training continues."""

_RESULTS = {"start_validation", "minutes", "validation"}
"""Entries about the results of a training in its description, beside the steps taken."""


class BestCheckpoint(L.Callback):
    """Callback that saves the network with the highest validation score in a folder.

    The first candidate is the network before the first step. The others are those after each
    validation, when Lightning saves its state. The callback must come after that of the average of
    the weights.

    Args:
        folder: Folder to write, which ``load_pretrained`` or ``load_compensator`` reads.
        record: Entries about the training for the checkpoint's ``config.json``. Results of the
            first validation are added to it.

    Attributes:
        best_score: Highest validation score so far.

    >>> BestCheckpoint(Path("runs"), record={"seed": 0}).best_score
    -inf
    """

    def __init__(self, folder: Path, record: dict[str, Any]) -> None:
        self.folder = folder
        self.record = record
        self.best_score = -math.inf

    def on_sanity_check_end(self, trainer: L.Trainer, module: Any) -> None:
        self.record["start_validation"] = module.validation
        self._save_if_best(module, module.state_dict(), step=0, seconds=0.0)

    def on_save_checkpoint(
        self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]
    ) -> None:
        seconds = checkpoint["callbacks"]["Timer"]["time_elapsed"]["train"]
        self._save_if_best(module, checkpoint["state_dict"], checkpoint["global_step"], seconds)
        checkpoint |= {"best_score": self.best_score, "record": self.record}

    def on_load_checkpoint(
        self, trainer: L.Trainer, module: Any, checkpoint: dict[str, Any]
    ) -> None:
        self.best_score = checkpoint["best_score"]
        self.record = checkpoint["record"]

    def _save_if_best(
        self, module: Any, weights: Mapping[str, Tensor], step: int, seconds: float
    ) -> None:
        """Save a network, unless an earlier one has a higher or equal validation score.

        Args:
            module: The ``TrainingModule`` after its validation.
            weights: State dict of the module as it was validated.
            step: Number of steps taken.
            seconds: Duration of the training so far.
        """
        score = module.validation["score"]
        if score <= self.best_score:
            return
        self.best_score = score
        network = copy.deepcopy(module.network)
        network.load_state_dict(
            {name.removeprefix("network."): tensor for name, tensor in weights.items()}
        )
        record = {
            **self.record,
            "steps": step,
            "minutes": round(seconds / 60.0, 1),
            "validation": module.validation,
        }
        if module.trainer.is_global_zero:
            network.save_pretrained(self.folder, about=record)


class AtomicCheckpoints(TorchCheckpointIO):
    """Lightning's writer of states, each of which is written completely or not at all.

    Lightning's own one writes to the system's folder of temporary files. If this is on another
    disk, the file is then copied over the earlier state, and both are lost if the process is killed
    or the disk is full.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     AtomicCheckpoints().save_checkpoint({"step": 1}, f"{folder}/last.ckpt")
    ...     torch.load(f"{folder}/last.ckpt")
    {'step': 1}
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None
    ) -> None:
        contents = io.BytesIO()  # torch.save does not raise OSError if the disk is full
        torch.save(checkpoint, contents)
        write_atomically(path, contents.getvalue())


class StepProgress(L.Callback):
    """Callback that shows steps, remaining time, loss and score on stderr, see ``ProgressLine``.

    >>> StepProgress().line is None  # until the training starts
    True
    """

    def __init__(self) -> None:
        self.line: ProgressLine | None = None

    def setup(self, trainer: L.Trainer, module: Any, stage: str) -> None:
        if trainer.is_global_zero:
            self.line = ProgressLine("steps", "preparing the training", "validating").__enter__()

    def teardown(self, *_: Any, **__: Any) -> None:
        if self.line is not None:
            self.line.__exit__()
            self.line = None

    on_exception = teardown

    def on_train_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        if self.line is None:
            return
        metrics = trainer.callback_metrics
        values = [f"{name} {metrics[name]:.3f}" for name in ("loss", "score") if name in metrics]
        details = "".join(f"; {value}" for value in values)
        self.line(trainer.global_step, module.recipe.steps, details)

    def on_validation_batch_end(self, trainer: L.Trainer, module: Any, *_: Any) -> None:
        self.on_train_batch_end(trainer, module)

    def on_validation_epoch_end(self, trainer: L.Trainer, module: Any) -> None:
        clear_line(sys.stderr)  # The module prints the scores.


def train_network(
    module: TrainingModule,
    data: BatchData,
    *,
    out: str | Path,
    about: Mapping[str, Any],
    callbacks: Sequence[Callback] = (),
    max_minutes: float | None = None,
    **options: Any,
) -> Path:
    """Train a network, or resume its training, and save the weights with the best validation score.

    Args:
        module: Network, loss and recipe.
        data: Batches for training and validation.
        out: Folder for the checkpoint, Lightning's state and TensorBoard's events. If it contains a
            state, the training resumes from it.
        about: Description of data and teacher for the checkpoint's ``config.json``. A training
            resumes only with the same description, recipe, start network, number of devices and
            version of hlsim.
        callbacks: Additional callbacks of Lightning.
        max_minutes: Time limit in minutes, including the time before a resumption. A training that
            reaches it ends before the recipe's last step. By default, there is no limit.
        options: Options of Lightning's ``Trainer``, such as ``accelerator="cpu"`` and
            ``devices=2``. Each device draws a batch of its own at every step, so that N devices
            train with N batches per step. ``enable_progress_bar=True`` shows Lightning's progress
            bar instead of the steps and the remaining time.

    Returns:
        The folder ``checkpoint`` below ``out``. If all steps were taken before, nothing is done.

    Raises:
        ValueError: The folder contains another training, the same one with another number of
            devices, a trained network without a state, or a broken state; another process is
            writing to it; Lightning rejects an option, for example a device that does not exist;
            there are more than 64 devices; gradients would be accumulated; the loss is not finite;
            or a validation score is NaN.
        TypeError: An option is unknown, or is set by this function.
        KeyboardInterrupt: The training was interrupted. It resumes from its last validation.
    """
    recipe = module.recipe
    folder = Path(out)
    start = {"start_sha256": read_record(recipe.start)["sha256"]} if recipe.start else {}
    record = {"hlsim": __version__, "recipe": asdict(recipe), **start, **about}
    state = folder / STATE
    duration = None if max_minutes is None else timedelta(minutes=max_minutes)
    last = ModelCheckpoint(
        dirpath=folder,
        filename=state.stem,
        save_on_train_epoch_end=False,
        enable_version_counter=False,
    )
    best = BestCheckpoint(folder / "checkpoint", record)
    callbacks = [Timer(duration, verbose=False), *callbacks, best, last]
    if not options.setdefault("enable_progress_bar", False):
        callbacks.append(StepProgress())
    plugins = [*options.pop("plugins", ()), AtomicCheckpoints()]
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    with warnings.catch_warnings(), ExitStack() as locks:
        warnings.filterwarnings("ignore", f".*({_EXPECTED_WARNINGS})")
        try:
            trainer = L.Trainer(
                use_distributed_sampler=False,  # Each process draws its own batches.
                max_epochs=-1,
                max_steps=recipe.steps,
                limit_train_batches=recipe.steps,
                val_check_interval=recipe.validate_every,
                check_val_every_n_epoch=None,  # The interval may be longer than the training.
                num_sanity_val_steps=-1,  # A training begins with a validation.
                gradient_clip_val=1.0,
                callbacks=callbacks,
                plugins=plugins,
                enable_model_summary=False,
                logger=TensorBoardLogger(str(folder), name="", version="events"),
                **options,
            )
        except MisconfigurationException as error:
            raise ValueError(f"cannot train with {options}: {error}") from error
        if trainer.world_size > MAX_DEVICES:
            raise ValueError(
                f"expected {MAX_DEVICES} devices at most, because others would draw the same "
                f"batches, got {trainer.world_size}"
            )
        if trainer.is_global_zero:
            locks.enter_context(lock_folder(folder))
        record["devices"] = trainer.world_size
        is_resumption = state.exists()
        if not is_resumption:
            _check_no_network(best.folder)
        else:
            step = _check_state(state, record, best.folder)
            if step >= recipe.steps:
                trainer.print(f"the training has finished: all {step} steps were taken")
                return best.folder
            trainer.print(f"the training continues after step {step} of {recipe.steps}")
        try:
            ckpt_path = state if is_resumption else None
            trainer.fit(module, datamodule=data, ckpt_path=ckpt_path, weights_only=True)
        except SystemExit as error:  # Lightning exits after Ctrl-C.
            raise KeyboardInterrupt from error
        finally:
            clear_line(sys.stderr)
    return best.folder


def _check_no_network(folder: Path) -> None:
    """Raise ValueError if a folder without a state has a network that would be replaced.

    A network with 0 steps may be replaced: a training that ended before its first state leaves it.

    Args:
        folder: Folder of the best network.
    """
    if not (folder / CONFIG).exists():
        return
    steps = read_record(folder).get("about", {}).get("steps")
    if steps != 0:
        network = "the network" if steps is None else f"the network of a training ({steps} steps)"
        raise ValueError(
            f"{folder}: {network} would be replaced, and there is "
            f"no state ({STATE}) from which this training could continue, because it ended before "
            "its first state was saved, or the state was removed; move or remove the folder, or "
            "choose another output folder"
        )


def _differences(record: Mapping[str, Any], actual: Mapping[str, Any]) -> list[str]:
    """Return the names of the settings in which the descriptions of two trainings differ.

    Entries about the results of a training are not compared. The steps are those of the recipes.
    """
    settings = {**record, **record["recipe"]}
    actual_settings = {**actual, **actual["recipe"]}
    names = sorted({*settings, *actual_settings} - {"recipe", *_RESULTS})
    return [name for name in names if settings.get(name) != actual_settings.get(name)]


def _check_state(path: Path, record: Mapping[str, Any], best_folder: Path) -> int:
    """Validate that a file is the state of the training that should resume.

    Args:
        path: File of the state.
        record: Description of the training that should resume.
        best_folder: Folder of the best network of the training.

    Returns:
        The number of steps taken.

    Raises:
        ValueError: The state is damaged or belongs to another training, or the best network is
            missing or damaged.
    """
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
        actual, steps = contents["record"], int(contents["global_step"])
    except Exception as error:  # torch, zipfile and pickle raise various exceptions.
        raise ValueError(
            f"{path}: cannot be read as the state of a training; restore it, or choose another "
            "output folder"
        ) from error
    differences = _differences(record, actual)
    if differences:
        raise ValueError(
            f"{path}: the state belongs to a training that differs in {', '.join(differences)}; "
            "choose another output folder"
        )
    try:
        read_weights(best_folder)
    except ValueError as error:
        raise ValueError(
            f"the training cannot continue, because its best network is lost ({error}); restore "
            f"{best_folder}, or choose another output folder"
        ) from error
    return steps
