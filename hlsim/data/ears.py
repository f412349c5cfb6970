"""Ears to train and judge on: drawn at random, and a plan's, in proportions of severity, disjoint between splits."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import accumulate
from random import Random

import torch

from hlsim.audiogram import SEVERITIES, Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.audiogram.thresholds import HIGHEST_SIMULATED
from hlsim.checks import refuse_unknown
from hlsim.data.manifest import SPLITS
from hlsim.data.plan_settings import PlanSettings
from hlsim.training.ears import draw_thresholds

MILD_TO_SEVERE: Mapping[str, float] = {"mild": 1.0, "moderate": 1.0, "severe": 1.0}
"""Default proportions of MSBG's severities: the paper says no more than "from mild to severe"."""

# of drawn ears, and of listeners in a file without splits
_TENTHS = ("test", "test", "valid", *7 * ["train"])
_KEPT = 2048  # drawn ears of a severity that wait for their turn


def check_shares(shares: Mapping[str, float]) -> dict[str, Fraction]:
    """Proportions that sum to 1, in order of severity. Raises ValueError where one is unknown or negative."""
    refuse_unknown(shares, SEVERITIES, "severities")
    if min(shares.values(), default=0.0) < 0.0 or not sum(shares.values()) > 0.0:
        raise ValueError(f"proportions {dict(shares)}; allowed: 0 or more, not all 0")
    exact = {name: Fraction(shares[name]) for name in SEVERITIES if shares.get(name)}
    total = sum(exact.values())
    return {name: value / total for name, value in exact.items()}


@dataclass(frozen=True)
class Ears:
    """What ``assign`` draws from: shares of severities, or none for those of the file, and the file's ears by split."""

    shares: Mapping[str, Fraction]
    measured: Mapping[str, tuple[Audiogram, ...]]
    seed: int

    def assign(self, split: str, utterances: int, ears: int) -> Iterator[list[Audiogram]]:
        """The ears of each utterance of a split, all different.

        Over the split the proportions are met to one ear; as long as no share is above 1 / ``ears``, the ears of an
        utterance differ in severity.
        """
        found = [ear.severity for ear in self.measured.get(split, ())]
        shares = self.shares or check_shares({name: found.count(name) for name in SEVERITIES})
        total = utterances * ears
        ends = [round(end * total) for end in accumulate(shares.values())]
        names = list(shares)
        draw = Random(f"{self.seed}:ears:{split}")
        order = draw.sample(range(utterances), utterances)
        source = (
            _Measured(self.measured[split], draw) if self.measured else _Drawn(split, self.seed)
        )
        for place in order:
            chosen: list[Audiogram] = []
            for number in range(ears):
                rank = place + number * utterances  # places far apart in a list sorted by severity
                chosen.append(
                    source.take(names[next(i for i, end in enumerate(ends) if rank < end)], chosen)
                )
            yield chosen


