"""Callbacks of a training: averaged weights, the best network as a checkpoint folder, examples, and a progress bar."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import (
    Callback,
    ModelCheckpoint,
    TQDMProgressBar,
    WeightAveraging,
)
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.neuro.config import NEURO_RATE

IMAGE_RANGE_SPL = (0.0, 70.0)
"""Levels in dB SPL per frequency that are black and white in a spectrogram."""


class WeightAverage(WeightAveraging):
    """Exponential moving average of the weights, which is what is validated and saved.

    Args:
        decay: weight of the past, from 0 to below 1.
    """

    def __init__(self, decay: float) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=average_function(decay))


def average_function(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Any], None]:
    """Make the function with which ``AveragedModel`` updates its weights.

    Lightning's ``EMAWeightAveraging`` has one decay throughout. Here the early decay is lower, (1 + n) / (10 + n) after
    n steps, so that a short training forgets its random initial weights.
    """

    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], steps: Any) -> None:
        present = 1.0 - min(decay, (1.0 + float(steps)) / (10.0 + float(steps)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight.to(average), present)

    return update


class BestCheckpoint(ModelCheckpoint):
    """Lightning's state with the highest validation score, and its network as a folder that hlsim loads.

    Args:
        folder: folder for ``best.ckpt``.
        release: writes the network's folder, given its weights, the step and the validation.
        score_to_beat: score below which nothing is released.
    """

    def __init__(
        self,
        folder: Path,
        release: Callable[[Mapping[str, Tensor], int, Mapping[str, float]], None],
        score_to_beat: float = -math.inf,
    ) -> None:
        super().__init__(
            dirpath=folder,
            filename="best",
            monitor="score",
            mode="max",
            save_on_train_epoch_end=False,
            enable_version_counter=False,
        )
        self.release = release
        self.score_to_beat = score_to_beat

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        previous_score = self.best_model_score
        super().on_validation_end(trainer, module)
        score = self.best_model_score
        if not trainer.is_global_zero or score is None or score is previous_score:
            return
        if float(score) > self.score_to_beat:
            state = torch.load(self.best_model_path, map_location="cpu", weights_only=True)
            prefix = "network."
            weights = {
                name.removeprefix(prefix): tensor
                for name, tensor in state["state_dict"].items()
                if name.startswith(prefix)
            }
            self.release(weights, state["global_step"], state["validation"])


class ShowExamples(Callback):
    """Sounds and spectrograms of the module's ``examples``, for TensorBoard."""

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        module: Any,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        logger: Any = trainer.logger
        if batch_idx > 0 or logger is None or not trainer.is_global_zero:
            return
        writer = logger.experiment
        with torch.no_grad():
            examples = module.examples(batch)
        for name, signal in examples.items():
            sound = signal.detach().float().cpu()
            # what an ear perceives may be too soft to be played; the spectrogram shows the level
            loud = sound / sound.abs().max().clamp_min(1e-9)
            writer.add_audio(name, loud, trainer.global_step, NEURO_RATE)
            writer.add_image(name, spectrogram_image(sound), trainer.global_step)


class ProgressBar(TQDMProgressBar):
    """Lightning's progress bar, without numbers of epochs and versions: a training is one epoch."""

    def get_metrics(self, trainer: L.Trainer, module: L.LightningModule) -> dict[str, Any]:
        metrics: dict[str, Any] = super().get_metrics(trainer, module)
        metrics.pop("v_num", None)
        return metrics

    def on_train_epoch_start(self, trainer: L.Trainer, *arguments: Any) -> None:
        super().on_train_epoch_start(trainer, *arguments)
        self.train_progress_bar.set_description("Training")


def spectrogram_image(signal: Tensor) -> Tensor:
    """Draw a spectrogram, from black at 0 to white at 70 dB SPL per frequency.

    Shape: (time,) in pascals -> (1, frequencies, frames), with 8 kHz at the top.
    """
    points = NEURO_RATE // 50
    window = torch.hann_window(points)
    padded = torch.nn.functional.pad(signal, (0, max(0, points - len(signal))))
    spectrum = torch.stft(padded, points, points // 4, window=window, return_complex=True)
    rms = spectrum.abs() * 2.0**0.5 / window.sum()
    level = 20.0 * torch.log10(rms + 1e-9) + PASCAL_SPL
    low, high = IMAGE_RANGE_SPL
    return ((level - low) / (high - low)).clamp(0.0, 1.0).flip(0).unsqueeze(0)
