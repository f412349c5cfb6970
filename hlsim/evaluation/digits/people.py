"""Measured speech reception thresholds of people by their mean hearing loss.

They show how far the simulated listener is from people. The numbers are a fit to 279 people
(docs/digits.md): two lines over the pure-tone average of the better ear, and the standard deviation
around them in four groups. The test of the people was that of digit triplets, unaided, with both
ears in the free field, in noise of 65 dB SPL.

Source: Oldenburg Hearing Health Record, Jafri et al. 2025, doi 10.5281/zenodo.16919812, CC BY 4.0.
"""

import numpy as np
from numpy.typing import ArrayLike

from hlsim.evaluation.digits.psychometric import Estimate

_AT_NO_LOSS = -9.21
"""Threshold in dB without a loss."""

_BEND = 30.0
"""Mean loss in dB HL from which the threshold rises faster."""

_SLOPE, _SLOPE_ABOVE = 0.099, 0.281
"""Rise of the threshold in dB per dB of mean loss, below and above the bend."""

_GROUPS = (12.0, 27.0, 42.0, 58.0)
"""Mean losses in dB HL of the groups of people."""

_DEVIATIONS = (0.88, 1.37, 1.97, 3.20)
"""Standard deviation of the threshold in dB in each group."""


def people_threshold(pta: ArrayLike) -> Estimate:
    """Return the mean unaided threshold in noise of people with a hearing loss, and their range.

    Args:
        pta: Pure-tone average in dB HL, a number or an array. The people had -5 to 79 dB HL.

    Returns:
        The mean signal-to-noise ratio at threshold in dB, and the limits between which 95 % of the
        people lie, in the shape of ``pta``.

    >>> print(*(x.round(1) for x in people_threshold(30.0)))
    -6.2 -9.2 -3.3
    """
    loss = np.asarray(pta, dtype=float)
    mean = _AT_NO_LOSS + _SLOPE * loss + (_SLOPE_ABOVE - _SLOPE) * np.maximum(loss - _BEND, 0.0)
    reach = 1.96 * np.interp(loss, _GROUPS, _DEVIATIONS)
    return Estimate(mean, mean - reach, mean + reach)
