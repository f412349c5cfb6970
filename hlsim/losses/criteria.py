"""Criteria of ``HearingLossLoss`` by name, and the weights of their parts.

A criterion compares perceived speech with its reference. It has one or several *parts*, whose
weighted sum is the loss.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from hlsim.checks import check_weights
from hlsim.losses import coherent_bands, paper

CriterionName = Literal["coherent-bands", "bands", "paper", "haspi", "hasqi", "interaural"]

CRITERIA: dict[str, Mapping[str, float]] = {
    "coherent-bands": coherent_bands.DEFAULT_WEIGHTS,
    "bands": {"band_levels": 1.0},
    "paper": paper.DEFAULT_WEIGHTS,
    "haspi": {"haspi": 1.0},
    "hasqi": {"hasqi": 1.0},
    "interaural": {"interaural": 1.0},
}
"""Parts of each criterion with their default weights."""

Criterion = CriterionName | Mapping[str, float] | Callable[[Tensor, Tensor], Tensor]
"""Name of a criterion, weights of several by name, or a function of perceived speech and reference.

Shape of the function: (items, time) twice, in pascals -> (items,).
"""


def check_criterion(criterion: Any) -> dict[str, Any]:
    """Convert the criterion argument of a loss into criteria by name with their weights.

    Args:
        criterion: Name of a criterion, dictionary of names and weights, or a function.

    Returns:
        Weights above 0 under the names of criteria; or a function under the name ``criterion``.

    Raises:
        ValueError: A name is unknown, or a weight is negative or not finite.

    >>> check_criterion({"bands": 1.0, "paper": 0.0})
    {'bands': 1.0}
    """
    if callable(criterion) and not isinstance(criterion, type):
        return {"criterion": criterion}
    named = {criterion: 1.0} if isinstance(criterion, str) else criterion
    weights = check_weights(named, CRITERIA, "criteria")
    return {name: weight for name, weight in weights.items() if weight}


def combine_weights(
    weights: Mapping[str, float] | None, criteria: Mapping[str, Any]
) -> dict[str, float]:
    """Multiply the weight of each part of a loss by the weight of its criterion.

    Args:
        weights: Weight under each part's name; parts that it lacks are left out of the loss. None
            stands for the default weights of the criteria.
        criteria: Criteria with their weights, from ``check_criterion``.

    Returns:
        Weights, each under the name of its part.

    Raises:
        ValueError: A part is unknown, or a weight is negative or not finite.

    >>> combine_weights(None, {"bands": 0.5, "haspi": 2.0})
    {'band_levels': 0.5, 'haspi': 2.0}
    """
    defaults: dict[str, float] = {}
    scales: dict[str, float] = {}
    for name, scale in criteria.items():
        for part, weight in CRITERIA.get(name, {name: 1.0}).items():
            defaults[part] = weight
            scales[part] = 1.0 if callable(scale) else scale
    chosen = check_weights(defaults if weights is None else weights, defaults, "parts of the loss")
    return {part: weight * scales[part] for part, weight in chosen.items()}


def check_values(values: Any, items: int) -> Tensor:
    """Validate the result of a user's function that serves as a criterion, and return it.

    Args:
        values: Return value of the function.
        items: Number of items.

    Raises:
        ValueError: It is not a tensor with one value per item, (items,).

    >>> check_values(torch.tensor([0.5, 1.0]), items=2)
    tensor([0.5000, 1.0000])
    """
    if not isinstance(values, Tensor) or values.shape != (items,):
        result = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        raise ValueError(
            f"expected the criterion to return one value per item, shape ({items},), got {result}; "
            "leave out its mean over items, or apply it yourself to the result of loss.heard(...)"
        )
    return values


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
    total = torch.zeros_like(next(iter(parts.values())))
    for name, weight in weights.items():
        if weight:
            total = total + weight * parts[name]
    return total
