"""Sounds and spectrograms for TensorBoard."""

from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("tensorboard")

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hlsim.calibration import set_level
from hlsim.training.batches import TrainingData
from hlsim.training.callbacks import spectrogram_image
from hlsim.training.recipes import SimulatorRecipe
from hlsim.training.simulator import train_simulator


def test_a_tone_is_a_line_at_its_frequency_and_silence_is_black() -> None:
    tone = set_level(torch.sin(2.0 * torch.pi * 2000.0 * torch.arange(16000) / 16000.0), 60.0)
    image = spectrogram_image(tone)
    assert image.shape[:2] == (1, 161) and float(image.min()) >= 0.0 and float(image.max()) <= 1.0
    row = int(image[0, :, 20:-20].mean(-1).argmax())
    assert row == 160 - 40  # 50 Hz a row, the highest frequency first
    assert float(image[0, row, 50]) == pytest.approx(60.0 / 70.0, abs=0.01)
    assert not bool(spectrogram_image(torch.zeros(50)).any())


def test_a_training_shows_what_was_given_and_heard(tmp_path: Path, speech_dir: Path) -> None:
    recipe: dict[str, Any] = {
        "model": {"channels": 4, "blocks": 1},
        "batch": 1,
        "seconds": 0.2,
        "validate_every": 1,
        "validation_items": 8,
    }
    train_simulator(
        TrainingData(speech_dir / "train"),
        SimulatorRecipe.from_dict(recipe),
        out=tmp_path,
        max_steps=1,
        accelerator="cpu",
        report=lambda line: None,
        progress=False,
    )
    kept = EventAccumulator(str(tmp_path / "events"))
    kept.Reload()
    names = {"given", "heard/truth", "heard/network"}
    assert set(kept.Tags()["audio"]) == names and set(kept.Tags()["images"]) == names
    assert kept.Audio("heard/truth")[0].sample_rate == 16000.0