def plan_ears(settings: PlanSettings, splits: Collection[str]) -> Ears:
    """Ears from files, or else to be drawn.

    Of a file, rows with a column ``split`` go where it says. Of the other listeners (column ``listener``, or else equal
    thresholds) a fifth is for test, if it has no file of its own, and a tenth for validation. Of ears that two splits
    have alike the earlier of test, validation and training keeps them. Ears above 100 dB HL are passed over.

    Args:
        splits: those that the corpus has.

    Raises:
        ValueError: a file that cannot be used, that lacks a severity asked for, or has too few ears for a split.
    """
    shares, seed = settings.severities, settings.seed
    audiograms, test_audiograms = settings.audiograms, settings.test_audiograms
    if audiograms is None:
        if test_audiograms is not None:
            raise ValueError(
                f"{test_audiograms}: ears for test alone; allowed: with ears for training"
            )
        return Ears(check_shares(shares or MILD_TO_SEVERE), {}, seed)
    groups: dict[str, list[tuple[str, Audiogram]]] = {split: [] for split in ("", *SPLITS)}
    for path, default in ((audiograms, ""), (test_audiograms, "test")):
        for row, ear in read_audiograms(path) if path is not None else ():
            if max(ear.thresholds) <= HIGHEST_SIMULATED:
                split = row.get("split") or default
                refuse_unknown([split], groups, "splits", f"in {path}")
                groups[split].append(
                    (row.get("listener") or repr(ear.levels), _as_written(ear.thresholds))
                )
    listeners = sorted({who for who, _ in groups[""]})
    Random(f"{seed}:listeners").shuffle(listeners)
    owner = dict.fromkeys(listeners, "train")
    for split in ("test", "valid"):
        if split in splits and not groups[split]:
            # of one or two listeners a split gets none, and is refused below
            for _ in range(min(len(listeners), math.ceil(_TENTHS.count(split) * len(owner) / 10))):
                owner[listeners.pop()] = split
    for who, ear in groups.pop(""):
        groups[owner[who]].append((who, ear))
    ears: dict[str, tuple[Audiogram, ...]] = {}
    taken: set[tuple[float, ...]] = set()
    for split in ("test", "valid", "train"):
        fresh = {ear.levels: ear for _, ear in groups[split] if ear.levels not in taken}
        ears[split] = tuple(fresh.values())
        taken.update(fresh)
    exact = check_shares(shares) if shares else {}
    for split in splits:
        if missing := " or ".join(sorted(set(exact) - {ear.severity for ear in ears[split]})):
            lacks = f"no {missing} ears for {split}"
            raise ValueError(f"{audiograms}: {lacks}; allowed: proportions of what is there")
        if (found := len(ears[split])) < settings.ears:
            allowed = f"{settings.ears} or more, for each utterance gets {settings.ears}"
            raise ValueError(f"{found} measured ears for {split}; allowed: {allowed}")
    return Ears(exact, ears, seed)


def _as_written(levels: Sequence[float]) -> Audiogram:
    """As a CSV file gives it back."""
    return Audiogram(tuple(float(f"{level:g}") + 0.0 for level in levels))  # no -0


class _Measured:
    """Ears of a file, each severity's in a random order, over and over."""

    def __init__(self, ears: tuple[Audiogram, ...], draw: Random) -> None:
        self.all, self.draw = ears, draw
        self.turns: dict[str, list[Audiogram]] = {}

    def take(self, severity: str, other_than: list[Audiogram]) -> Audiogram:
        others = [ear for ear in self.all if ear not in other_than]
        alike = [
            ear for ear in others if ear.severity == severity
        ] or others  # where one ear alone has it
        waiting = self.turns.setdefault(severity, [])
        for ear in waiting:
            if ear in alike:
                waiting.remove(ear)
                return ear
        fresh = self.draw.sample(alike, len(alike))
        waiting.extend(fresh[1:])  # behind those that would not do this time
        return fresh[0]


class _Drawn:
    """Random ears, of which those of test and of the other splits can never be the same."""

    def __init__(self, split: str, seed: int) -> None:
        self.split = split
        digest = hashlib.sha256(f"{seed}:drawn ears:{split}".encode()).digest()
        self.generator = torch.Generator().manual_seed(int.from_bytes(digest[:7], "big"))
        self.waiting: dict[str, list[Audiogram]] = {name: [] for name in SEVERITIES}

    def take(self, severity: str, other_than: list[Audiogram]) -> Audiogram:
        waiting = self.waiting[severity]
        while not waiting:
            for levels in draw_thresholds(256, self.generator).tolist():
                ear = _as_written(levels)
                tenth = hashlib.sha256(repr(ear.levels).encode()).digest()[0] % 10
                if _TENTHS[tenth] == self.split and len(self.waiting[ear.severity]) < _KEPT:
                    self.waiting[ear.severity].append(ear)
        ear = waiting.pop()
        return ear if ear not in other_than else self.take(severity, other_than)
