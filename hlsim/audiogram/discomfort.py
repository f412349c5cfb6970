"""Uncomfortable levels (UCL): from which level on a pure tone is uncomfortably loud for an ear."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from hlsim.audiogram.scale import HIGHEST_HZ, HIGHEST_UCL, LOWEST_HZ, LOWEST_UCL

Levels = TypeVar("Levels")

Points = tuple[tuple[float, float], ...]
"""Pairs of a frequency in Hz and a level in dB HL."""

UclLike = Mapping[Any, float | None] | Sequence[Sequence[float]]
"""Measured levels: a mapping of frequencies in Hz to levels in dB HL, or pairs of both."""


PREDICTION_MARGIN_DB = 7.4
"""Distance in dB below the prediction at which an aid limits ears without measured levels.

Three quarters of the levels of the 138 people to whom the prediction was fitted are above the
prediction minus this margin, and 75 % of those of the 138 others.
"""


def predict_uncomfortable_levels(thresholds: Levels) -> Levels:
    """Predict uncomfortable levels from thresholds: 88.3 dB HL plus 0.26 of the threshold.

    The two numbers were fitted to 138 people of the Oldenburg Hearing Health Record (Jafri et al.
    2025, doi 10.5281/zenodo.16919812, CC BY 4.0) at 500, 1000, 2000 and 4000 Hz. A level of 115 dB
    HL or more counted as not reached. For 138 other people, the prediction minus the level, over
    the 942 levels that they reached, has a root mean square of 8.7 dB and a mean of 2.6 dB; 137
    levels were not reached. People with equal thresholds differ much, so measure the levels where
    you can. The line is assumed to hold at other frequencies, too.

    Args:
        thresholds: Thresholds in dB HL: a number, an array or a tensor of any shape.

    >>> predict_uncomfortable_levels(50.0)
    101.3
    """
    return 88.3 + 0.26 * thresholds  # type: ignore[operator, return-value]


def predict_limits(thresholds: Levels) -> Levels:
    """Predict levels to which an aid may limit its output for ears without measured levels.

    They are the predicted uncomfortable levels minus ``PREDICTION_MARGIN_DB``, because the levels
    of people with equal thresholds differ much.

    Args:
        thresholds: Thresholds in dB HL: a number, an array or a tensor of any shape.

    >>> round(predict_limits(50.0), 1)
    93.9
    """
    predicted: Any = predict_uncomfortable_levels(thresholds)
    return predicted - PREDICTION_MARGIN_DB


def read_points(ucl: UclLike | None) -> Points:
    """Validate measured uncomfortable levels, and return them with ascending frequencies.

    Args:
        ucl: Levels. A level that is None or NaN was not measured, and is left out.

    Raises:
        ValueError: The value is neither a mapping nor pairs of numbers, a frequency occurs twice or
            is not from 100 to 20000 Hz, or a level is not from 20 to 140 dB HL.

    >>> read_points({1000: 95, 500: None})
    ((1000.0, 95.0),)
    """
    levels_by_hz: Any = () if ucl is None else ucl
    if isinstance(ucl, Mapping):
        levels_by_hz = ucl.items()
    try:
        pairs = list(levels_by_hz)
        points = [(float(hz), np.nan if level is None else float(level)) for hz, level in pairs]
    except (TypeError, ValueError):
        raise ValueError(
            "expected uncomfortable levels as a dictionary of frequencies in Hz to levels in dB "
            f"HL, such as {{500: 95, 1000: 100}}, got {ucl!r}"
        ) from None
    points = sorted((hz, level) for hz, level in points if not np.isnan(level))
    for hz, level in points:
        if not (LOWEST_HZ <= hz <= HIGHEST_HZ and LOWEST_UCL <= level <= HIGHEST_UCL):
            raise ValueError(
                f"expected uncomfortable levels from {LOWEST_UCL:g} to {HIGHEST_UCL:g} dB HL at "
                f"{LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, got {level:g} at {hz:g} Hz; correct it, or "
                "leave it out"
            )
    if len({hz for hz, _ in points}) < len(points):
        raise ValueError(f"expected one uncomfortable level per frequency, got {ucl!r}")
    return tuple(points)
