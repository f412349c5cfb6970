"""Comparisons of conditions: groups of items, stated p values, and sentences."""

import math
from typing import Any

import numpy as np
import pytest

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation import ConditionComparison, compare
from hlsim.evaluation.statistics import holm, paired_comparison
from hlsim.report.verdict import limits, verdict

pandas = pytest.importorskip("pandas")

Scores = dict[str, list[float]]


def table(
    scores: Scores, *, measure: str = "haspi", louder: float = 0.0, listeners: int = 0
) -> Any:
    """Return the table of scores by condition. Each condition is louder than the previous one."""
    rows = []
    for place, (condition, values) in enumerate(scores.items()):
        for item, score in enumerate(values):
            facts = {"item": item, "severity": SEVERITIES[item % 3 + 1], "condition": condition}
            facts["listener"] = f"L{item % listeners}" if listeners else ""
            rows.append({**facts, measure: score, "level": 65.0 + louder * place})
    return pandas.DataFrame(rows)


def draw(n: int, change: float) -> Scores:
    generator = np.random.default_rng(0)
    low = generator.uniform(0.2, 0.6, n)
    return {"a": low.tolist(), "b": (low + change + 0.05 * generator.normal(size=n)).tolist()}


def compare_two(scores: Scores, **settings: Any) -> ConditionComparison:
    (comparison,) = compare(table(scores, **settings), [settings.get("measure", "haspi")])
    return comparison


def test_groups_are_compared_by_their_items() -> None:
    scores = draw(30, 0.1)
    comparison = compare_two(scores, listeners=5)
    a, b = np.array(scores["a"]), np.array(scores["b"])
    assert comparison.overall == paired_comparison(a, b)
    means = [[values[unit::5].mean() for unit in range(5)] for values in (a, b)]
    assert comparison.unit_means == paired_comparison(*means)
    assert compare_two(scores).unit_means is None


def test_numbers_are_names_of_units_and_an_item_without_a_unit_prevents_their_test() -> None:
    rows = table(draw(30, 0.1), listeners=5)
    (expected,) = compare(rows, ["haspi"])
    (numbered,) = compare(rows.assign(listener=rows["item"] % 5), ["haspi"])
    assert numbered.unit_means == expected.unit_means is not None
    for missing in ("", None, math.nan):
        names = [
            name if item else missing for item, name in zip(rows.item, rows.listener, strict=True)
        ]
        (comparison,) = compare(rows.assign(listener=names), ["haspi"])
        assert comparison.unit_means is None
        assert comparison.overall == expected.overall


def test_the_p_values_of_all_but_planned_comparisons_are_adjusted() -> None:
    generator = np.random.default_rng(1)
    scores = {name: (0.3 + 0.1 * generator.normal(size=20)).tolist() for name in "abc"}
    pairs = compare(table(scores), ["haspi"])
    assert [c.p_t for c in pairs] == holm(c.overall.p_t for c in pairs)
    assert {(c.planned, c.family) for c in pairs} == {(False, 3)}
    pairs = compare(table(scores), ["haspi"], planned=[("haspi", "a", "c")])
    assert compare(table(scores), ["haspi"], planned=[("haspi", "c", "a")]) == pairs
    planned, *adjusted = sorted(pairs, key=lambda c: not c.planned)
    assert (planned.before, planned.after, planned.p_t) == ("a", "c", planned.overall.p_t)
    assert [c.p_w for c in adjusted] == holm(c.overall.p_w for c in adjusted)
    assert f"t-test p = {planned.overall.p_t:.5f}" in verdict(planned)
    assert "planned comparison, not adjusted" in verdict(planned)
    assert "adjusted by Holm for 2 comparisons" in verdict(adjusted[0])
    baseline = compare(table(scores), ["haspi"], baseline="b")
    assert [(c.before, c.after) for c in baseline] == [("b", "a"), ("b", "c")]


def test_items_without_both_scores_are_left_out() -> None:
    scores = draw(5, 0.1)
    scores["b"][3] = math.nan
    comparison = compare_two(scores)
    assert (comparison.overall.n, comparison.left_out) == (4, 1)
    assert "1 item without both scores" in limits(comparison)
    assert compare(table({"a": [0.5], "b": [math.nan]}), ["haspi"]) == []


OUTLIER = {"a": [0.5] * 15, "b": [0.51 + i / 1e3 for i in range(14)] + [0.1]}
FIVE_RISES = {"a": [0.5] * 5, "b": [0.7 + i / 1e3 for i in range(5)]}


@pytest.mark.parametrize(
    ("scores", "settings", "sentences"),
    [
        (draw(30, 0.2), {}, ["b is better than a: HASPI", "(30 items, change +0.2"]),
        (draw(30, -0.2), {"louder": 0.5}, ["b is worse than a: HASPI", "changed by +0.5 dB. The"]),
        (draw(30, 0.2), {"louder": 3.0}, ["b scores higher than a, which is 3.0 dB softer: HASPI"]),
        (draw(30, -0.2), {"louder": -6.0}, ["by -6.0 dB. HASPI rewards gain, which alone may"]),
        (draw(30, 0.2), {"louder": -6.0}, ["by -6.0 dB. The tests"]),
        (draw(10, 0.0), {}, ["b cannot be distinguished from a: HASPI"]),
        (draw(10, 0.0), {"louder": -6.0}, ["distinguished", "The mean level changed by -6.0 dB. "]),
        (draw(30, 0.2), {"listeners": 6}, ["the means of the 6 listeners gives p"]),
        (draw(1, 0.2), {}, ["(1 item, ", "neither test is defined"]),
        ({"a": [0.5] * 3, "b": [0.5] * 3}, {}, ["cannot be distinguished", "neither test"]),
        (OUTLIER, {}, ["b may be worse than a"]),
        (FIVE_RISES, {}, ["b is better than a", "Wilcoxon p = 0.06250"]),
        (draw(10, 0.1), {"measure": "stoi", "louder": 20.0}, ["by +20.0 dB. The tests"]),
    ],
)
def test_sentences(scores: Scores, settings: dict[str, Any], sentences: list[str]) -> None:
    comparison = compare_two(scores, **settings)
    first_sentence = verdict(comparison)
    text = f"{first_sentence} {limits(comparison)}"
    assert all(sentence in text for sentence in sentences), text
    assert "nan" not in text and "None" not in text
    assert first_sentence.count(". ") == 0
    assert first_sentence.endswith(".")
