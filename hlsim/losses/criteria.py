"""Criteria of ``HearingLossLoss``: one entry of a table and one function each.

A criterion compares the output of an aid, or what an impaired ear perceives of it, with clean
speech, or with what a normal ear perceives of clean speech. It has one or several *parts*, whose
weighted sum is the loss. A new criterion is a function from a ``Comparison`` to its parts, and an
entry in ``CRITERIA``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.calibration import NEURO_RATE
from hlsim.checks import check_shape, check_weights
from hlsim.dsp.resample import resample
from hlsim.losses import coherent_bands, paper
from hlsim.losses.frozen_simulator import ReferenceKind
from hlsim.losses.interaural import interaural_loss
from hlsim.losses.score_loss import SCORES, score_loss
from hlsim.metrics.band_levels import band_level_loss

CriterionLike = str | Mapping[str, float] | Callable[[Tensor, Tensor], Tensor]
"""Name of a criterion, weights of several by name, or a function of perceived speech and reference.

Shape of the function: (items, time) twice, in pascals -> (items,).
"""


_SIGNALS = ("output", "limited_output", "clean", "perceived", "reference")
"""Attributes of a ``Comparison`` that are signals."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Signals that a criterion compares. Shape of each: (items, time), in pascals.

    Attributes:
        output: Output of an aid.
        limited_output: The same output. If a criterion of the loss has ``limits_gradient``, the
            gradient through this tensor is limited (``hlsim.losses.gradient_limit``).
        clean: Clean speech.
        perceived: Output of the simulator for ``limited_output`` and the impaired ears.
        reference: Reference of the criterion, see ``Criterion.reference``.
        ears: Thresholds of the impaired ear of each item in dB HL. Shape: (items, 8).
        lengths: Number of samples of each item before padding.
        sample_rate: Sample rate in Hz.

    >>> signals = dict.fromkeys(_SIGNALS, torch.zeros(1, 800))
    >>> further = {"ears": torch.zeros(1, 8), "lengths": [500], "sample_rate": 16000}
    >>> comparison = Comparison(**signals, **further)
    >>> comparison.without_padding(slice(0, 1)).output.shape
    torch.Size([1, 500])
    """

    output: Tensor
    limited_output: Tensor
    clean: Tensor
    perceived: Tensor
    reference: Tensor
    ears: Tensor
    lengths: Sequence[int]
    sample_rate: int

    def without_padding(self, items: slice) -> Comparison:
        """Return the comparison of some items, cut to the length that all of them have.

        Args:
            items: Slice of items that have the same length.
        """
        lengths = self.lengths[items]
        signals = {name: getattr(self, name)[items, : lengths[0]] for name in _SIGNALS}
        return replace(self, **signals, ears=self.ears[items], lengths=lengths)


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """Entry of the table of criteria.

    Attributes:
        weights: Default weight of each part by its name.
        compute: Function from a ``Comparison`` to its parts by name, (items,) each.
        reference: Signal with which perceived speech is compared; None for a criterion that
            compares the output of the aid with clean speech.
        limits_gradient: Whether spikes of the gradient with respect to the output are limited.
        handles_padding: Whether ``compute`` takes account of ``Comparison.lengths``. Otherwise the
            items of a padded batch are cut and compared one by one, or both ears at once.
        two_ears: Whether the criterion compares two ears. Items 0 and 1, 2 and 3, and so on, are
            then the left and the right ear of a listener, which have the same length.

    >>> CRITERIA["interaural"].two_ears
    True
    """

    weights: Mapping[str, float]
    compute: Callable[[Comparison], dict[str, Tensor]]
    reference: ReferenceKind | None
    limits_gradient: bool = False
    handles_padding: bool = False
    two_ears: bool = False

    def parts(self, comparison: Comparison) -> dict[str, Tensor]:
        """Compute the parts of all items by name, (items,) each, without padding after the ends."""
        time = comparison.output.shape[-1]
        is_padded = any(length < time for length in comparison.lengths)
        if self.handles_padding or not is_padded:
            return self.compute(comparison)
        at_once = 2 if self.two_ears else 1
        results = [
            self.compute(comparison.without_padding(slice(start, start + at_once)))
            for start in range(0, len(comparison.lengths), at_once)
        ]
        return {part: torch.cat([result[part] for result in results]) for part in self.weights}


def _coherent_bands(signals: Comparison) -> dict[str, Tensor]:
    parts = coherent_bands.coherent_band_parts(
        signals.perceived, signals.reference, signals.sample_rate
    )
    # The gradient of a sample above the limit is exact, so it is not limited.
    return parts | {"peaks": coherent_bands.peak_excess(signals.output)}


def _bands(signals: Comparison) -> dict[str, Tensor]:
    difference = band_level_loss(signals.perceived, signals.reference, signals.sample_rate)
    return {"band_levels": difference}


def _paper(signals: Comparison) -> dict[str, Tensor]:
    estimate = resample(signals.perceived, signals.sample_rate, NEURO_RATE)
    return paper.paper_parts(estimate, resample(signals.reference, signals.sample_rate, NEURO_RATE))


def _score(name: str, signals: Comparison) -> dict[str, Tensor]:
    loss = score_loss(
        name,
        signals.limited_output,
        signals.clean,
        signals.ears,
        signals.lengths,
        signals.sample_rate,
    )
    return {name: loss}


def _call(function: Callable[..., Any], signals: Comparison) -> dict[str, Tensor]:
    value = function(signals.perceived, signals.reference)
    return {"criterion": check_shape(value, "criterion", (len(signals.perceived),))}


def _interaural(signals: Comparison) -> dict[str, Tensor]:
    output = signals.limited_output.unflatten(0, (-1, 2))
    clean = signals.clean.unflatten(0, (-1, 2))
    changes = interaural_loss(output, clean, signals.sample_rate)
    return {"interaural": changes.repeat_interleave(2)}


CRITERIA = {
    "coherent-bands": Criterion(
        weights=coherent_bands.DEFAULT_WEIGHTS,
        compute=_coherent_bands,
        reference=ReferenceKind(is_fixed=True),
        limits_gradient=True,
    ),
    "bands": Criterion(
        weights={"band_levels": 1.0},
        compute=_bands,
        reference=ReferenceKind(is_fixed=True, normal_ear="simulator", bank_phase=False),
    ),
    "paper": Criterion(
        weights=paper.DEFAULT_WEIGHTS,
        compute=_paper,
        reference=ReferenceKind("clean", normal_ear="simulator"),
    ),
    **{
        name: Criterion(
            weights={name: 1.0},
            compute=partial(_score, name),
            reference=None,
            limits_gradient=True,
            handles_padding=True,
        )
        for name in SCORES
    },
    "interaural": Criterion(
        weights={"interaural": 1.0},
        compute=_interaural,
        reference=None,
        two_ears=True,
    ),
}
"""Criteria of ``HearingLossLoss``, each under its name."""


def read_criterion(
    criterion: CriterionLike, weights: Mapping[str, float] | None = None
) -> tuple[dict[str, Criterion], dict[str, float]]:
    """Return the criteria of a loss, and the parts that they have, with their weights.

    Args:
        criterion: Name of a criterion, dict from names to weights, or a function.
        weights: Weight under each part's name; parts without a weight are left out of the loss.
            None selects the default weights of the criteria.

    Returns:
        Criteria by name that have a weight above 0, where a function has the name ``criterion``;
        and the weight of each part by its name, multiplied by the weight of its criterion.

    Raises:
        ValueError: A criterion or a part is unknown, two criteria have a part of the same name, a
            weight is negative or not finite, or all weights are 0.

    >>> criteria, weights = read_criterion({"bands": 0.5, "haspi": 2.0, "paper": 0.0})
    >>> list(criteria), weights
    (['bands', 'haspi'], {'band_levels': 0.5, 'haspi': 2.0})
    """
    known, named = CRITERIA, criterion
    if callable(criterion):
        call, reference = partial(_call, criterion), ReferenceKind()
        known = {
            "criterion": Criterion(weights={"criterion": 1.0}, compute=call, reference=reference)
        }
        named = "criterion"
    if isinstance(named, str):
        named = {named: 1.0}
    scales = check_weights(named, known, "criteria")
    criteria = {name: known[name] for name, scale in scales.items() if scale}
    defaults: dict[str, float] = {}
    part_scales: dict[str, float] = {}
    for name, entry in criteria.items():
        if repeated := defaults.keys() & entry.weights.keys():
            raise ValueError(
                f"expected parts of different names, but {name} has a part {min(repeated)!r} as "
                "another criterion has; rename it"
            )
        defaults |= entry.weights
        part_scales |= dict.fromkeys(entry.weights, scales[name])
    chosen = check_weights(defaults if weights is None else weights, defaults, "parts of the loss")
    return criteria, {part: weight * part_scales[part] for part, weight in chosen.items()}


def weighted_sum(parts: Mapping[str, Tensor], weights: Mapping[str, float]) -> Tensor:
    """Compute the sum of the parts of a loss times their weights.

    Args:
        parts: Parts, each under its name, all with the same shape.
        weights: Weights, each under the name of its part. Parts without a weight are left out.

    Returns:
        The sum, with the shape of one part; () if no weight differs from 0.

    >>> weighted_sum({"time": torch.tensor(2.0), "phase": torch.tensor(1.0)}, {"time": 0.5})
    tensor(1.)
    """
    terms = (weight * parts[name] for name, weight in weights.items() if weight)
    return sum(terms, torch.zeros(()))
