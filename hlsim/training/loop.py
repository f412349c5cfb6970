"""One way to run a training: time-boxed, resumable, with progress, TensorBoard and the best checkpoint kept."""

import contextlib
import json
import logging
import math
import signal
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, Timer
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from hlsim.files import repair_folder, write_whole
from hlsim.training.examples import ShowExamples
from hlsim.training.state import BEST, CHECKPOINT, LAST, WholeStates, claim


class Counter(Dataset[int]):
    """Numbers its items: the modules here make their own batches from a seed and the step."""

    def __init__(self, length: int) -> None:
        self.length = length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> int:
        return index


class TimedModule(L.LightningModule):
    """A module whose learning rate falls with the time spent, as half a cosine after a short rise.

    Subclasses give ``training_loss`` and ``validate``, and log whatever they like.

    Args:
        learning_rate: at its highest.
        max_minutes: of training, all resumed parts together.
        seed: of every random draw.
    """

    timer: Timer
    datamodule: L.LightningDataModule | None = None
    """Where batches come from, in a module that does not make its own."""

    def __init__(self, learning_rate: float, max_minutes: float, seed: int) -> None:
        super().__init__()
        self.learning_rate = learning_rate
        self.max_minutes = max_minutes
        self.seed = seed

    def training_loss(self, generator: torch.Generator) -> Tensor:
        """Loss of a new random batch."""
        raise NotImplementedError

    def validate(self) -> dict[str, float]:
        """Figures by name; ``score`` is what the best checkpoint has most of."""
        raise NotImplementedError

    def examples(self) -> dict[str, Tensor]:
        """Signals for TensorBoard by name, (time,) in pascals at 16 kHz."""
        return {}

    def trained_parameters(self) -> list[torch.nn.Parameter]:
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def training_step(self, batch: Tensor, index: int) -> Tensor:
        number = (self.seed * 1_000_003 + self.global_step) * 64 + self.global_rank
        generator = torch.Generator().manual_seed(number % 2**63)  # more are too many for it
        loss = self.training_loss(generator)
        if not bool(torch.isfinite(loss)):
            raise ValueError(
                f"the loss is {float(loss.detach())} at step {self.global_step}; a lower learning rate may help"
            )
        self.log("loss", loss, prog_bar=True)
        return loss

    def on_train_batch_start(self, batch: Tensor, index: int) -> None:
        # one clock for all processes, whose weights would drift apart
        spent = self.trainer.strategy.broadcast(self.timer.time_elapsed("train"))
        share = min(1.0, spent / (60.0 * self.max_minutes))
        rise = min(1.0, (self.global_step + 1) / 50.0)
        for group in self.optimizers().param_groups:  # type: ignore[union-attr]
            group["lr"] = self.learning_rate * rise * max(0.01, 0.5 * (1.0 + math.cos(math.pi * share)))

    def validation_step(self, batch: Tensor, index: int) -> None:
        figures = self.validate()
        self.log_dict(figures, prog_bar=True, batch_size=1, sync_dist=True)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.AdamW(self.trained_parameters(), lr=self.learning_rate, weight_decay=1e-4)


class KeepBest(Callback):
    """Writes the released form of the model whenever the validation score is the best so far.

    The score is also kept in ``note``: the state that a killed run goes on from may be older than its last validation.
    """

    def __init__(self, write: Callable[[dict[str, Any]], None], note: Path) -> None:
        self.write = write
        self.note = note
        self.best = -math.inf

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if not (self.note.parent / CHECKPOINT).is_dir():
            return  # the next one is the best there is
        self.best = float(state_dict["best"])
        # there may be none, or one that a crash broke
        with contextlib.suppress(OSError, ValueError, TypeError, LookupError):
            self.best = max(self.best, float(json.loads(self.note.read_text(encoding="utf-8"))["best"]))

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        kept = ("score", "valid_")
        figures = {name: float(v) for name, v in trainer.callback_metrics.items() if name.startswith(kept)}
        score = figures.pop("score", -math.inf)
        if trainer.is_global_zero and score > self.best:
            self.best = score
            assert isinstance(module, TimedModule)
            minutes = module.timer.time_elapsed("train") / 60.0 if not trainer.sanity_checking else 0.0
            self.write({"steps": trainer.global_step, "minutes": round(minutes, 1), "validation": figures})
            write_whole(self.note, json.dumps({"best": score}))


