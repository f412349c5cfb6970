"""Speech reception threshold from numbers of right digits, with its uncertainty.

The share of digits that a listener recognises rises with the signal-to-noise ratio along a logistic
function, from a tenth, by guessing, to nearly 1. A grid of possible thresholds, slopes and upper
ends, all equally likely beforehand, gives the probability of each threshold after the test.

Source: Schuett, Harmeling, Macke and Wichmann (2016), Vision Research 122, doi
10.1016/j.visres.2016.02.002 (the method); Smits, Kapteyn and Houtgast (2004), International Journal
of Audiology 43, doi 10.1080/14992020400050004 (the test).
"""

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from hlsim.evaluation.digits.material import DIGITS_PER_TRIPLET

Array = NDArray[np.float64]

LOWEST_SNR, HIGHEST_SNR = -22.0, 32.0
"""Range of the signal-to-noise ratios of the test in dB."""

TARGET = 0.5 ** (1.0 / 3.0)
"""Share of right digits at the threshold, where half of the triplets have three right digits."""

_GUESS = 0.1

_THRESHOLDS = np.arange(LOWEST_SNR - 5.0, HIGHEST_SNR + 5.0, 0.2)
_SLOPES = np.geomspace(0.12, 1.0, 8)
"""Slopes of the logistic function per dB of signal-to-noise ratio."""

_LAPSES = np.array([0.005, 0.03, 0.1])
"""Shares of digits that are missed at the best signal-to-noise ratio."""

_CREDIBLE = (0.025, 0.975)


class Estimate(NamedTuple):
    """Estimate with the limits of its 95 % interval: one number each, or an array over ears.

    Attributes:
        value: Estimate in dB.
        low: Lower limit in dB.
        high: Upper limit in dB.

    >>> Estimate(2.0, 1.5, 2.5).value
    2.0
    """

    value: Any
    low: Any
    high: Any


def estimate_threshold(snr: Array, right: Array) -> Estimate:
    """Estimate the signal-to-noise ratio at which half of the triplets are understood.

    Args:
        snr: Signal-to-noise ratio of each triplet in dB, (triplets,).
        right: Number of digits of each triplet that were recognised, (triplets,).

    Returns:
        The threshold in dB, the mean of its posterior distribution over -27 to 36.8 dB, with its
        95 % interval. All three are infinite if the mean is above 32 dB, the highest
        signal-to-noise ratio of the test.

    >>> snr = np.linspace(-20.0, 20.0, 200)
    >>> estimate = estimate_threshold(snr, np.where(snr > 0.0, 3.0, 0.0))
    >>> abs(estimate.value) < 2.0
    True
    """
    points = np.meshgrid(_THRESHOLDS, _SLOPES, _LAPSES, indexing="ij")
    threshold, slope, lapse = (values.reshape(-1, 1) for values in points)
    span = 1.0 - _GUESS - lapse
    log_odds = scipy.special.logit((TARGET - _GUESS) / span)
    share = _GUESS + span * scipy.special.expit(slope * (snr - threshold) + log_odds)
    likelihoods = right * np.log(share) + (DIGITS_PER_TRIPLET - right) * np.log1p(-share)
    log_likelihood = likelihoods.sum(-1).reshape(len(_THRESHOLDS), -1)
    posterior = np.exp(log_likelihood - log_likelihood.max()).sum(-1)
    posterior /= posterior.sum()
    cumulative = posterior.cumsum() - 0.5 * posterior
    value = float(_THRESHOLDS @ posterior)
    if value > HIGHEST_SNR:
        return Estimate(np.inf, np.inf, np.inf)
    low, high = np.interp(_CREDIBLE, cumulative, _THRESHOLDS)
    return Estimate(value, float(low), float(high))


def subtract(first: Estimate, second: Estimate) -> Estimate:
    """Subtract the second estimate from the first one, as if their errors were independent.

    If one estimate is infinite, the difference is infinite, with limits that are NaN. The
    difference of two infinite estimates is NaN.

    >>> print(*subtract(Estimate(5.0, 4.7, 5.3), Estimate(1.0, 0.6, 1.4)))
    4.0 3.5 4.5
    """
    with np.errstate(invalid="ignore"):  # of two infinite thresholds, the difference is NaN
        value = first.value - second.value
        below = np.hypot(first.value - first.low, second.high - second.value)
        above = np.hypot(first.high - first.value, second.value - second.low)
        return Estimate(value, value - below, value + above)
