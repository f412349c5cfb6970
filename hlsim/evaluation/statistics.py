"""Paired tests of two scores per item, and intervals for their mean difference."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy

RESAMPLES = 9999
"""Number of bootstrap resamples."""

_DRAWS_AT_ONCE = 2**17
"""Number of values that are drawn at once, which fit into caches."""

MIN_ITEMS_FOR_INTERVAL = 6
"""Smallest number of items with an interval. With fewer, Wilcoxon's p cannot fall below 0.05."""

_RELATIVE_TOLERANCE = 1e-7
"""Share of the largest magnitude up to which differences are zero, because scores are float32."""

_ROUNDING = {np.float32: 2.0**-24, np.float64: 2.0**-53}
"""Largest relative difference between a decimal number and its nearest float of each type."""


@dataclass(frozen=True)
class PairedComparison:
    """Statistics of two scores per item, before and after a treatment.

    A difference is the score after minus the score before. Differences up to 1e-7 of the largest
    magnitude count as zero. Values that the data do not define are None: with one item, all but the
    counts, the means and ``delta``; with equal differences, ``t``, ``p_t`` and ``cohens_d``; and if
    all differences are zero, ``w`` and ``p_w``.

    Attributes:
        n: Number of items.
        zeros: Number of items whose difference is zero, which Wilcoxon's test leaves out.
        before_mean, after_mean: Mean scores.
        before_std, after_std: Standard deviations with n - 1.
        delta: Mean difference.
        t, p_t: Statistic and two-sided p value of the paired t-test with n - 1 degrees of freedom.
        w, p_w: Statistic (the smaller rank sum) and two-sided p value of Wilcoxon's signed-rank
            test. Differences that are equal up to rounding share a rank. The p value is exact for
            up to 50 differences (13 if some share a rank), and a normal approximation with a
            correction for ties otherwise.
        cohens_d: ``delta`` over the standard deviation of the differences, which is t / sqrt(n).
        ci_low, ci_high: 95 % interval of ``delta`` by ``bootstrap_interval``; None for fewer than
            six items.

    >>> paired_comparison([0.1, 0.2, 0.3], [0.2, 0.4, 0.3]).zeros
    1
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
    ci_low: float | None
    ci_high: float | None


def paired_comparison(before: Iterable[float], after: Iterable[float]) -> PairedComparison:
    """Test whether the scores of the same items differ before and after a treatment.

    The tests treat the items as independent. If several share a talker or a listener, the p values
    are too small.

    Args:
        before, after: One score per item, in the same order. Scores have any scale.

    Raises:
        ValueError: There are no scores, their numbers differ, or a score is NaN or infinite.

    >>> round(paired_comparison([0.1, 0.2, 0.3], [0.2, 0.4, 0.3]).delta, 3)
    0.1
    """
    first, second = (np.array(list(scores), dtype=np.float64) for scores in (before, after))
    both = np.concatenate([first, second])
    if not 0 < len(first) == len(second) or not np.isfinite(both).all():
        raise ValueError(
            f"expected two finite scores of each item, got {len(first)} before and {len(second)} "
            "after, which may be NaN; leave items without a score out of both"
        )
    tolerance = _RELATIVE_TOLERANCE * float(np.abs(both).max())
    difference = second - first
    difference = np.where(np.abs(difference) <= tolerance, 0.0, difference)
    n = len(first)
    before_std, after_std, spread = (
        float(scores.std(ddof=1)) if n > 1 else None for scores in (first, second, difference)
    )
    zeros = int(np.count_nonzero(difference == 0.0))
    t = p_t = w = p_w = d = None
    if spread and spread > tolerance:
        t, p_t = (float(value) for value in scipy.stats.ttest_1samp(difference, 0.0))
        d = float(difference.mean()) / spread
    if n > 1 and zeros < n:
        # SciPy counts zeros when it chooses between the exact and the approximate p value.
        changes = difference[difference != 0.0]
        precision = np.float32 if (both.astype(np.float32) == both).all() else np.float64
        # Two differences of scores contain the rounding of four scores.
        tied = _join_ties(changes, 4.0 * _ROUNDING[precision] * float(np.abs(both).max()))
        w, p_w = (float(value) for value in scipy.stats.wilcoxon(tied))
    before_mean, after_mean, delta = (float(x.mean()) for x in (first, second, difference))
    interval = bootstrap_interval(difference) or (None, None)
    return PairedComparison(
        n,
        zeros,
        before_mean,
        before_std,
        after_mean,
        after_std,
        delta,
        t,
        p_t,
        w,
        p_w,
        d,
        *interval,
    )


def _join_ties(differences: np.ndarray, tolerance: float) -> np.ndarray:
    """Give magnitudes that are equal up to rounding the same value, so that they share a rank.

    Sorted magnitudes form a group as long as each is at most ``tolerance`` above the one before;
    all of a group get the smallest of them. Signs stay. Shape: (items,) -> (items,).
    """
    magnitudes = np.abs(differences)
    order = np.argsort(magnitudes)
    is_larger = np.diff(magnitudes[order], prepend=-np.inf) > tolerance
    first_of_group = order[is_larger][np.cumsum(is_larger) - 1]
    joined = np.empty_like(magnitudes)
    joined[order] = magnitudes[first_of_group]
    return np.copysign(joined, differences)


def bootstrap_interval(values: Iterable[float]) -> tuple[float, float] | None:
    """Compute a 95 % interval for the true mean of independent values.

    The limits are percentiles of the means of resamples (Efron 1979), expanded by Student's t
    (Hesterberg 2015, Am. Stat. 69), because plain percentiles are too narrow for few values. For
    6, 8, 12 and 30 normally distributed values they contained the mean in 93, 94, 94 and 94 % of
    1500 draws (plain percentiles: 86, 88, 90, 93), for exponentially distributed ones in 88, 91, 92
    and 94 %. The seed of the resamples is fixed, so the same values give the same interval.

    Args:
        values: Values, such as the differences of two scores per item.

    Returns:
        The lower and the upper limit; None for fewer than six values, for which no percentile is
        wide enough.

    >>> bootstrap_interval([0.1, 0.2, 0.3, 0.4, 0.5])
    >>> [round(limit, 2) for limit in bootstrap_interval([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])]
    [0.17, 0.53]
    """
    data = np.asarray(list(values), dtype=np.float64)
    n = len(data)
    if n < MIN_ITEMS_FOR_INTERVAL:
        return None
    generator = np.random.default_rng(0)
    means = np.empty(RESAMPLES)
    for part in np.array_split(means, -(-RESAMPLES * n // _DRAWS_AT_ONCE)):
        part[:] = data[generator.integers(0, n, (len(part), n))].mean(-1)
    expanded = scipy.special.stdtrit(n - 1, 0.975) * math.sqrt(n / (n - 1))
    tail = 100.0 * scipy.special.ndtr(-expanded)
    low, high = np.percentile(means, [tail, 100.0 - tail])
    return float(low), float(high)


def holm(p_values: Iterable[float | None]) -> list[float | None]:
    """Adjust p values for the number of tests by the method of Holm (1979, Scand. J. Statist. 6).

    Args:
        p_values: P values of all tests of a family. None, an undefined value, counts as a test.

    Returns: The adjusted p values in the same order. Undefined ones stay None.

    >>> holm([0.03, 0.01, None])
    [0.06, 0.03, None]
    """
    values = np.array(list(p_values), dtype=np.float64)  # None becomes NaN
    order = np.argsort(values)
    products = np.arange(len(values), 0, -1) * values[order]
    adjusted = np.empty(len(values))
    adjusted[order] = np.maximum.accumulate(products.clip(None, 1.0))
    return [None if math.isnan(p) else p for p in adjusted.tolist()]
