"""Criteria of ``HearingLossLoss`` by name, and the weights of their parts.

A criterion compares perceived speech with its reference. It has one or several *parts*, whose
weighted sum is the loss.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from hlsim.checks import check_weights
from hlsim.losses import coherent_bands, paper

CRITERIA: dict[str, Mapping[str, float]] = {
    "coherent-bands": coherent_bands.DEFAULT_WEIGHTS,
    "bands": {"band_levels": 1.0},
    "paper": paper.DEFAULT_WEIGHTS,
    "haspi": {"haspi": 1.0},
    "hasqi": {"hasqi": 1.0},
    "interaural": {"interaural": 1.0},
}
"""Parts of each criterion with their default weights."""

Criterion = str | Mapping[str, float] | Callable[[Tensor, Tensor], Tensor]
"""Name of a criterion, weights of several by name, or a function of perceived speech and reference.

Shape of the function: (items, time) twice, in pascals -> (items,).
"""


def read_criterion(
    criterion: Criterion, weights: Mapping[str, float] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the criteria of a loss, and the parts that they have, with their weights.

    Args:
        criterion: Name of a criterion, dictionary of names and weights, or a function.
        weights: Weight under each part's name; parts that it lacks are left out of the loss. None
            stands for the default weights of the criteria.

    Returns:
        Weights above 0 under the names of criteria, with a function under the name ``criterion``;
        and the weight of each part under its name, multiplied by the weight of its criterion.

    Raises:
        ValueError: A criterion or a part is unknown, or a weight is negative or not finite.

    >>> read_criterion({"bands": 0.5, "haspi": 2.0, "paper": 0.0})
    ({'bands': 0.5, 'haspi': 2.0}, {'band_levels': 0.5, 'haspi': 2.0})
    """
    criteria = {"criterion": 1.0}
    if not callable(criterion):
        named = {criterion: 1.0} if isinstance(criterion, str) else criterion
        known = check_weights(named, CRITERIA, "criteria")
        criteria = {name: weight for name, weight in known.items() if weight}
    defaults: dict[str, float] = {}
    scales: dict[str, float] = {}
    for name, scale in criteria.items():
        parts = CRITERIA.get(name, {name: 1.0})
        defaults |= parts
        scales |= dict.fromkeys(parts, scale)
    chosen = check_weights(defaults if weights is None else weights, defaults, "parts of the loss")
    return criteria, {part: weight * scales[part] for part, weight in chosen.items()}


def weighted_sum(parts: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Compute the sum of the parts of a loss times their weights.

    Args:
        parts: Parts, each under its name, all with the same shape.
        weights: Weights, each under the name of its part. Parts without a weight are left out.

    Returns:
        The sum, with the shape of one part.

    >>> weighted_sum({"time": torch.tensor(2.0), "phase": torch.tensor(1.0)}, {"time": 0.5})
    tensor(1.)
    """
    terms = (weight * parts[name] for name, weight in weights.items() if weight)
    return sum(terms, torch.zeros(()))
