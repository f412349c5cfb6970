"""How many words a listener would understand, from HASPI: a fitted curve with its uncertainty.

Fitted on 2001 responses of 22 hearing-impaired listeners to sentences through ten hearing aids (Clarity prediction
challenges 1 and 3; Barker et al. 2022, Interspeech, doi 10.21437/Interspeech.2022-10821) by ``examples/fit_words.py``,
which says what the model is. What to know of it:

- HASPI was that of the better ear, of standard ears of three severities, at pyclarity's default level; the sentences had
  7 to 10 words, in noise, in British English. Of other speech and measured ears the curve is an extrapolation.
- HASPI ranks aids, not people: over the means of the ten aids it correlates with the words understood at 0.97, over those
  of the listeners at 0.33. How much a listener differs from another is in the interval.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DRAWS = 4000


class Curve(NamedTuple):
    """The logit of the share of words understood, as HASPI tells it, and what it leaves open.

    Attributes:
        coefficients: intercept, slope within an aid, slope between the means of aids; the intercept is at HASPI 0.5.
        covariance: of the three.
        dispersion: of the beta-binomial law of a sentence's hits; the less, the more sentences differ.
        listener, listener_slope, aid: standard deviations of listeners, of their slopes and of aids.
        words: in a sentence, on average.
    """

    coefficients: Sequence[float]
    covariance: Sequence[Sequence[float]]
    dispersion: float
    listener: float
    listener_slope: float
    aid: float
    words: float


class WordsChange(NamedTuple):
    """Shares of the words that a new listener would understand, and their change with its interval."""

    before: float
    after: float
    change: float
    low: float
    high: float


@cache
def fitted() -> Curve:
    """The curve that ships."""
    return Curve(**json.loads((Path(__file__).parent / "words.json").read_text(encoding="utf-8")))


def words_change(
    before: ArrayLike, after: ArrayLike, *, interval: float = 0.9, seed: int = 0
) -> WordsChange:
    """What HASPI under two aids says of the words that one new listener understands of these sentences.

    Args:
        before, after: HASPI v2 of each sentence, 0 to 1, under each aid.
        interval: share of listeners that is to lie between ``low`` and ``high``. It holds what listeners, aids and
            sentences differ by, and the coefficients' uncertainty; left out, 88 to 92 of 100 listeners lie in 0.9.

    Shape: (items,) each, of one length or not.

    Raises:
        ValueError: no scores, of more dimensions, or outside 0 to 1; an interval outside 0 to 1.
    """
    pair = []
    for name, given in (("before", before), ("after", after)):
        scores = np.asarray(given, dtype=np.float64)
        if scores.ndim != 1 or not len(scores) or not ((scores >= 0.0) & (scores <= 1.0)).all():
            raise ValueError(
                f"{name} holds what is no HASPI; allowed: (items,) from 0 to 1, at least one"
            )
        pair.append((scores, float(scores.mean())))
    if not 0.0 < interval < 1.0:
        raise ValueError(f"interval is {interval!r}; allowed: above 0, below 1")
    shares = simulate_shares(fitted(), pair, seed)
    change = shares[1] - shares[0]
    low, high = np.quantile(change, [0.5 - interval / 2.0, 0.5 + interval / 2.0])
    first, second, mean = (float(share.mean()) for share in (*shares, change))
    return WordsChange(first, second, mean, float(low), float(high))


def simulate(curve: Curve, pair: Sequence[tuple[Array, float]], seed: int = 0) -> Array:
    """Differences of the second from the first of two aids, one a drawn listener. Shape: (draws,)."""
    first, second = simulate_shares(curve, pair, seed)
    return second - first


def simulate_shares(
    curve: Curve, aids: Sequence[tuple[Array, float]], seed: int = 0
) -> list[Array]:
    """Shares of words that drawn listeners understand with each aid, of which HASPI is given by sentence and on average.

    Shape: ((sentences,), ()) an aid -> (draws,) each.
    """
    random = np.random.default_rng(seed)
    coefficients = random.multivariate_normal(curve.coefficients, curve.covariance, DRAWS)
    listener, slope = (
        s * random.standard_normal(DRAWS) for s in (curve.listener, curve.listener_slope)
    )
    shares = []
    for scores, mean in aids:
        logit = coefficients @ np.stack(
            [np.ones(len(scores)), scores - mean, np.full(len(scores), mean - 0.5)]
        )
        logit += (listener + curve.aid * random.standard_normal(DRAWS))[:, None] + slope[
            :, None
        ] * (scores - 0.5)
        p = 1.0 / (1.0 + np.exp(-logit))
        # of a beta-binomial share, averaged over the sentences
        spread = (
            p * (1.0 - p) / curve.words * (1.0 + (curve.words - 1.0) / (curve.dispersion + 1.0))
        )
        noise = np.sqrt(spread.sum(1)) / len(scores) * random.standard_normal(DRAWS)
        shares.append(np.clip(p.mean(1) + noise, 0.0, 1.0))
    return shares
