"""Paired tests against scipy, against hand-made cases, and against the paper's last table."""

import json
import math
from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from hlsim.evaluation import bootstrap_interval, holm, paired_comparison
from hlsim.evaluation.statistics import FEWEST


def draw(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    before = rng.uniform(0.0, 0.8, n)
    return before, np.clip(before + rng.normal(0.1, 0.15, n), 0.0, 1.0)


@pytest.mark.parametrize("n", [2, 3, 12, 49, 51, 400])
def test_equals_scipy(n: int) -> None:
    before, after = draw(n)
    c = paired_comparison(before, after)
    t = stats.ttest_rel(after, before)
    w = stats.wilcoxon(after, before, zero_method="wilcox")
    assert (c.n, c.zeros) == (n, 0)
    assert (c.t, c.p_t) == (t.statistic, t.pvalue)
    assert (c.w, c.p_w) == (w.statistic, w.pvalue)
    if n < FEWEST:
        assert c.ci_low is None and c.ci_high is None
    else:
        assert c.ci_low is not None and c.ci_high is not None and c.ci_low <= c.delta <= c.ci_high
    assert c.before_mean == pytest.approx(before.mean(), abs=1e-15)
    assert c.after_std == pytest.approx(
        math.sqrt(((after - after.mean()) ** 2).sum() / (n - 1)), rel=1e-12
    )
    assert c.delta == pytest.approx(c.after_mean - c.before_mean, abs=1e-15)
    assert c.cohens_d == pytest.approx(c.t / math.sqrt(n), rel=1e-12)


def test_by_hand() -> None:
    c = paired_comparison([0.0, 0.25, 0.75, 0.125], [0.25, 0.75, 0.5, 0.875])
    # differences 0.25, 0.5, -0.25, 0.75: mean 0.3125, squares about it sum to 0.546875; ranks 1.5, 3, -1.5, 4
    deviation = math.sqrt(0.546875 / 3)
    assert c.delta == 0.3125
    assert c.cohens_d == pytest.approx(0.3125 / deviation, rel=1e-14)
    assert c.t == pytest.approx(2 * 0.3125 / deviation, rel=1e-14)
    assert c.w == 1.5
    assert c.before_std == pytest.approx(math.sqrt(0.32421875 / 3), rel=1e-12)


def test_the_papers_row() -> None:
    """HASPI 0.428 to 0.616, |t| = 24.113, n = 1648, d = 0.594: d is t / sqrt(n)."""
    n, t = 1648, 24.113
    rng = np.random.default_rng(0)
    noise = rng.normal(size=n)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    before = rng.uniform(size=n)
    c = paired_comparison(before, before + 0.187 * (1.0 + noise * math.sqrt(n) / t))
    assert c.delta == pytest.approx(0.187, abs=1e-12)
    assert c.t == pytest.approx(t, rel=1e-9)
    assert c.cohens_d is not None and round(c.cohens_d, 3) == 0.594
    assert c.p_t is not None and c.p_t < 1e-5 and c.p_w is not None and c.p_w < 1e-5
    # the paper's sign: before minus after
    turned = paired_comparison(before + 0.187 * (1.0 + noise * math.sqrt(n) / t), before)
    assert turned.t == pytest.approx(-24.113, rel=1e-9)
    assert abs(-24.113) / math.sqrt(1648) == pytest.approx(0.594, abs=5e-4)


@pytest.mark.parametrize("n", [6, 12, 100])
def test_interval_is_scipys_expanded(n: int) -> None:
    before, after = draw(n)
    c = paired_comparison(before, after)
    wider = 1.0 - 2.0 * stats.norm.cdf(-stats.t.ppf(0.975, n - 1) * math.sqrt(n / (n - 1)))
    assert wider > 0.95
    # scipy draws as we do where all resamples are drawn at once
    options = {
        "random_state": np.random.default_rng(0),
        "n_resamples": 9999,
        "method": "percentile",
    }
    scipys = stats.bootstrap(
        (after - before,), np.mean, confidence_level=wider, **options
    ).confidence_interval
    assert (c.ci_low, c.ci_high) == pytest.approx((scipys.low, scipys.high), abs=1e-12)


def test_interval_of_many_is_the_normal_one() -> None:
    values = np.random.default_rng(4).normal(0.2, 1.0, 4000)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std(ddof=1) / math.sqrt(4000)
    assert (low, high) == pytest.approx(
        (values.mean() - half, values.mean() + half), abs=0.03 * half
    )
    narrow = bootstrap_interval(values, confidence=0.5)
    assert low < narrow[0] < values.mean() < narrow[1] < high
    assert bootstrap_interval(values, seed=1) != (low, high) == bootstrap_interval(values)
    with pytest.raises(ValueError, match="5 values; an interval needs 6 or more"):
        bootstrap_interval([0.5, 0.1, 0.2, 0.3, 0.4])


def test_intervals_of_few_hold_the_mean_as_often_as_they_say() -> None:
    rng = np.random.default_rng(6)
    held = 0
    for _ in range(400):
        low, high = bootstrap_interval(rng.normal(size=8), resamples=999)
        held += low <= 0.0 <= high
    assert 0.91 < held / 400 < 0.98  # plain percentiles: 0.88


def test_rounding_is_no_difference() -> None:
    before, _ = draw(12)
    rounded = before * (1.0 + 1e-9 * np.arange(-6, 6))
    c = paired_comparison(before, rounded)
    assert (c.zeros, c.t, c.p_t, c.w, c.p_w, c.cohens_d) == (12, None, None, None, None, None)
    c = paired_comparison(before, before + 0.1)
    assert (c.zeros, c.t, c.cohens_d) == (0, None, None) and c.delta == pytest.approx(0.1)


def test_holm_by_hand_and_by_closed_testing() -> None:
    # 0.01 * 4, 0.02 * 3, 0.03 * 2, then not below its forerunner
    assert holm([0.03, 0.01, 0.04, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert holm([0.9, 0.8, None]) == [1.0, 1.0, None]
    assert holm([0.01, None, 0.02]) == pytest.approx([0.03, None, 0.04])  # as many as are named
    assert holm([]) == [] and holm([None]) == [None] and holm([0.04]) == [0.04]
    # Bonferroni's p of every group of hypotheses, the largest of those that one is in
    p = np.random.default_rng(5).uniform(0.0, 0.2, 8)
    groups = [group for size in range(1, 9) for group in combinations(range(8), size)]
    closed = [max(min(1.0, len(g) * min(p[[*g]])) for g in groups if i in g) for i in range(8)]
    assert holm(p) == pytest.approx(closed, abs=1e-15)


def test_signs_turn_with_the_order() -> None:
    before, after = draw(30)
    c, turned = paired_comparison(before, after), paired_comparison(after, before)
    assert c.t is not None and c.t > 0 and c.delta > 0
    assert (turned.t, turned.delta, turned.cohens_d) == (-c.t, -c.delta, -c.cohens_d)
    assert (turned.p_t, turned.w, turned.p_w) == (c.p_t, c.w, c.p_w)


def test_zero_differences_are_dropped_and_counted() -> None:
    before, after = draw(20)
    more = paired_comparison([*before, 0.5, 0.25, 1.0], [*after, 0.5, 0.25, 1.0])
    c = paired_comparison(before, after)
    assert (more.n, more.zeros) == (23, 3)
    assert (more.w, more.p_w) == (c.w, c.p_w)
    # five rises of fourteen: two of 32 ways to set their signs are as one-sided
    mostly = paired_comparison([0.5] * 14, [0.5] * 9 + [0.51, 0.52, 0.53, 0.54, 0.55])
    assert (mostly.n, mostly.zeros, mostly.w, mostly.p_w) == (14, 9, 0.0, 0.0625)


@pytest.mark.parametrize("scale", [1.0, 0.8, 0.64, 5.0, 1e-3, 1e4])
def test_changes_of_one_size_share_a_rank(scale: float) -> None:
    """Eight rises and two falls by 0.1: all have rank 5.5, so that W is 11."""
    before = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.2, 0.3])
    after = np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.7, 0.1, 0.4])
    assert len(set(np.abs(after - before))) > 1  # rounding parts them
    c = paired_comparison(scale * before, scale * after)
    assert c.w == 11.0
    # 56 of 1024 ways have two falls or fewer; scipy before 1.15 takes its table for ranks without ties
    assert c.p_w == pytest.approx(2 * 56 / 1024, abs=0.005)


