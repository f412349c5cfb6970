"""Sounds and spectrograms of a few examples in TensorBoard, after each validation."""

from collections.abc import Mapping
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.neuro.config import NEURO_RATE

_RANGE_SPL = (0.0, 70.0)  # dB SPL of a bin that are black and white


class ShowExamples(Callback):
    """Writes what the module's ``examples()`` gives: signals by name, (time,) in pascals at 16 kHz."""

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        writer: Any = getattr(trainer.logger, "experiment", None)
        if not trainer.is_global_zero or not hasattr(writer, "add_audio"):
            return
        with torch.no_grad():
            signals: Mapping[str, Tensor] = module.examples()  # type: ignore[operator]
        # what is heard may be inaudible as played: each sound is as loud as it can be, the picture tells the level
        for name, signal in signals.items():
            sound = signal.detach().float().cpu()
            writer.add_audio(name, sound / sound.abs().max().clamp_min(1e-9), trainer.global_step, NEURO_RATE)
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
