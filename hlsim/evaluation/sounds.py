"""Sounds of a study for the players of a page: outputs of conditions, as an ear perceives them."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import gain_to_pascals
from hlsim.checks import check_finite
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.result import Evaluation, ItemSounds
from hlsim.evaluation.running.parallel import describe_error
from hlsim.evaluation.study import Condition, Item
from hlsim.progress import track

NORMAL_EAR = "normal ear (the goal)"
"""Label of clean speech as a normal ear perceives it."""

_LONGEST_SECONDS = 8.0
"""Length in seconds to which the sounds of an item are cut."""


def perceive_items(
    evaluation: Evaluation, count: int, conditions: Sequence[str] = ()
) -> list[ItemSounds]:
    """Return the sounds of some items as their ear perceives them, by the exact MSBG.

    Items with a score under both conditions of ``evaluation.headline`` are ranked by how much it
    changes between them, the largest rise first. The returned items are evenly spaced in this
    ranking, and their names state the change and the rank. The sounds of an item, of at most 8 s,
    are what a normal ear perceives of the clean speech, and what the impaired ear perceives of the
    output of each condition. A sound that cannot be computed is missing; the ``failures`` of its
    item have the reason.

    Args:
        evaluation: Evaluation with comparisons.
        count: Number of items to return, if there are as many.
        conditions: Names of the conditions with sounds; all of them if empty.

    Returns: One ``ItemSounds`` per item, in the order of the ranking; an empty list if there is no
        comparison or ``count`` is 0.

    >>> import pandas
    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import compare
    >>> speech = torch.randn(8000, generator=torch.Generator().manual_seed(0))
    >>> item = Item("s01", speech, speech, Audiogram.standard("N3"))
    >>> conditions = [Condition(name, lambda signal, ear: signal) for name in "ab"]
    >>> rows = [(0, "s01", "a", 0.2), (0, "s01", "b", 0.4)]
    >>> table = pandas.DataFrame(rows, columns=["item", "name", "condition", "haspi"])
    >>> evaluation = Evaluation([item], conditions, [], table, compare(table, ["haspi"]))
    >>> (sounds,) = perceive_items(evaluation, count=1)
    >>> sounds.name, list(sounds.groups[""])
    ('s01 (HASPI: change +0.200, rank 1 of 1)', ['normal ear (the goal)', 'a', 'b'])
    """
    headline = evaluation.headline
    if headline is None or not count:
        return []
    scores = evaluation.wide(headline.measure)
    changes = (scores[headline.after] - scores[headline.before]).dropna()
    changes = changes.sort_values(ascending=False, kind="stable")
    places = np.linspace(0, len(changes) - 1, min(count, len(changes))).round().astype(int)
    rows = evaluation.table.drop_duplicates("item").set_index("item")
    names = conditions or evaluation.names
    chosen = [condition for condition in evaluation.conditions if condition.name in names]
    sounds = []
    for place in track(places.tolist(), "items to play", len(places)):
        row = rows.loc[changes.index[place]]
        item = evaluation.items[int(row.get("source", row.name))].load()
        signals, failures = _perceive(item, chosen)
        rank = f"change {changes.iloc[place]:+.3f}, rank {place + 1} of {len(changes)}"
        name = f"{row['name']} ({headline.title}: {rank})"
        sounds.append(ItemSounds(name, item.ear, item.sample_rate, {"": signals}, failures))
    return sounds


def _perceive(
    item: Item, conditions: Sequence[Condition]
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the perceived signals of an item, and the reasons of failures, by label.

    Args:
        item: The item.
        conditions: Conditions whose outputs are perceived.

    Returns:
        Signals in pascals, each with shape (time,) and at most 8 s long; and the reasons why others
        are missing.
    """
    gain, end = gain_to_pascals(item.full_scale_spl), int(_LONGEST_SECONDS * item.sample_rate)

    def perceive_part(signal: Tensor, ear: Audiogram) -> Tensor:
        return perceive(signal[:end].float() * gain, ear, item.sample_rate)

    def perceive_output(condition: Condition) -> Tensor:
        return perceive_part(condition.output(item), item.ear)

    functions = {NORMAL_EAR: partial(perceive_part, item.clean, NORMAL)}
    return try_sounds(functions | {c.name: partial(perceive_output, c) for c in conditions})


def try_sounds(
    functions: Mapping[str, Callable[[], Tensor]],
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Compute several sounds, without gradients; an error in one does not end the others.

    Args:
        functions: Function that returns a sound, (time,), by the label of the sound.

    Returns:
        The sounds by label, and for labels without a sound the reason.

    >>> try_sounds({"a": lambda: torch.ones(2)})[0]
    {'a': tensor([1., 1.])}
    """
    signals, failures = {}, {}
    for label, compute in functions.items():
        try:
            with torch.no_grad():
                signal = compute()
            check_finite(signal, "the sound")
            signals[label] = signal
        except Exception as error:  # The study has scored the item: one sound may be missing.
            failures[label] = describe_error(error)
    return signals, failures