@pytest.mark.parametrize("shift", [0.1, 0.3])
def test_equal_differences_leave_t_and_d_undefined(shift: float) -> None:
    """0.1 apart but for rounding: a spread of 1e-17 must not become a t of 1e16."""
    before = np.linspace(0.0, 0.6, 12)
    c = paired_comparison(before, before + shift)
    assert (c.t, c.p_t, c.cohens_d) == (None, None, None)
    assert c.delta == pytest.approx(shift)
    assert c.w == 0.0 and c.p_w is not None and c.p_w < 0.05


def test_no_difference() -> None:
    c = paired_comparison([0.3, 0.5, 0.9], [0.3, 0.5, 0.9])
    assert (c.delta, c.zeros) == (0.0, 3)
    assert (c.t, c.p_t, c.w, c.p_w, c.cohens_d) == (None,) * 5
    assert c.before_std == c.after_std and c.before_std is not None


def test_one_pair() -> None:
    c = paired_comparison([0.25], [0.75])
    assert (c.n, c.before_mean, c.after_mean, c.delta) == (1, 0.25, 0.75, 0.5)
    assert (c.before_std, c.after_std, c.t, c.p_t, c.w, c.p_w, c.cohens_d) == (None,) * 7


@pytest.mark.parametrize(
    "pairs", [([0.1], [0.2]), ([0.1, 0.2], [0.1, 0.2]), ([0.0, 0.0], [0.5, 0.5]), draw(30)]
)
def test_json_holds_it_without_nan(pairs: tuple[list[float], list[float]]) -> None:
    c = paired_comparison(*pairs)
    assert json.loads(json.dumps(c.to_dict(), allow_nan=False)) == c.to_dict()


@pytest.mark.filterwarnings("error")
def test_undefined_cases_do_not_warn() -> None:
    for pairs in (([0.1], [0.2]), ([0.1, 0.2], [0.1, 0.2]), ([0.0, 0.5], [0.5, 1.0])):
        paired_comparison(*pairs)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ([0.1, 0.2], [0.1], "2 scores before and 1 after"),
        ([], [], "no scores before"),
        ([0.1, math.nan], [0.1, 0.2], "score 1 before is nan"),
        ([0.1, 0.2], [math.inf, 0.2], "score 0 after is inf"),
    ],
)
def test_bad_input(before: list[float], after: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        paired_comparison(before, after)
