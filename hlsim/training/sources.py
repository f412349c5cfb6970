"""What a training is given to train and validate on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from hlsim.audio import find_audio
from hlsim.audiogram import read_audiograms


@dataclass(frozen=True)
class TrainingData:
    """Folders and files to train and validate on. Speech is all that is needed, a folder or a list of files.

    Without ``valid_speech`` validation is on the training speech, and says nothing of other speakers; without the other
    two it takes training's noise and ears. Ears from the CSV files join the drawn ones.
    """

    speech: Path | Sequence[Path]
    noise: Path | None = None
    audiograms: Path | None = None
    valid_speech: Path | Sequence[Path] | None = None
    valid_noise: Path | None = None
    valid_audiograms: Path | None = None

    def validation(self) -> TrainingData:
        """The same, with what there is to validate on in the place of what there is to train on.

        Raises:
            ValueError: speech or noise to validate on is also trained on.
        """
        refuse_shared("speech", self.speech, self.valid_speech)
        refuse_shared("noise", self.noise, self.valid_noise)
        return TrainingData(
            self.valid_speech or self.speech,
            self.valid_noise or self.noise,
            self.valid_audiograms or self.audiograms,
        )


def refuse_shared(
    name: str, training: Path | Sequence[Path] | None, validation: Path | Sequence[Path] | None
) -> None:
    """Raises ValueError where files are both trained and validated on: the best checkpoint would be chosen on them."""
    if not training or not validation:
        return
    trained, validated = (
        {path.resolve() for path in (find_audio(source) if isinstance(source, str | Path) else source)}
        for source in (training, validation)
    )
    if count := len(trained & validated):
        raise ValueError(
            f"{count} of {len(validated)} files of the {name} to validate on are also trained on; give folders that "
            f"share none, or no {name} to validate on"
        )


def read_thresholds(path: Path | None) -> Tensor | None:
    """The ears of a CSV file. Shape: -> (ears, 8) dB HL, or None without a file."""
    if path is None:
        return None
    return torch.tensor([ear.thresholds for _, ear in read_audiograms(path, simulated=True)])
