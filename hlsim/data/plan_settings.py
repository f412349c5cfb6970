"""What a plan is made of."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hlsim.checks import check_choice, check_rate
from hlsim.data.corpora import Layout
from hlsim.files import resolved

TRAIN_SNRS_DB, TEST_SNRS_DB = (0.0, 5.0, 10.0, 15.0), (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios in dB by active speech level: VoiceBank-DEMAND's, and the paper's."""


@dataclass(frozen=True)
class PlanSettings:
    """Corpus, noise, ears, levels and shares of a plan.

    Attributes:
        corpus, noise: folders; the noises are mixed into clean speech.
        root: folder that holds both; by default the corpus, or with noise their common parent.
        layout: the corpus's.
        table: CSV file that lists the corpus.
        train_snrs, test_snrs: dB by active speech level.
        train_types, test_types: how many types of noise, where there are as many.
        audiograms, test_audiograms: CSV files of ears; without any they are drawn.
        ears: an utterance.
        severities: proportions; None for equal ones of mild, moderate and severe, or as in the file.
        level: lowest and highest active speech level at which ears are given the speech, dB SPL.
        rate: of the instances, Hz.
        test_share, valid_share: of speakers, see ``assign_splits``.
        shortest: seconds; what is shorter is left out.
        seed: of every draw.
    """

    corpus: Path
    noise: Path | None = None
    root: Path | None = None
    layout: Layout = "auto"
    table: Path | None = None
    train_snrs: Sequence[float] = TRAIN_SNRS_DB
    test_snrs: Sequence[float] = TEST_SNRS_DB
    train_types: int = 8
    test_types: int = 2
    audiograms: Path | None = None
    test_audiograms: Path | None = None
    ears: int = 2
    severities: Mapping[str, float] | None = None
    level: tuple[float, float] = (65.0, 65.0)
    rate: int = 16000
    test_share: float = 0.1
    valid_share: float = 0.0
    shortest: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        check_choice("layout", self.layout, Layout)
        check_rate(self.rate)
        for name in ("test_share", "valid_share"):
            if not 0.0 <= (share := getattr(self, name)) < 1.0:
                raise ValueError(f"{name} {share}; allowed: 0 to less than 1")
        if min(self.ears, self.train_types, self.test_types) < 1 or self.shortest < 0.1:
            raise ValueError(
                f"ears {self.ears}, train_types {self.train_types}, test_types {self.test_types}, shortest "
                f"{self.shortest} s; allowed: counts from 1 up, 0.1 s or more"
            )
        low, high = self.level
        if not 20.0 <= low <= high <= 110.0:
            raise ValueError(f"level {low:g} to {high:g} dB SPL; allowed: ascending, 20 to 110")

    def places(self) -> tuple[Path, str, str]:
        """Root, and corpus and noise below it. Raises ValueError where they cannot be used."""
        folders = [resolved(folder) for folder in (self.corpus, self.noise) if folder is not None]
        for folder in folders:
            if not folder.is_dir():
                raise ValueError(f"{folder}: no such folder")
        if len(folders) > 1 and folders[0].is_relative_to(folders[1]):
            raise ValueError(
                f"noise {folders[1]}: holds the corpus, and its speech would be noise; allowed: a folder of noise alone"
            )
        root = resolved(self.root) if self.root else Path(os.path.commonpath(folders))
        if root == Path(root.anchor):
            raise ValueError(
                f"{folders[0]} and {folders[-1]} have only {root} in common; allowed: a --root"
            )
        for folder in folders:
            if not folder.is_relative_to(root):
                raise ValueError(f"{folder}: not in the root {root}; allowed: folders below it")
        names = [
            "" if folder == root else folder.relative_to(root).as_posix() for folder in folders
        ]
        return root, names[0], names[-1]
