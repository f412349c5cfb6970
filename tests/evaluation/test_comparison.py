"""Comparisons of conditions: severities, listeners, Holm, and what the words say."""

from dataclasses import replace

import numpy as np
import pytest

from hlsim.audiogram import Audiogram
from hlsim.evaluation import ItemScore, holm, paired_comparison
from hlsim.evaluation.previous.comparison import Comparison, compare_conditions, p_text


def item(i: int, scores: dict[str, float], *, listener: str = "", louder: float = 0.0) -> ItemScore:
    levels = {name: 65.0 + louder * k for k, name in enumerate(scores)}
    ear = Audiogram.standard(("NH", "N2", "N4")[i % 3])
    return ItemScore(
        f"s{i}", ear, 65.0, levels, {"haspi": scores}, 16000, 2.0, i, listener=listener
    )


def draw(n: int, change: float, *, louder: float = 0.0, listeners: int = 0) -> list[ItemScore]:
    rng = np.random.default_rng(0)
    return [
        item(
            i,
            {
                "a": (low := float(rng.uniform(0.2, 0.6))),
                "b": low + change + 0.05 * float(rng.normal()),
            },
            listener=f"L{i % listeners}" if listeners else "",
            louder=louder,
        )
        for i in range(n)
    ]


def only(items: list[ItemScore]) -> Comparison:
    (found,) = compare_conditions(items, ["haspi"], ["a", "b"])
    return found


def test_severities_and_listeners_are_the_items_of_theirs() -> None:
    items = draw(30, 0.1, listeners=5)
    found = only(items)
    assert list(found.by_severity) == ["none", "moderate", "severe"]
    for name, own in found.by_severity.items():
        members = [i.scores["haspi"] for i in items if i.audiogram.severity == name]
        assert own == paired_comparison([s["a"] for s in members], [s["b"] for s in members])
    means = {
        end: [
            np.mean([i.scores["haspi"][end] for i in items if i.listener == f"L{k}"])
            for k in range(5)
        ]
        for end in "ab"
    }
    assert found.listeners is not None and found.listeners.n == 5
    expected = paired_comparison(means["a"], means["b"])
    assert found.listeners.p_t == pytest.approx(expected.p_t, rel=1e-9)
    assert found.listeners.delta == pytest.approx(
        found.overall.delta
    )  # as many items of each listener
    assert only(draw(30, 0.1)).listeners is None


def test_holm_is_over_the_comparisons_of_a_measure() -> None:
    rng = np.random.default_rng(1)
    items = [
        item(
            i,
            {
                "a": 0.3,
                "b": 0.34 + 0.1 * float(rng.normal()),
                "c": 0.36 + 0.1 * float(rng.normal()),
            },
        )
        for i in range(20)
    ]
    items = [
        replace(
            i, scores={**i.scores, "stoi": {name: x / 2 for name, x in i.scores["haspi"].items()}}
        )
        for i in items
    ]
    found = compare_conditions(items, ["haspi", "stoi"], ["a", "b", "c"])
    own = [c for c in found if c.measure == "haspi"]
    assert [c.p_t_holm for c in own] == holm(c.overall.p_t for c in own)
    assert [c.p_w_holm for c in own] == holm(c.overall.p_w for c in own)
    assert {c.comparisons for c in found} == {3} and len(found) == 6
    first = compare_conditions(items, ["haspi"], ["a", "b", "c"], baseline="a")
    assert [(c.before, c.after, c.comparisons) for c in first] == [("a", "b", 2), ("a", "c", 2)]


def test_items_without_both_scores_are_left_out() -> None:
    items = [*draw(5, 0.1), item(5, {"a": 0.5})]
    items[-1] = replace(items[-1], levels={"a": 65.0, "b": None})
    assert only(items).overall.n == 5
    assert compare_conditions(items[-1:], ["haspi"], ["a", "b"]) == []


