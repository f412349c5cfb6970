"""Two ears' scores of an utterance become the better one's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hlsim.evaluation.scores import ItemScore
from hlsim.evaluation.scoring import EARS


def better_ears(items: Sequence[ItemScore]) -> list[ItemScore]:
    """One item for the left and right ear of each listener and utterance, in the order of their first.

    A condition's score by each measure is the higher of the two ears', or that of the ear that has one; its level is that
    of the ear whose first measure is higher. The item's ear and audiogram are the better ear's under the last condition.

    Raises:
        ValueError: an item that is neither a left nor a right ear's, or whose other ear is not there.
    """
    pairs: dict[tuple[str, str], dict[str, ItemScore]] = {}
    for item in items:
        if item.ear not in EARS:
            raise ValueError(f"{item.file}: ear is {item.ear!r}; allowed: left and right, for the better ear")
        own = item.file.removeprefix(f"{item.listener} ").removeprefix(f"{item.ear} ")
        pairs.setdefault((item.listener, own), {})[item.ear] = item
    return [_better(f"{listener} {own}".strip(), ears) for (listener, own), ears in pairs.items()]


def _better(file: str, ears: dict[str, ItemScore]) -> ItemScore:
    if lack := [ear for ear in EARS if ear not in ears]:
        raise ValueError(
            f"{file}: no {lack[0]} ear; allowed: both ears of each utterance, for the better ear"
        )
    both = [ears[ear] for ear in EARS]
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
