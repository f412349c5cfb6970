"""Scores of one utterance in one ear under every condition, failed ones, and the better of two ears'."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EARS

_JSON = (
    *(
        "file",
        "listener",
        "ear",
        "snr",
        "before",
        "after",
        "clean_level",
        "before_level",
        "after_level",
    ),
    *("full_scale_spl", "severity", "sample_rate", "seconds", "seed"),
)


@dataclass(frozen=True)
class ItemScore:
    """Scores of one utterance in one ear, with the levels (dB SPL) of what was scored.

    Args:
        levels: of what the ear was given, by condition, in their order; None where a file could not be read.
        scores: by measure and condition; what could not be scored is not in it. Each needs a level, or ValueError.
        full_scale_spl: level in dB SPL that a file of RMS 1.0 was taken to have.
        seed: of the noise that HASPI and HASQI add, the same under every condition.
        listener, ear: whose ear and which; empty where unknown.
        snr: of the speech in noise in dB, where known.
        clean, processed: files, for players and spectrograms; not part of ``report.json``.

    Attributes:
        before, after: the first measure's scores under the first and last condition, where there are any.
        before_level, after_level: of these conditions.
    """

    file: str
    audiogram: Audiogram
    clean_level: float
    levels: Mapping[str, float | None]
    scores: Mapping[str, Mapping[str, float]]
    sample_rate: int
    seconds: float
    seed: int
    full_scale_spl: float = 94.0
    listener: str = ""
    ear: str = ""
    snr: float | None = None
    clean: Path | None = None
    processed: Mapping[str, Path] = field(default_factory=dict)

    before: float | None = field(init=False)
    after: float | None = field(init=False)
    before_level: float | None = field(init=False)
    after_level: float | None = field(init=False)
    severity: str = field(init=False)

    def __post_init__(self) -> None:
        for condition in {name for found in self.scores.values() for name in found}:
            if self.levels.get(condition) is None:
                raise ValueError(
                    f"{self.file}: a score under {condition!r} without its level; a score needs one"
                )
        first: Mapping[str, float] = next(iter(self.scores.values()), {})
        names = [*self.levels] or [""]
        before, after = names[0], names[-1]
        vars(self).update(  # of a frozen dataclass
            before=first.get(before),
            after=first.get(after),
            before_level=self.levels.get(before),
            after_level=self.levels.get(after),
            severity=self.audiogram.severity,
        )

    def to_dict(self) -> dict[str, Any]:
        """A plain dictionary that JSON can hold."""
        return {name: getattr(self, name) for name in _JSON} | {
            "scores": {measure: dict(found) for measure, found in self.scores.items()},
            "levels": dict(self.levels),
            "audiogram": self.audiogram.to_dict(),
        }


@dataclass(frozen=True)
class Failure:
    """A score that could not be made, and why."""

    file: str
    condition: str
    measure: str
    reason: str


def check_both_ears(items: Iterable[tuple[str, str, str]]) -> None:
    """Refuse items (what each is called, listener, ear) unless each has its other ear's: there is no better of one.

    Raises:
        ValueError: an item of neither a left nor a right ear, two of one name, or one whose other ear is not there.
    """
    found: dict[tuple[str, str], set[str]] = {}
    for file, listener, ear in items:
        if ear not in EARS:
            raise ValueError(f"{file}: ear is {ear!r}; allowed: left and right, for the better ear")
        ears = found.setdefault(_utterance(file, listener, ear), set())
        if ear in ears:
            raise ValueError(
                f"{file}: two items of this name and ear; allowed: one, for the better ear"
            )
        ears.add(ear)
    for (listener, own), ears in found.items():
        if lack := [ear for ear in EARS if ear not in ears]:
            raise ValueError(
                f"{_joined(listener, own)}: no {lack[0]} ear; allowed: both ears of each utterance, for the better ear"
            )


def better_ears(items: Sequence[ItemScore]) -> list[ItemScore]:
    """One item for the left and right ear of each listener and utterance, in the order of their first.

    A condition's score by each measure is the higher of the two ears', or that of the ear that has one; its level is that
    of the ear whose first measure is higher. The item's ear and audiogram are the better ear's under the last condition.
    An ear of which nothing could be scored is not among ``items``, and counts as the worse.
    """
    pairs: dict[tuple[str, str], dict[str, ItemScore]] = {}
    for item in items:
        pairs.setdefault(_utterance(item.file, item.listener, item.ear), {})[item.ear] = item
    return [_better(_joined(*names), ears) for names, ears in pairs.items()]


def _utterance(file: str, listener: str, ear: str) -> tuple[str, str]:
    """Listener and utterance, which the two ears have in common."""
    return listener, file.removeprefix(f"{listener} ").removeprefix(f"{ear} ")


def _joined(listener: str, own: str) -> str:
    return f"{listener} {own}".strip()


def _better(file: str, ears: dict[str, ItemScore]) -> ItemScore:
    both = [ears[ear] for ear in EARS if ear in ears]
    measures, conditions = list(both[0].scores), list(both[0].levels)

    def winner(measure: str, condition: str) -> ItemScore:
        return max(both, key=lambda item: item.scores[measure].get(condition, -1.0))

    last = winner(measures[0], conditions[-1])
    return replace(
        last,
        file=file,
        levels={name: winner(measures[0], name).levels[name] for name in conditions},
        scores={
            measure: {
                name: best[name]
                for name in conditions
                if name in (best := winner(measure, name).scores[measure])
            }
            for measure in measures
        },
    )
