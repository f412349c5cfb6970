"""The instances of a prepared plan: one function makes them, whether on the fly or for the disk."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn import functional

from hlsim.audio import read_audio, read_stretch
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.calibration import PASCAL_SPL
from hlsim.checks import check_rate
from hlsim.data.manifest import UTTERANCE_COLUMNS, Rows, Utterance, inside
from hlsim.data.noises import mix_at
from hlsim.dsp.resample import resample
from hlsim.files import sha256

MANIFEST, INSTANCES, SETTINGS = "manifest.csv", "instances.csv", "plan.json"
"""Names in a prepared folder."""

CLAIM = "instances/made-of.txt"
"""What the instances in a prepared folder are made of: the plan's digest, and how."""

_EAR = (f"hl_{frequency:g}" for frequency in FREQUENCIES)
INSTANCE_COLUMNS = ("number", "id", "split", "input", "level", "severity", *_EAR)


@dataclass(frozen=True)
class Instance:
    """What an ear is given and hears, in pascals, time-aligned and equally long.

    Attributes:
        clean: the reference. Shape: (time,).
        signal: the normal-hearing input, clean or noisy. Shape: (time,).
        thresholds: of the ear, dB HL. Shape: (8,).
        impaired: what the ear hears of ``signal``; None where a teacher is still to say. Shape: (time,).
    """

    clean: Tensor
    signal: Tensor
    thresholds: Tensor
    impaired: Tensor | None = None

    def clip(self, first: int, samples: int) -> Instance:
        """``samples`` samples from ``first`` on, followed by silence where it is shorter."""

        def cut(value: Tensor) -> Tensor:
            piece = value[first : first + samples]
            return functional.pad(piece, (0, samples - piece.shape[-1]))

        impaired = None if self.impaired is None else cut(self.impaired)
        return Instance(cut(self.clean), cut(self.signal), self.thresholds, impaired)

    def to_bytes(self) -> bytes:
        """A safetensors file; equal instances give equal bytes."""
        return save({name: value.clone().contiguous() for name, value in vars(self).items()})

    @classmethod
    def read(cls, path: str | Path) -> Instance:
        """Raises ValueError where the file is missing or broken."""
        try:
            return cls(**load_file(path))
        except (OSError, SafetensorError, TypeError) as error:
            raise ValueError(
                f"{path}: no instance ({error}); 'hlsim prepare --write' makes them"
            ) from error


