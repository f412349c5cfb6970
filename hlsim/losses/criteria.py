"""Which criterion a loss has: by name, several weighed by name, or a callable, and the weights of their parts."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

from torch import Tensor

from hlsim.checks import is_finite
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
    """The criteria by name, each with its weight unless that is 0; a callable as itself, under the name criterion."""
    if callable(criterion) and not isinstance(criterion, type):
        return {"criterion": criterion}
    named = {criterion: 1.0} if isinstance(criterion, str) else criterion
    if not isinstance(named, Mapping) or not named or not set(named) <= set(CRITERIA):
        raise ValueError(
            f"criterion is {criterion!r}; allowed: {', '.join(CRITERIA)}, weights by these names, or a callable "
            "(heard, reference) -> (items,)"
        )
    return {name: weight for name, weight in _check_numbers(named, "criterion").items() if weight}


def check_weights(
    weights: Mapping[str, float] | None, criteria: Mapping[str, Any], criterion: Any
) -> dict[str, float]:
    """The weight of each part, times that of its criterion."""
    of = {part: name for name in criteria for part in CRITERIA.get(name, {name: 1.0})}
    if weights is None:
        weights = {part: CRITERIA.get(name, {name: 1.0})[part] for part, name in of.items()}
    if not isinstance(weights, Mapping):
        allowed = {part: 1.0 for part in of}
        raise ValueError(
            f"weights is {type(weights).__name__}; allowed: numbers by name, as {allowed}"
        )
    if unknown := sorted(map(str, set(weights) - set(of))):
        raise ValueError(
            f"unknown weights {', '.join(unknown)} for criterion {criterion!r}; allowed: {', '.join(of)}"
        )
    checked = _check_numbers(weights, "weights", of)
    scales = {name: 1.0 if callable(scale) else scale for name, scale in criteria.items()}
    return {part: weight * scales[of[part]] for part, weight in checked.items()}


def _check_numbers(
    weights: Mapping[str, float], what: str, allowed: Any = CRITERIA
) -> dict[str, float]:
    if not all(is_finite(weight) and weight >= 0.0 for weight in weights.values()):
        raise ValueError(f"{what} {dict(weights)}; allowed: finite numbers, 0 or more")
    checked = {name: float(weight) for name, weight in weights.items()}
    if not any(checked.values()):
        raise ValueError(
            f"{what} {checked} count nothing; allowed: one above 0 at least, of {', '.join(allowed)}"
        )
    return checked
