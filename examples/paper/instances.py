"""The paper's training instances: every utterance of a corpus, clean and noisy, for several
ears."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import NEURO_RATE, PASCAL_SPL
from hlsim.data.clips import read_noisy
from hlsim.data.ears import draw_thresholds
from hlsim.data.manifest import Utterance
from hlsim.dsp.active_level import active_level_db
from hlsim.dsp.resample import resample
from hlsim.msbg import MSBG

_Input = Literal["clean", "noisy"]
"""Version of an utterance that an instance processes."""

_SEVERITIES = ("mild", "moderate", "severe")
"""Severities of the ears, which range "from mild to severe" in the paper."""

_EARS_PER_UTTERANCE = 2
"""Number of ears per utterance."""

_LEVEL = 65.0
"""Active level of the clean speech in dB SPL (ITU-T P.56)."""


class Instances(Dataset[dict[str, Tensor]]):
    """Data set of the paper's training instances at 16 kHz, computed on access.

    Each utterance has two ears. For each ear, there is one instance of the clean and one of the
    noisy version. An instance is a dictionary of four tensors:

    - ``signal``: clean or noisy speech in pascals with shape (time,), the input of the simulators
    - ``impaired``: output of the exact MSBG for it, time-aligned and in pascals
    - ``clean``: the same utterance without noise, time-aligned and in pascals
    - ``thresholds``: ear in dB HL with shape (8,)

    Args:
        utterances: Rows of a manifest, usually those of one split.
        root: Folder to which their paths are relative.
        ears: Ears, which are assigned to the utterances in turn, such as those of ``draw_ears``.

    >>> from hlsim.data.bundled import SPEECH
    >>> rows = [Utterance("train/flite-slt-01.flac")]
    >>> instances = Instances(rows, SPEECH, draw_ears(2, "train"))
    >>> len(instances), list(instances[0])
    (2, ['clean', 'signal', 'impaired', 'thresholds'])
    """

    def __init__(
        self,
        utterances: Sequence[Utterance],
        root: str | Path,
        ears: Sequence[Audiogram],
    ) -> None:
        self.root = Path(root)
        self.msbg = MSBG(sample_rate=NEURO_RATE)
        self.items: list[tuple[Utterance, Audiogram, _Input]] = []
        turns = cycle(ears)
        for utterance in utterances:
            inputs: Sequence[_Input] = ("clean", "noisy") if utterance.noisy else ("clean",)
            for ear in islice(turns, _EARS_PER_UTTERANCE):
                self.items += [(utterance, ear, name) for name in inputs]

    def __len__(self) -> int:
        return len(self.items)

    @torch.no_grad()
    def __getitem__(self, index: int) -> dict[str, Tensor]:
        utterance, ear, name = self.items[index]
        thresholds = torch.tensor(ear.thresholds)
        clean, noisy = self.read(utterance)
        signal = clean if name == "clean" else noisy
        # Few different lengths save time, because MSBG computes new filters for each length.
        padding = -len(signal) % (NEURO_RATE // 2)
        padded = functional.pad(signal, (0, padding))
        impaired = self.msbg(padded[None], thresholds[None])[0, : len(signal)]
        return {"clean": clean, "signal": signal, "impaired": impaired, "thresholds": thresholds}

    def read(self, utterance: Utterance) -> tuple[Tensor, Tensor]:
        """Read clean and noisy speech at the level of the instances.

        Returns:
            Clean speech and its noisy version (or the clean speech again), in pascals at 16 kHz
            with shape (time,).
        """
        clean, rate = read_audio(self.root / utterance.path)
        noisy = clean
        if utterance.noisy:
            noisy = read_noisy(self.root / utterance.noisy, clean, rate)
        gain_db = _LEVEL - PASCAL_SPL - active_level_db(clean[0], rate)
        pair = torch.stack((clean[0], noisy[0])) * 10.0 ** (gain_db / 20.0)
        clean, noisy = resample(pair, rate, NEURO_RATE)
        return clean, noisy


def draw_ears(count: int, split: str) -> list[Audiogram]:
    """Draw random ears with mild, moderate and severe losses in turn.

    No ear of the test split is in another split.

    Args:
        count: Number of ears.
        split: ``train``, ``valid`` or ``test``.

    >>> [ear.severity for ear in draw_ears(3, "train")]
    ['mild', 'moderate', 'severe']
    """
    generator = torch.Generator().manual_seed(zlib.crc32(split.encode()))
    unused: dict[str, list[Audiogram]] = {severity: [] for severity in _SEVERITIES}
    ears: list[Audiogram] = []
    while len(ears) < count:
        severity = _SEVERITIES[len(ears) % len(_SEVERITIES)]
        if unused[severity]:
            ears.append(unused[severity].pop())
            continue
        for levels in draw_thresholds(256, generator) + 0.0:  # The sum turns -0.0 into 0.0.
            ear = Audiogram(tuple(levels.tolist()))
            is_for_test = zlib.crc32(levels.numpy().tobytes()) % 3 == 0
            if ear.severity in unused and is_for_test == (split == "test"):
                unused[ear.severity].append(ear)
    return ears
