"""Fixtures that several tests of training share."""

from pathlib import Path

import pytest

pytest.importorskip("lightning")

from hlsim.training.batches import TrainingData


@pytest.fixture
def data(speech_dir: Path) -> TrainingData:
    """Embedded speech, validated on other speakers."""
    return TrainingData(speech_dir / "train", valid_speech=speech_dir / "valid")
