"""Prediction of the share of words that a listener understands, from HASPI, with its uncertainty.

The model was fitted by ``docs/figures/fit_words.py``, which describes it, to 2339 responses of 26
hearing-impaired listeners to sentences through twelve hearing aids of Clarity's first two
enhancement challenges.

- HASPI was that of the better ear at pyclarity's default level. The sentences were in British
  English, in noise, and 7 to 10 words long. For other speech the predictions are an extrapolation.
- At the same HASPI, people understood fewer words in the second challenge. A prediction for no
  particular challenge lies between the two, and differs from each by up to 0.09.
- HASPI ranks aids, not people. Its correlation with the words understood in the first challenge is
  0.97 for the means of ten aids, and 0.33 for the means of the listeners. The intervals include the
  differences between listeners.

Source: responses of the Clarity prediction challenges 1 and 2 (Barker et al. 2022, Interspeech, doi
10.21437/Interspeech.2022-10821; Barker et al. 2024, ICASSP, doi
10.1109/ICASSP48485.2024.10446441) and HASPI from pyclarity. The coefficients are derived from
them; the responses are not part of hlsim.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DRAWS = 4000
"""Number of listeners that ``simulate_proportions`` simulates."""

INTERVAL = 0.9
"""Proportion of simulated listeners whose change lies in the interval of ``WordsChange``."""


class Curve(NamedTuple):
    """Parameters of the model that predicts the share of words that a listener understands.

    The logit of the share is linear in HASPI: an intercept, and two slopes, one over the HASPI of a
    sentence minus the mean of its aid, and one over this mean minus 0.5. Each listener adds an
    intercept and a slope over HASPI minus 0.5, and each aid an intercept.

    Attributes:
        coefficients: Intercept of the logit at a HASPI of 0.5, slope over the sentences of an aid,
            and slope over the means of aids.
        covariance: Covariance of the three coefficients.
        dispersion: Parameter of the beta-binomial distribution of the words understood in a
            sentence. With a smaller dispersion, sentences differ more.
        listener: Standard deviation of the intercepts of listeners.
        listener_slope: Standard deviation of the slopes of listeners.
        aid: Standard deviation of the intercepts of aids.
        words: Mean number of words per sentence.
        challenge: Deviation of the intercept in Clarity's first enhancement challenge from the mean
            of the first two. In the second challenge it is as large, but negative.

    >>> 7.0 < load_curve().words < 10.0
    True
    """

    coefficients: Sequence[float]
    covariance: Sequence[Sequence[float]]
    dispersion: float
    listener: float
    listener_slope: float
    aid: float
    words: float
    challenge: float

    def of_challenge(self, challenge: int) -> Curve:
        """Return the curve for sentences as in one of Clarity's first two enhancement challenges.

        Args:
            challenge: Number of the challenge, 1 or 2.

        Raises:
            ValueError: The number is neither 1 nor 2.
        """
        if challenge not in (1, 2):
            raise ValueError(
                f"expected challenge to be 1 or 2, got {challenge!r}; use None for other sentences"
            )
        intercept, *slopes = self.coefficients
        deviation = self.challenge if challenge == 1 else -self.challenge
        return self._replace(coefficients=(intercept + deviation, *slopes), challenge=0.0)


class WordsChange(NamedTuple):
    """Proportion of words that a new listener understands with a first and with a second aid.

    The function ``words_change`` predicts these proportions from HASPI.

    Attributes:
        before: Mean proportion with the first aid, 0 to 1.
        after: Mean proportion with the second aid, 0 to 1.
        change: ``after`` minus ``before``.
        low: Lower end of the interval that contains the change of a new listener with a probability
            of 90 %.
        high: Upper end of this interval.

    >>> WordsChange(0.5, 0.7, 0.2, -0.1, 0.5).change
    0.2
    """

    before: float
    after: float
    change: float
    low: float
    high: float


@cache
def load_curve() -> Curve:
    """Load the curve that predicts, from HASPI, the share of words that a listener understands.

    The curve was fitted to the responses of 26 listeners to sentences through twelve hearing aids.

    >>> len(load_curve().coefficients)
    3
    """
    return Curve(**json.loads(Path(__file__).with_suffix(".json").read_text()))


def words_change(before: ArrayLike, after: ArrayLike, challenge: int | None = None) -> WordsChange:
    """Predict from HASPI the shares of words that a new listener understands with two aids.

    The interval of 90 % includes the differences between listeners, aids and sentences, and the
    uncertainty of the coefficients. In a test with listeners that were left out of the fit, 88 to
    92 of 100 changes lay in the interval. Listeners are simulated, always with the same random
    numbers.

    Args:
        before: HASPI v2 of each sentence with the first aid, from 0 to 1. Shape: (items,).
        after: HASPI v2 of each sentence with the second aid, from 0 to 1. Shape: (items,), whose
            length may differ.
        challenge: 1 or 2 if the sentences are as hard as those of Clarity's first or second
            enhancement challenge. (The first had one interfering sound; the second had two or
            three, and the listener's head moved.) At the same HASPI, fewer words were understood in
            the second one. With None, the difference between two such challenges is a part of the
            uncertainty.

    Returns:
        Mean shares of words (0 to 1) with each aid, the second minus the first, and the limits
        between which this change lies for 90 % of new listeners.

    Raises:
        ValueError: There are no scores, they have another shape, one is NaN or outside 0 to 1, or
            the challenge is neither 1, 2 nor None.

    >>> words_change([0.3] * 20, [0.8] * 20).change > 0.3
    True
    """
    aids = [_check_scores("before", before), _check_scores("after", after)]
    curve = load_curve()
    if challenge is not None:
        curve = curve.of_challenge(challenge)
    proportion_before, proportion_after = simulate_proportions(curve, aids)
    change = proportion_after - proportion_before
    low, high = np.quantile(change, [0.5 - INTERVAL / 2.0, 0.5 + INTERVAL / 2.0])
    return WordsChange(
        before=float(proportion_before.mean()),
        after=float(proportion_after.mean()),
        change=float(change.mean()),
        low=float(low),
        high=float(high),
    )


def predict_words(scores: ArrayLike) -> float:
    """Predict which share of words, 0 to 1, a new listener understands with one aid, from HASPI.

    Args:
        scores: HASPI v2 of one or more sentences. NaN is ignored, and other values are limited to 0
            to 1.

    Raises:
        ValueError: There are no scores, or all are NaN.

    >>> predict_words([0.2]) < predict_words([0.8, math.nan])
    True
    """
    array = np.asarray(scores, dtype=np.float64)
    haspi = array[~np.isnan(array)].clip(0.0, 1.0)
    [proportion] = simulate_proportions(load_curve(), [_check_scores("scores", haspi)])
    return float(proportion.mean())


def _check_scores(name: str, scores: ArrayLike) -> tuple[Array, float]:
    """Convert HASPI scores to a float64 array, (items,), and return it with its mean.

    Args:
        name: Name of the argument, for messages.
        scores: HASPI of each sentence.

    Raises:
        ValueError: There are no scores, they do not have the shape (items,), or one is NaN or
            outside 0 to 1.
    """
    array = np.asarray(scores, dtype=np.float64)
    if array.ndim != 1 or not len(array):
        raise ValueError(
            f"expected {name} to be HASPI scores of one or more items, shape (items,), got shape "
            f"{array.shape}; pass one score per item"
        )
    is_score = (array >= 0.0) & (array <= 1.0)
    if not is_score.all():
        item = int(is_score.argmin())
        raise ValueError(
            f"expected {name} to be HASPI scores from 0 to 1, got {array[item]:g} for item {item}; "
            "leave the item out"
        )
    return array, float(array.mean())


def simulate_proportions(curve: Curve, aids: Sequence[tuple[Array, float]]) -> list[Array]:
    """Simulate the proportion of words that listeners understand with each of several aids.

    The same 4000 listeners, whose random numbers are fixed, are simulated with every aid, so the
    arrays can be subtracted. Each listener has an intercept and a slope, and draws the uncertainty
    of the curve and of the challenge. Each aid has an intercept for each listener, and the words
    that are understood depend on chance.

    Args:
        curve: Parameters of the model, from ``load_curve``.
        aids: One pair per aid: the HASPI of each sentence, (items,), and the mean HASPI of the aid,
            which may be a mean over more sentences.

    Returns:
        One array per aid, with the proportion of words for each simulated listener. Shape: (4000,)
        each.

    >>> scores = np.full(20, 0.6)
    >>> [proportion] = simulate_proportions(load_curve(), [(scores, 0.6)])
    >>> proportion.shape
    (4000,)
    """
    random = np.random.default_rng(0)
    coefficients = random.multivariate_normal(curve.coefficients, curve.covariance, DRAWS)
    listener_intercept = curve.listener * random.standard_normal(DRAWS)
    listener_slope = curve.listener_slope * random.standard_normal(DRAWS)
    # Two deviations of opposite sign have this standard deviation.
    test_deviation = math.sqrt(2.0) * abs(curve.challenge)
    test_intercept = test_deviation * random.standard_normal(DRAWS)
    proportions = []
    for scores, mean in aids:
        aid_intercept = curve.aid * random.standard_normal(DRAWS)
        predictors = [np.ones(len(scores)), scores - mean, np.full(len(scores), mean - 0.5)]
        logit = coefficients @ np.stack(predictors)
        intercept = listener_intercept + test_intercept + aid_intercept
        logit += intercept[:, None] + listener_slope[:, None] * (scores - 0.5)
        probability = 1.0 / (1.0 + np.exp(-logit))
        # The proportion in a sentence has the variance of a beta-binomial distribution. The mean
        # over all sentences is approximately normal.
        overdispersion = 1.0 + (curve.words - 1.0) / (curve.dispersion + 1.0)
        variance = probability * (1.0 - probability) / curve.words * overdispersion
        deviation = np.sqrt(variance.sum(1)) / len(scores)
        noise = deviation * random.standard_normal(DRAWS)
        proportions.append(np.clip(probability.mean(1) + noise, 0.0, 1.0))
    return proportions
