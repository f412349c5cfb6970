"""Which criterion a loss has: by name, several weighed by name, or a callable, and the weights of their parts."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

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
"""Criteria by name: their parts and the default weight of each."""


Criterion = CriterionName | Mapping[str, float] | Callable[[Tensor, Tensor], Tensor]
"""A name, weights by name, or a callable: what is heard and the reference, (items, time) in pascals -> (items,)."""


def check_values(values: Any, items: int) -> Tensor:
    """What a callable criterion returned, or ValueError unless it is a value for each item."""
    if not isinstance(values, Tensor) or values.shape != (items,):
        found = (
            f"shape {tuple(values.shape)}" if isinstance(values, Tensor) else type(values).__name__
        )
        raise ValueError(
            f"the criterion returned {found} for {items} items; allowed: a value for each, ({items},); one that gives "
            "a mean goes on what loss.heard(...) returns"
        )
    return values


def check_criterion(criterion: Any) -> dict[str, Any]:
    """Return the criteria by name, each with its weight unless that is 0, or a callable under the name ``criterion``.

    Raises:
        ValueError: an unknown criterion or a bad weight.
    """
    if callable(criterion) and not isinstance(criterion, type):
        return {"criterion": criterion}
    named = {criterion: 1.0} if isinstance(criterion, str) else criterion
    weights = check_weights(named, CRITERIA, "criteria")
    return {name: weight for name, weight in weights.items() if weight}


def combine_weights(
    weights: Mapping[str, float] | None, criteria: Mapping[str, Any]
) -> dict[str, float]:
    """Return the weight of each part of the loss, multiplied by that of its criterion.

    Args:
        weights: weights of the parts; the defaults of the criteria if None.
        criteria: what ``check_criterion`` returned.

    Raises:
        ValueError: an unknown part or a bad weight.
    """
    defaults: dict[str, float] = {}
    scales: dict[str, float] = {}
    for name, scale in criteria.items():
        for part, weight in CRITERIA.get(name, {name: 1.0}).items():
            defaults[part] = weight
            scales[part] = 1.0 if callable(scale) else scale
    chosen = check_weights(defaults if weights is None else weights, defaults, "parts of the loss")
    return {part: weight * scales[part] for part, weight in chosen.items()}