class Plan:
    """A folder that ``hlsim prepare`` made: its utterances and instances, read when asked for.

    Args:
        folder: the folder, or its ``manifest.csv``.
        root: where the audio lies, if not where it was prepared.

    Attributes:
        each: instances of an utterance.

    Raises:
        ValueError: the folder is no such plan.
    """

    def __init__(self, folder: str | Path, root: str | Path | None = None) -> None:
        self.folder = Path(folder).parent if Path(folder).name == MANIFEST else Path(folder)
        try:
            about = json.loads((self.folder / SETTINGS).read_text(encoding="utf-8"))
            self.root = Path(root if root is not None else about["root"])
            self.rate = check_rate(about["settings"]["rate"])
            self.each = len(about["inputs"]) * int(about["settings"]["ears"])
            # neither table has the rate
            self.digest: str = (
                f"{about['manifest_sha256']}{about['instances_sha256']} at {self.rate} Hz"
            )
        except (OSError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise ValueError(
                f"{self.folder}: not prepared ({error}); 'hlsim prepare' makes it"
            ) from error
        self.utterances = Rows(self.folder / MANIFEST, UTTERANCE_COLUMNS)
        self.rows = Rows(self.folder / INSTANCES, INSTANCE_COLUMNS)
        self._last = (
            -1,
            torch.empty(0),
        )  # an utterance is wanted as often as it has instances, and in a row
        if len(self.rows) != len(self.utterances) * self.each:
            found = f"{len(self.rows)} instances of {len(self.utterances)} utterances"
            raise ValueError(f"{self.folder}: {found}; allowed: {self.each} of each")
        for path in (self.folder / MANIFEST, self.folder / INSTANCES):
            if sha256(path) != about[f"{path.stem}_sha256"]:
                raise ValueError(
                    f"{path}: has changed since it was prepared; 'hlsim prepare' makes it anew"
                )

    def __len__(self) -> int:
        return len(self.rows)

    def indices(self, split: str) -> Tensor:
        """Numbers of the instances of a split. Shape: -> (instances,), int64."""
        return self._splits.get(split, torch.empty(0, dtype=torch.int64))

    @cached_property
    def _splits(self) -> dict[str, Tensor]:
        places: dict[str, list[int]] = {}
        for index, row in enumerate(self.rows):
            places.setdefault(row["split"], []).append(index)
        return {name: torch.tensor(found) for name, found in places.items()}

    def utterance(self, index: int) -> Utterance:
        return Utterance.from_row(self.utterances[index // self.each])

    def thresholds(self, index: int) -> Tensor:
        """Of an instance's ear, dB HL. Shape: -> (8,)."""
        return torch.tensor(Audiogram.from_row(self.rows[index]).thresholds)

    def pair(self, index: int) -> tuple[Tensor, Tensor]:
        """Clean and noisy speech of an instance's utterance at the plan's rate and the instance's level, in pascals.

        Noise is mixed in at the rate of the files, so that its level counts all its bands; a plan without noise gives the
        clean speech twice.

        Shape: -> (time,) twice.

        Raises:
            ValueError: a file that can no longer be used, or a path that leads out of the root.
        """
        utterance, key = self.utterance(index), index // self.each
        if self._last[0] != key:
            self._last = (key, self._read(utterance))
        level = float(self.rows[index]["level"])
        clean, noisy = self._last[1] * 10.0 ** (
            (level - PASCAL_SPL - utterance.active_level) / 20.0
        )
        return clean, noisy

    def _read(self, utterance: Utterance) -> Tensor:
        """Clean and noisy as they are in the files. Shape: -> (2, time) at the plan's rate."""
        path = inside(self.root, utterance.clean)
        (clean, *_), rate = read_audio(path)
        noisy = clean
        if utterance.noisy:
            noisy = read_audio(inside(self.root, utterance.noisy))[0][0]
        elif utterance.mixed:
            assert utterance.snr is not None
            noise = self.noise(utterance, len(clean), rate)
            noisy = mix_at(clean, noise, utterance.snr, utterance.active_level)
        # the manifest has six digits of the seconds
        same_length = math.isclose(len(clean) / rate, utterance.seconds, rel_tol=1e-5)
        if noisy.shape != clean.shape or rate != utterance.rate or not same_length:
            raise ValueError(f"{path}: has changed since it was prepared")
        return resample(torch.stack((clean, noisy)), rate, self.rate)

    def noise(self, utterance: Utterance, samples: int, rate: int) -> Tensor:
        """As long a piece as asked of the noise that an utterance is mixed with. Shape: -> (samples,)."""
        start = utterance.noise_start or 0.0
        # a little more, for resampling rounds
        noise, file_rate = read_stretch(
            inside(self.root, utterance.noise), start, samples / rate + 0.01
        )
        return resample(noise[0], file_rate, rate)[:samples]

    def instance(self, index: int) -> Instance:
        """Without ``impaired``. Raises ValueError as ``pair``."""
        clean, noisy = self.pair(index)
        signal = noisy if self.rows[index]["input"] == "noisy" else clean
        return Instance(clean, signal, self.thresholds(index))

    def path(self, index: int) -> Path:
        return self.folder / "instances" / f"{index // 1000:05d}" / f"{index:08d}.safetensors"


def is_whole(path: Path) -> bool:
    """Whether a file is an instance, as far as its head and its length tell."""
    try:
        with safe_open(path, "pt") as file:
            return {*file.keys()} == {field.name for field in fields(Instance)}
    except (OSError, SafetensorError):
        return False