class History(Callback):
    """Prints a line a validation, in one of the processes, with the minutes of all resumed parts."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.report = report

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if not trainer.is_global_zero:
            return
        figures = ", ".join(
            f"{name} {float(value):.3f}"
            for name, value in trainer.callback_metrics.items()
            if name != "score"
        )
        assert isinstance(module, TimedModule)
        minutes = module.timer.time_elapsed("train") / 60.0
        self.report(f"step {trainer.global_step}, {minutes:.1f} min: {figures}")


class TimeProgress(Callback):
    """A line that shows the share of the time spent, every two seconds: the number of steps is not known beforehand."""

    def __init__(self) -> None:
        self.shown = 0.0

    def on_train_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        assert isinstance(module, TimedModule)
        if not trainer.is_global_zero or time.monotonic() - self.shown < 2.0:
            return
        self.shown = time.monotonic()
        spent = module.timer.time_elapsed("train") / 60.0
        share = min(100.0, 100.0 * spent / module.max_minutes)
        loss = float(trainer.callback_metrics.get("loss", math.nan))
        line = f"{share:3.0f} % of {module.max_minutes:g} min, step {trainer.global_step}, loss {loss:.3f}"
        print(f"\r{line:<60}", end="", file=sys.stderr, flush=True)

    def on_validation_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            print(f"\r{'':<60}\r", end="", file=sys.stderr, flush=True)


def run(
    module: TimedModule,
    *,
    out: str | Path,
    recipe: Mapping[str, Any],
    write: Callable[[dict[str, Any]], None],
    validate_every: int,
    begun: bool = False,
    max_steps: int = -1,
    accelerator: str = "auto",
    devices: int = 1,
    nodes: int = 1,
    strategy: str = "auto",
    report: Callable[[str], None] = print,
    progress: bool = True,
) -> None:
    """Train until the time is up; go on from ``out`` where a run of the same recipe lies there.

    Args:
        out: folder for ``last.ckpt``, TensorBoard's events and what ``write`` puts there.
        recipe: what makes this run this run; it is kept in ``recipe.json``.
        write: stores the released form of the model, given the figures of its validation.
        validate_every: steps from validation to validation; a kill loses no more than these and their validation.
        begun: with weights that are worth keeping: they are validated too, and the best until others are better.
        max_steps: stop earlier, -1 for no such limit.
        accelerator, devices, nodes, strategy: as Lightning's Trainer takes them; each process draws batches of its own,
            so that the batch grows with their number.

    Raises:
        ValueError: ``out`` holds a run of another recipe or a broken state, there is no such device, the loss is not
            finite, or the disk is full.
        KeyboardInterrupt: it was stopped; the state is that of the last validation.
    """
    if max_steps < -1:
        raise ValueError(f"max_steps {max_steps}; allowed: whole numbers from 0 up, or -1 for no such limit")
    folder = Path(out)
    last = folder / LAST
    module.timer = Timer(timedelta(minutes=module.max_minutes), interval="step", verbose=False)
    states = ModelCheckpoint(
        dirpath=folder,
        filename="last",
        save_top_k=1,
        enable_version_counter=False,
        # at the end of each validation, not before it: a run that goes on from a state does not validate it
        save_on_train_epoch_end=False,
    )
    callbacks: list[Callback] = [
        module.timer,
        KeepBest(write, folder / BEST),
        History(report),
        ShowExamples(),
        states,
    ]
    if progress:
        callbacks.append(TimeProgress())
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
                max_epochs=-1,  # steps and time limit it; an epoch that is over would not be resumed
                max_steps=max_steps,
                gradient_clip_val=1.0,
                callbacks=callbacks,
                default_root_dir=str(folder),  # for what SLURM's end of a job makes Lightning store
                logger=TensorBoardLogger(str(folder), name="", version="events"),
                val_check_interval=validate_every,
                num_sanity_val_steps=int(begun),  # not where a run goes on
                log_every_n_steps=10,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
        except MisconfigurationException as error:
            raise ValueError(
                f"cannot train with device {accelerator}, devices {devices}, nodes {nodes}, strategy {strategy}: {error}"
            ) from error
        claim(folder, recipe)  # now that the training can begin
        repair_folder(folder / CHECKPOINT)
        # SLURM's end of a job leaves its own, newer than the last validation's
        left = [path for path in (last, *folder.glob("hpc_ckpt_*.ckpt")) if path.is_file()]
        newest = max(left, key=lambda path: path.stat().st_mtime_ns, default=None)
        own = module.datamodule is None
        try:
            trainer.fit(
                module,
                DataLoader(Counter(10_000_000), batch_size=None) if own else None,
                DataLoader(Counter(1), batch_size=None) if own else None,
                datamodule=module.datamodule,
                ckpt_path=str(newest) if newest else None,
                weights_only=True,
            )
            trainer.validate(module, DataLoader(Counter(1), batch_size=None), verbose=False)
        except SystemExit as end:
            # Lightning's answer to Ctrl-C, and, as a kind of its own and as if all were done, to SIGTERM
            if type(end) is not SystemExit:
                raise SystemExit(128 + signal.SIGTERM) from None
            if trainer.interrupted:
                raise KeyboardInterrupt from None
            raise
    trainer.save_checkpoint(last)
