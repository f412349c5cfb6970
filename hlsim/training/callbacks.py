"""What happens beside the steps: the best checkpoint kept, lines printed, sounds and the wait for data in TensorBoard."""

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.files import write_whole
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.state import CHECKPOINT

_RANGE_SPL = (0.0, 70.0)  # dB SPL of a bin that are black and white
_WINDOW = 20  # steps over which the time spent waiting for data is averaged


class KeepBest(Callback):
    """Writes the released form of the model whenever the validation score is the best so far.

    The score is also kept in ``note``: the state that a killed run goes on from may be older than its last validation.
    """

    def __init__(self, write: Callable[[dict[str, Any]], None], note: Path) -> None:
        self.write, self.note, self.best = write, note, -math.inf

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        if not (self.note.parent / CHECKPOINT).is_dir():
            return  # the next one is the best there is
        self.best = float(state_dict["best"])
        # there may be none, or one that a crash broke
        with contextlib.suppress(OSError, ValueError, TypeError, LookupError):
            self.best = max(
                self.best, float(json.loads(self.note.read_text(encoding="utf-8"))["best"])
            )

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        kept = ("score", "valid_")
        figures = {
            name: float(v) for name, v in trainer.callback_metrics.items() if name.startswith(kept)
        }
        score = figures.pop("score", -math.inf)
        if trainer.is_global_zero and score > self.best:
            self.best = score
            minutes = 0.0 if trainer.sanity_checking else round(_minutes(module), 1)
            self.write({"steps": trainer.global_step, "minutes": minutes, "validation": figures})
            write_whole(self.note, json.dumps({"best": score}))


class History(Callback):
    """Prints a line a validation, in one of the processes, with the minutes of all resumed parts."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.report = report

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            metrics = trainer.callback_metrics.items()
            figures = ", ".join(
                f"{name} {float(value):.3f}" for name, value in metrics if name != "score"
            )
            self.report(f"step {trainer.global_step}, {_minutes(module):.1f} min: {figures}")


class StepProgress(Callback):
    """A line that shows the share of the steps done, every two seconds."""

    def __init__(self, steps: int) -> None:
        self.steps, self.shown = steps, 0.0

    def on_train_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, *of_batch: Any
    ) -> None:
        if not trainer.is_global_zero or time.monotonic() - self.shown < 2.0:
            return
        self.shown = time.monotonic()
        share = 100.0 * trainer.global_step / self.steps
        loss = float(trainer.callback_metrics.get("loss", math.nan))
        line = f"{share:3.0f} %, step {trainer.global_step} of {self.steps}, loss {loss:.3f}"
        print(f"\r{line:<60}", end="", file=sys.stderr, flush=True)

    def on_validation_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            print(f"\r{'':<60}", end="\r", file=sys.stderr, flush=True)


class DataWait(Callback):
    """Logs ``data_wait``, the share of a step's time that is spent waiting for data."""

    def __init__(self) -> None:
        self.marks: list[tuple[float, float]] = []

    def on_train_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, *of_batch: Any
    ) -> None:
        # from the second step on, for the first one waits until the workers have started
        waited = trainer.datamodule.loader.waited  # type: ignore[attr-defined]
        self.marks = [*self.marks[-_WINDOW:], (time.perf_counter(), waited)]
        (began, before), (now, waited) = self.marks[0], self.marks[-1]
        if now > began:
            module.log("data_wait", (waited - before) / (now - began))

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        self.marks = []  # that was no step


class ShowExamples(Callback):
    """Writes what the module's ``examples(batch)`` gives for the first validation batch: signals by name, (time,) in
    pascals at 16 kHz."""

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        *more: int,
    ) -> None:
        writer: Any = getattr(trainer.logger, "experiment", None)
        if batch_idx or not trainer.is_global_zero or not hasattr(writer, "add_audio"):
            return
        with torch.no_grad():
            signals: dict[str, Tensor] = module.examples(batch)  # type: ignore[operator]
        # what is heard may be inaudible as played: each sound is as loud as it can be, the picture tells the level
        for name, signal in signals.items():
            sound = signal.detach().float().cpu()
            writer.add_audio(
                name, sound / sound.abs().max().clamp_min(1e-9), trainer.global_step, NEURO_RATE
            )
            writer.add_image(name, spectrogram_image(sound), trainer.global_step)


def spectrogram_image(signal: Tensor) -> Tensor:
    """Log magnitude, 0 to 70 dB SPL a bin as black to white. Shape: (time,) -> (1, frequencies, frames), top is 8 kHz."""
    points = NEURO_RATE // 50
    window = torch.hann_window(points)
    padded = torch.nn.functional.pad(signal, (0, max(0, points - len(signal))))
    spectrum = torch.stft(padded, points, points // 4, window=window, return_complex=True)
    level = 20.0 * torch.log10(spectrum.abs() * 2.0**0.5 / window.sum() + 1e-9) + PASCAL_SPL
    low, high = _RANGE_SPL
    return ((level - low) / (high - low)).clamp(0.0, 1.0).flip(0).unsqueeze(0)


def _minutes(module: L.LightningModule) -> float:
    """Of training, all resumed parts together."""
    return module.timer.time_elapsed("train") / 60.0  # type: ignore[union-attr,operator]
