"""Paired tests compared with SciPy, with hand-made cases, and with the paper's last table."""

import json
import math
import tracemalloc
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from hlsim.evaluation.statistics import (
    MIN_ITEMS_FOR_INTERVAL,
    bootstrap_interval,
    holm,
    paired_comparison,
)


def draw(n: int) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    before = generator.uniform(0.0, 0.8, n)
    return before, np.clip(before + generator.normal(0.1, 0.15, n), 0.0, 1.0)


@pytest.mark.parametrize("n", [2, 3, 12, 49, 51, 400])
def test_equals_scipy(n: int) -> None:
    before, after = draw(n)
    c = paired_comparison(before, after)
    t = stats.ttest_rel(after, before)
    w = stats.wilcoxon(after, before, zero_method="wilcox")
    assert (c.n, c.zeros, c.t, c.p_t, c.w, c.p_w) == (
        *(n, 0, t.statistic, t.pvalue, w.statistic, w.pvalue),
    )
    assert c.before_mean == pytest.approx(before.mean(), abs=1e-15)
    assert c.after_std == pytest.approx(after.std(ddof=1), rel=1e-12)
    assert c.delta == pytest.approx(c.after_mean - c.before_mean, abs=1e-15)
    assert c.cohens_d == pytest.approx(c.t / math.sqrt(n), rel=1e-12)
    assert (c.ci_low is None) == (n < MIN_ITEMS_FOR_INTERVAL)


@pytest.mark.parametrize("n", [6, 12, 100])
def test_interval_is_scipys_expanded(n: int) -> None:
    before, after = draw(n)
    c = paired_comparison(before, after)
    wider = 1.0 - 2.0 * stats.norm.cdf(-stats.t.ppf(0.975, n - 1) * math.sqrt(n / (n - 1)))
    assert wider > 0.95
    expected = stats.bootstrap(
        (after - before,),
        np.mean,
        confidence_level=wider,
        n_resamples=9999,
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    assert (c.ci_low, c.ci_high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_intervals_of_few_values_contain_the_mean_as_often_as_stated() -> None:
    generator = np.random.default_rng(6)
    intervals = [bootstrap_interval(generator.normal(size=8)) for _ in range(400)]
    hits = sum(low <= 0.0 <= high for low, high in intervals)
    assert 0.91 < hits / 400 < 0.98  # plain percentiles: 0.88


def test_holm_by_hand_and_by_closed_testing() -> None:
    # 0.01 * 4, 0.02 * 3, 0.03 * 2, and then not below the previous value
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.9, 0.8, None]) == [1.0, 1.0, None]
    assert holm([0.01, None, 0.02]) == pytest.approx([0.03, None, 0.04])
    assert holm([]) == []
    # Closed testing: the largest of Bonferroni's p values of all groups that contain a hypothesis.
    p = np.random.default_rng(5).uniform(0.0, 0.2, 8)
    groups = [group for size in range(1, 9) for group in combinations(range(8), size)]
    closed = [max(min(1.0, len(g) * min(p[[*g]])) for g in groups if i in g) for i in range(8)]
    assert holm(p) == pytest.approx(closed, abs=1e-15)


def test_zero_differences_are_dropped_and_counted() -> None:
    before, after = draw(20)
    c = paired_comparison(before, after)
    more = paired_comparison([*before, 0.5, 0.25, 1.0], [*after, 0.5, 0.25, 1.0])
    assert (more.n, more.zeros, more.w, more.p_w) == (23, 3, c.w, c.p_w)
    # Five rises among 14 pairs: 2 of 32 combinations of signs are as one-sided.
    mostly = paired_comparison([0.5] * 14, [0.5] * 9 + [0.51, 0.52, 0.53, 0.54, 0.55])
    assert (mostly.n, mostly.zeros, mostly.w, mostly.p_w) == (14, 9, 0.0, 0.0625)


@pytest.mark.parametrize("scale", [1.0, 0.8, 0.64, 5.0, 1e-3, 1e4])
def test_differences_of_equal_size_share_a_rank(scale: float) -> None:
    """Eight rises and two falls by 0.1: all have rank 5.5, so that W is 11."""
    before = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.2, 0.3])
    after = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.7, 0.1, 0.4])
    assert len(set(np.abs(after - before))) > 1  # because of rounding
    c = paired_comparison(scale * before, scale * after)
    assert c.w == 11.0
    # 56 of 1024 combinations have two falls or fewer. SciPy before 1.15 ignores ties here.
    assert c.p_w == pytest.approx(2 * 56 / 1024, abs=0.005)


SCORES = draw(8)[0].tolist()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("before", "after", "undefined"),
    [
        ([0.25], [0.75], "before_std t p_t w p_w cohens_d"),
        (SCORES, [score + 0.1 for score in SCORES], "t p_t cohens_d"),
        (SCORES, [score + 0.3 for score in SCORES], "t p_t cohens_d"),
        (SCORES, [score * (1 + 1e-9 * i) for i, score in enumerate(SCORES)], "t w p_w cohens_d"),
        ([0.3, 0.5, 0.9], [0.3, 0.5, 0.9], "t p_t w p_w cohens_d ci_low"),
    ],
)
def test_undefined_values_are_none_and_never_nan(
    before: list[float], after: list[float], undefined: str
) -> None:
    values = vars(paired_comparison(before, after))
    assert [values[name] for name in undefined.split()] == [None] * len(undefined.split())
    assert json.loads(json.dumps(values, allow_nan=False)) == values


@pytest.mark.parametrize(
    ("before", "after"),
    [([0.1, 0.2], [0.1]), ([], []), ([0.1, math.nan], [0.1, 0.2]), ([0.1, 0.2], [math.inf, 0.2])],
)
def test_invalid_scores_are_rejected(before: list[float], after: list[float]) -> None:
    with pytest.raises(ValueError, match="expected two finite scores"):
        paired_comparison(before, after)
    assert bootstrap_interval(before) is None


def test_equal_differences_share_a_rank_in_either_precision() -> None:
    before, after = [0.01, 0.77, 0.98, 0.59], [0.32, 0.19, 0.67, 0.20]
    single = [np.array(scores, dtype=np.float32).tolist() for scores in (before, after)]
    assert paired_comparison(*single).w == paired_comparison(before, after).w == 1.5
    assert paired_comparison(*single).p_w == paired_comparison(before, after).p_w == 0.375


def test_intervals_of_many_values_need_little_memory() -> None:
    values = np.arange(3000.0)
    tracemalloc.start()
    bootstrap_interval(values)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6  # All draws at once take 500 MB.
