"""Is after better than before? Paired tests of scores of the same items."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats

RESAMPLES = 9999
"""Number of bootstrap resamples."""

_DRAWS = 1_000_000  # indices drawn at a time: keeps the bootstrap's memory at some 16 MB

FEWEST = 6
"""Smallest number of items with an interval; with fewer, Wilcoxon's p cannot fall below 0.05."""

ROUNDING = 1e-7
"""Differences below this share of the largest score count as zero, because scores are float32."""


@dataclass(frozen=True)
class PairedComparison:
    """Scores of the same items before and after, compared.

    Differences are after minus before throughout, so that a gain is positive where higher scores are better; those
    under 1e-7 of the largest score are rounding, and count as zero. What the data do not define is None, never NaN: with
    one pair everything that needs a spread (deviations, t, d, both tests); with differences that are all equal t, p_t and
    d (a spread of zero); with no difference other than zero w and p_w; under six pairs the interval.

    Attributes:
        n, zeros: pairs, and those whose difference is zero, which the Wilcoxon test leaves out.
        before_std, after_std: standard deviations with n - 1.
        t, p_t: paired t-test, n - 1 degrees of freedom, two-sided.
        w, p_w: Wilcoxon signed-rank test, two-sided; zero differences dropped before all else, as Wilcoxon proposed; w is
            the smaller of the two rank sums. Differences of one size but for rounding, to a power of ten that is 1e-7
            of the largest score or less, share a rank. p as scipy's ``method="auto"`` takes it of the rest: exact up to
            50, the normal approximation beyond; where sizes are shared exact up to 13, the approximation with its
            correction for ties beyond (scipy before 1.15: up to 50 as if none were shared).
        cohens_d: ``delta`` over the standard deviation (n - 1) of the differences, which is t / sqrt(n).
        ci_low, ci_high: 95 % interval of ``delta``, the mean difference, by ``bootstrap_interval``, seed 0.
    """

    n: int
    zeros: int
    before_mean: float
    before_std: float | None
    after_mean: float
    after_std: float | None
    delta: float
    t: float | None
    p_t: float | None
    w: float | None
    p_w: float | None
    cohens_d: float | None
    ci_low: float | None = None
    ci_high: float | None = None

    def to_dict(self) -> dict[str, float | int | None]:
        """A plain dictionary that JSON can hold."""
        return asdict(self)


def paired_comparison(before: Iterable[float], after: Iterable[float]) -> PairedComparison:
    """Compare scores of the same items, in the same order, before and after.

    The tests take the pairs as independent. Where several come from one talker or listener they are not, and the p
    values are too small. ValueError for no pairs, unequal counts, or a score that is NaN or infinite.
    """
    first, second = _scores(before, "before"), _scores(after, "after")
    if len(first) != len(second):
        raise ValueError(
            f"{len(first)} scores before and {len(second)} after; a paired comparison needs one each an item"
        )
    difference = second - first
    difference = np.where(np.abs(difference) <= ROUNDING * _largest(first, second), 0.0, difference)
    n = len(first)
    spreads = [float(x.std(ddof=1)) if n > 1 else None for x in (first, second, difference)]
    zeros = int(np.count_nonzero(difference == 0.0))
    t = p_t = w = p_w = d = None
    if spreads[2] and spreads[2] > ROUNDING * _largest(first, second):
        t, p_t = (float(value) for value in stats.ttest_1samp(difference, 0.0))
        d = float(difference.mean()) / spreads[2]
    if n > 1 and zeros < n:
        # scipy counts zeros where it chooses between exact and approximate, its versions differently
        changes = difference[difference != 0.0]
        # by a power of ten: decimal scores lie on its steps, never between two, where rounding would part them again
        places = -math.floor(math.log10(ROUNDING * _largest(first, second)))
        w, p_w = (float(value) for value in stats.wilcoxon(np.round(changes, places)))
    before_mean, after_mean, delta = (float(x.mean()) for x in (first, second, difference))
    ends = bootstrap_interval(difference) if n >= FEWEST else (None, None)
    return PairedComparison(
        n, zeros, before_mean, spreads[0], after_mean, spreads[1], delta, t, p_t, w, p_w, d, *ends
    )


def bootstrap_interval(
    values: Iterable[float], *, confidence: float = 0.95, resamples: int = RESAMPLES, seed: int = 0
) -> tuple[float, float]:
    """Bootstrap interval of the mean: values, taken as independent, drawn with replacement, as many as there are.

    Percentiles of the means (Efron 1979), expanded as Student's t asks for (Hesterberg 2015, Am. Stat. 69): plain ones
    are too narrow for few values. Of normal values these held the mean in 93, 94, 94 and 94 % of 1500 draws of 6, 8, 12
    and 30 (plain ones: 86, 88, 90, 93), of exponential ones in 88, 91, 92 and 94 %. Of fewer than six no percentiles are
    wide enough: ValueError.
    """
    data = np.asarray(list(values), dtype=np.float64)
    if len(data) < FEWEST:
        raise ValueError(f"{len(data)} values; an interval needs {FEWEST} or more")
    generator = np.random.default_rng(seed)
    at_once = max(1, _DRAWS // len(data))
    sizes = [min(at_once, resamples - start) for start in range(0, resamples, at_once)]
    means = [data[generator.integers(0, len(data), (size, len(data)))].mean(-1) for size in sizes]
    expanded = stats.t.ppf(0.5 + 0.5 * confidence, len(data) - 1) * math.sqrt(
        len(data) / (len(data) - 1)
    )
    tail = 100.0 * stats.norm.cdf(-expanded)
    low, high = np.percentile(np.concatenate(means), [tail, 100.0 - tail])
    return float(low), float(high)


def holm(p_values: Iterable[float | None]) -> list[float | None]:
    """P values adjusted for their number by Holm (1979, Scand. J. Statist. 6): each at most itself times the number.

    Undefined ones stay None, and count.
    """
    given = list(p_values)
    order = sorted((p, i) for i, p in enumerate(given) if p is not None)
    adjusted: list[float | None] = [None] * len(given)
    largest = 0.0
    for rank, (p, i) in enumerate(order):
        largest = max(largest, min(1.0, (len(given) - rank) * p))
        adjusted[i] = largest
    return adjusted


def _largest(first: np.ndarray, second: np.ndarray) -> float:
    return max(float(np.abs(first).max()), float(np.abs(second).max()))


def _scores(values: Iterable[float], name: str) -> np.ndarray:
    scores = np.array([float(value) for value in values], dtype=np.float64)
    if not len(scores):
        raise ValueError(f"no scores {name}; a paired comparison needs at least one pair")
    for index, score in enumerate(scores):
        if not math.isfinite(score):
            raise ValueError(f"score {index} {name} is {score}; expected a finite number")
    return scores
