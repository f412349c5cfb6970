"""Comparisons of conditions: degrees of loss, listeners, which p values are stated, and the words."""

import math

import numpy as np
import pytest

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation import Comparison, compare, holm, paired_comparison

pandas = pytest.importorskip("pandas")


def table(
    scores: dict[str, list[float]],
    *,
    measure: str = "haspi",
    louder: float = 0.0,
    listeners: int = 0,
) -> object:
    """Scores of items by condition; each condition is louder than the one before."""
    rows = []
    for place, (condition, values) in enumerate(scores.items()):
        for item, score in enumerate(values):
            facts = {"item": item, "severity": SEVERITIES[item % 3 + 1], "condition": condition}
            facts["listener"] = f"L{item % listeners}" if listeners else ""
            rows.append({**facts, measure: score, "level": 65.0 + louder * place})
    return pandas.DataFrame(rows)


def draw(n: int, change: float) -> dict[str, list[float]]:
    generator = np.random.default_rng(0)
    low = generator.uniform(0.2, 0.6, n)
    return {"a": low.tolist(), "b": (low + change + 0.05 * generator.normal(size=n)).tolist()}


def only(*arguments: object, **settings: object) -> Comparison:
    (comparison,) = compare(table(*arguments, **settings), [settings.get("measure", "haspi")])
    return comparison


def test_groups_are_compared_by_their_own_items() -> None:
    scores = draw(30, 0.1)
    found = only(scores, listeners=5)
    a, b = np.array(scores["a"]), np.array(scores["b"])
    assert found.overall == paired_comparison(a, b)
    for place, name in enumerate(SEVERITIES[1:]):
        assert found.by_severity[name] == paired_comparison(a[place::3], b[place::3])
    means = [[values[unit::5].mean() for unit in range(5)] for values in (a, b)]
    assert found.unit_means == paired_comparison(*means)
    assert only(scores).unit_means is None


def test_a_planned_comparison_keeps_its_p_and_all_others_are_adjusted() -> None:
    generator = np.random.default_rng(1)
    scores = {name: (0.3 + 0.1 * generator.normal(size=20)).tolist() for name in "abc"}
    all_pairs = compare(table(scores), ["haspi"])
    assert [c.p_t for c in all_pairs] == holm(c.overall.p_t for c in all_pairs)
    assert {(c.planned, c.family) for c in all_pairs} == {(False, 3)}
    found = compare(table(scores), ["haspi"], planned=[("haspi", "a", "c")])
    planned, *others = sorted(found, key=lambda c: not c.planned)
    assert (planned.before, planned.after, planned.p_t) == ("a", "c", planned.overall.p_t)
    assert [c.p_w for c in others] == holm(c.overall.p_w for c in others)
    for text in (planned.verdict(), planned.in_short()):
        assert f"t-test p = {planned.overall.p_t:.5f}" in text and "planned" in text
    baseline = compare(table(scores), ["haspi"], baseline="b")
    assert [(c.before, c.after) for c in baseline] == [("b", "a"), ("b", "c")]


def test_items_without_both_scores_are_left_out() -> None:
    scores = draw(5, 0.1)
    scores["b"][3] = math.nan
    found = only(scores)
    assert (found.overall.n, found.left_out) == (4, 1)
    assert compare(table({"a": [0.5], "b": [math.nan]}), ["haspi"]) == []


OUTLIER = {"a": [0.5] * 15, "b": [0.51 + i / 1e3 for i in range(14)] + [0.1]}


@pytest.mark.parametrize(
    ("scores", "settings", "says"),
    [
        (draw(30, 0.2), {}, ["rose by 0.2", "30 items", "Chance is an unlikely explanation"]),
        (draw(30, -0.2), {"louder": -6.0}, ["fell by", "6.0 dB, and HASPI rewards gain: less"]),
        (draw(30, 0.2), {"louder": -6.0}, ["so that gain does not explain a rise"]),
        (draw(30, 0.2), {"louder": 20.0}, ["rose by 20.0 dB, and HASPI rewards gain: more"]),
        (draw(10, 0.0), {}, ["This may be chance", "does not show that the two are equal"]),
        (draw(30, 0.2), {"listeners": 6}, ["the means of the 6 listeners gives p"]),
        (draw(1, 0.2), {}, ["1 item", "Neither test is defined"]),
        ({"a": [0.5] * 3, "b": [0.5] * 3}, {}, ["did not change", "Neither test is defined"]),
        ({"a": [0.5] * 3, "b": [0.5001] * 3}, {}, ["changed by less than 0.001"]),
        (OUTLIER, {}, ["The tests disagree"]),
        (draw(10, 0.1), {"measure": "stoi", "louder": 20.0}, ["STOI rates the output itself"]),
        (draw(10, -0.1), {"measure": "hasqi", "louder": 20.0}, ["changes HASQI too"]),
        (draw(10, 0.1), {"measure": "crest"}, ["crest rates the output itself"]),
    ],
)
def test_words(
    scores: dict[str, list[float]], settings: dict[str, object], says: list[str]
) -> None:
    found = only(scores, **settings)
    text = f"{found.in_short()} {found.limits()}"
    assert all(part in text for part in says), text
    assert "nan" not in text and "None" not in text


def test_five_rises_are_too_few_for_wilcoxon_and_not_held_against_the_t_test() -> None:
    found = only({"a": [0.5] * 5, "b": [0.7 + i / 1e3 for i in range(5)]})
    assert found.p_w == 0.0625 and "Chance is an unlikely explanation" in found.in_short()


@pytest.mark.parametrize(
    ("change", "louder", "says"),
    [
        (0.2, 0.0, "b is better than a: HASPI"),
        (-0.2, 0.5, "b is worse than a: HASPI"),
        (0.2, 3.0, "b scores higher than a, which is 3.0 dB softer: HASPI"),
        (0.0, 0.0, "b cannot be distinguished from a: HASPI"),
    ],
)
def test_only_at_equal_level_a_higher_score_is_better(
    change: float, louder: float, says: str
) -> None:
    verdict = only(draw(30, change), louder=louder).verdict()
    assert verdict.startswith(says) and verdict.count(". ") == 0 and verdict.endswith(".")
