"""Frequencies and ranges of thresholds, severities of hearing loss, and interpolation."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Numbers = Sequence[float] | NDArray[np.floating[Any]] | NDArray[np.integer[Any]]
"""Frequencies or levels in one dimension."""

EarName = Literal["left", "right"]

EARS: tuple[EarName, EarName] = ("left", "right")

EAR_NAMES: dict[str, EarName] = {
    "l": "left",
    "le": "left",
    "lt": "left",
    "left": "left",
    "r": "right",
    "re": "right",
    "rt": "right",
    "right": "right",
}
"""Texts for an ear in a table, in lower case."""

FREQUENCIES = (250.0, 500.0, 1000.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
"""The eight audiometric frequencies in Hz at which networks, losses and aids take thresholds."""

PTA_FREQUENCIES = (500.0, 1000.0, 2000.0, 4000.0)
"""Frequencies in Hz whose mean threshold is the pure-tone average."""

LOWEST_HZ, HIGHEST_HZ = 100.0, 20000.0
"""Range of the frequencies in Hz at which an audiogram may have thresholds."""

LOWEST_LEVEL, HIGHEST_LEVEL = -10.0, 120.0
"""Range of the thresholds of an audiogram in dB HL."""

LOWEST_UCL, HIGHEST_UCL = 20.0, 140.0
"""Range of the uncomfortable levels of an audiogram in dB HL."""

UCL_NOT_REACHED = 115.0
"""Level in dB HL from which on a measured uncomfortable level means that none was reached."""

HIGHEST_SIMULATED = 100.0
"""Highest threshold in dB HL that a simulator accepts. MSBG divides by 0 at 105 dB HL."""

SEVERITIES = ("none", "mild", "moderate", "severe")
"""MSBG's severities of loss, by the mean threshold from 2 to 8 kHz."""

SEVERITY_LIMITS = (15.0, 35.0, 56.0)
"""Mean thresholds in dB HL above which a loss is mild, moderate and severe (pyclarity 0.9.0)."""

WHO_GRADES = {
    "normal": 20.0,
    "mild": 35.0,
    "moderate": 50.0,
    "moderately severe": 65.0,
    "severe": 80.0,
    "profound": 95.0,
    "complete": float("inf"),
}
"""Pure-tone average in dB HL below which each of WHO's grades of hearing loss ends (2021)."""


def interpolate_over_log(points: Numbers, grid: Numbers, values: Numbers) -> NDArray[np.float64]:
    """Interpolate values linearly over log frequency, constant below the grid and above it.

    Args:
        points: Frequencies of the result in Hz, 0 or more. Shape: (points,).
        grid: Ascending frequencies of the values in Hz. Shape: (grid,).
        values: Values such as thresholds or gains. Shape: (grid,).

    Returns:
        Values at ``points``. Shape: (points,).

    >>> interpolate_over_log([0.0, 500.0], (250.0, 1000.0), [10.0, 20.0])
    array([10., 15.])
    """
    return np.interp(np.log(np.maximum(points, grid[0])), np.log(grid), values)