@pytest.mark.parametrize(
    ("items", "says"),
    [
        (
            draw(30, 0.2),
            [
                "HASPI rose by 0.2",
                "30 items",
                "Chance alone hardly explains it",
                "taken as independent",
            ],
        ),
        (
            draw(30, -0.2, louder=-6.0),
            ["HASPI fell by", "The level fell by 6.0 dB, and HASPI rewards gain", "attenuation"],
        ),
        (
            draw(30, 0.2, louder=-6.0),
            ["The level fell by 6.0 dB, so that gain does not explain a rise"],
        ),
        (
            draw(30, -0.2, louder=6.0),
            ["The level rose by 6.0 dB, so that gain does not explain a fall"],
        ),
        (draw(10, 0.0), ["cannot be told from chance", "does not show that there is no change"]),
        (draw(30, 0.2, louder=20.0), ["The level rose by 20.0 dB, and HASPI rewards gain"]),
        (draw(30, 0.2, listeners=6), ["over the means of the 6 listeners the t-test has p"]),
        (draw(1, 0.2), ["one item", "Neither test is defined"]),
        (
            [item(i, {"a": 0.5, "b": 0.5}) for i in range(3)],
            ["HASPI did not change", "Neither test is defined"],
        ),
        (
            [item(i, {"a": 0.5, "b": 0.5001}) for i in range(3)],
            ["HASPI changed by less than 0.001"],
        ),
        # five rises: the least that Wilcoxon's p can be is 0.0625
        (
            [item(i, {"a": 0.5, "b": 0.7 + i / 1e3}) for i in range(5)],
            ["Chance alone hardly explains it", "with so few Wilcoxon's cannot fall below 0.05"],
        ),
        # nine small rises and a large fall: the ranks and the means disagree
        (
            [item(i, {"a": 0.5, "b": 0.51 + i / 1e3 if i < 14 else 0.1}) for i in range(15)],
            ["The tests disagree"],
        ),
    ],
)
def test_words(items: list[ItemScore], says: list[str]) -> None:
    text = only(items).in_words()
    assert all(part in text for part in says), text
    assert "no listener was asked" in text and "nan" not in text and "None" not in text


def test_a_wilcoxon_below_the_limit_is_not_said_to_be_unable() -> None:
    """Six rises beside twenty: Holm takes 2 / 64 once, not twice."""
    items = [
        item(i, {"a": 0.3, "b": 0.4 + i / 1e3, **({"c": 0.5 + i / 1e3} if i < 6 else {})})
        for i in range(20)
    ]
    items = [replace(i, levels=dict.fromkeys("abc", 65.0)) for i in items]
    _, found = compare_conditions(items, ["haspi"], ["a", "b", "c"], baseline="a")
    assert (found.overall.n, found.comparisons, found.p_w_holm) == (6, 2, 0.03125)
    assert "Chance alone hardly explains it" in found.in_short()
    assert "Wilcoxon p = 0.03125" in found.in_short() and "cannot fall" not in found.in_short()


def test_items_without_a_row_under_one_condition_are_counted_in_words() -> None:
    items = draw(5, 0.1)
    assert only(items).left_out == 0 and "lack" not in only(items).in_words()
    lacking = [
        replace(i, scores={"haspi": {"a": 0.5}}, levels={"a": 65.0, "b": None}) for i in items[3:]
    ]
    found = only([*items[:3], *lacking])
    assert (found.overall.n, found.left_out, found.to_dict()["left_out"]) == (3, 2, 2)
    assert "(3 items). Items that lack HASPI under a or b do not count: 2." in found.in_short()


def test_words_of_stoi_do_not_speak_of_gain() -> None:
    items = [replace(i, scores={"stoi": i.scores["haspi"]}) for i in draw(10, 0.1, louder=20.0)]
    (found,) = compare_conditions(items, ["stoi"], ["a", "b"])
    assert (
        "STOI knows neither loss nor level" in found.in_words()
        and "rewards" not in found.in_words()
    )


def test_words_of_hasqi_do_not_say_that_it_rewards_gain() -> None:
    items = [replace(i, scores={"hasqi": i.scores["haspi"]}) for i in draw(10, -0.1, louder=20.0)]
    (found,) = compare_conditions(items, ["hasqi"], ["a", "b"], unit="ears")
    assert "on which HASQI depends too" in found.in_words() and "rewards" not in found.in_words()


def test_p_as_text() -> None:
    assert (p_text(0.5), p_text(1e-5), p_text(0.99e-5)) == (
        "p = 0.50000",
        "p = 0.00001",
        "p < 0.00001",
    )
