"""The model of the words understood agrees with people."""

import json
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hlsim.metrics.words import load_curve, predict_words, simulate_proportions, words_change


def _first_challenge() -> pd.DataFrame:
    """Read the responses of Clarity's first challenge in pyclarity, of ten aids and 22 listeners.

    Three of the aids, and half of the responses, took no part in the fit.
    """
    spec = find_spec("recipes")
    assert spec is not None and spec.submodule_search_locations
    recipes = Path(spec.submodule_search_locations[0])
    haspi_path = recipes / "cpc3/baseline/precomputed_haspi/clarity_data.train.haspi.jsonl"
    with haspi_path.open() as file:
        scores = {row["signal"]: row["haspi"] for row in map(json.loads, file)}
    responses_path = recipes / "cpc1/test_listener_responses/CPC1.test.json"
    rows = pd.DataFrame(json.loads(responses_path.read_text()))
    rows["haspi"] = ("CEC1_" + rows.system + "_" + rows.scene + "_" + rows.listener).map(scores)
    return rows.dropna(subset="haspi")


@pytest.mark.slow
def test_the_curve_agrees_with_people() -> None:
    rows = _first_challenge()
    assert (len(rows), rows.listener.nunique(), rows.system.nunique()) == (2001, 22, 10)
    errors = []
    for _, aid in rows.groupby("system"):
        haspi = aid.haspi.to_numpy()
        predicted = words_change(haspi, haspi, challenge=1).before
        errors.append(predicted - (aid.hits / aid.n_words).mean())
    assert abs(np.mean(errors)) < 0.03 and np.sqrt(np.square(errors).mean()) < 0.07
    assert np.abs(errors).max() < 0.11
    means_of_aids = rows.groupby("system")[["haspi", "correctness"]].mean()
    # The docstring of the module says 0.97.
    assert means_of_aids.corr().iloc[0, 1] > 0.96


@pytest.mark.slow
def test_the_interval_contains_nine_of_ten_changes() -> None:
    rows = _first_challenge()
    curve = load_curve().of_challenge(1)
    mean = rows.groupby("system").haspi.mean()
    is_inside = []
    for _, responses in rows.groupby("listener"):
        aids = {name: aid for name, aid in responses.groupby("system")}
        for first, second in combinations(aids, 2):
            pair = [(aids[name].haspi.to_numpy(), mean[name]) for name in (first, second)]
            before, after = simulate_proportions(curve, pair)
            low, high = np.quantile(after - before, [0.05, 0.95])
            shares = [(aids[name].hits / aids[name].n_words).mean() for name in (first, second)]
            is_inside.append(low <= shares[1] - shares[0] <= high)
    assert 0.85 < np.mean(is_inside) < 0.95


def test_the_second_challenge_is_harder_and_its_knowledge_narrows_the_prediction() -> None:
    haspi = [0.6] * 50
    first, unknown, second = (words_change(haspi, haspi, challenge=c) for c in (1, None, 2))
    assert second.before + 0.05 < unknown.before < first.before - 0.05
    curve, aid = load_curve(), [(np.array(haspi), 0.6)]
    [any_challenge], [first_challenge] = (
        simulate_proportions(variant, aid) for variant in (curve, curve.of_challenge(1))
    )
    assert first_challenge.std() < any_challenge.std()
    # Both aids are heard in the same test, so its difficulty hardly widens the change.
    assert unknown.high - unknown.low < 1.15 * (second.high - second.low)


@pytest.mark.parametrize("challenge", [0, 3])
def test_unknown_challenges_are_rejected(challenge: int) -> None:
    with pytest.raises(ValueError, match=f"expected challenge to be 1 or 2, got {challenge}"):
        words_change([0.5], [0.5], challenge=challenge)


def test_words_increase_with_haspi() -> None:
    shares = [words_change([0.3] * 20, [h] * 20).after for h in np.linspace(0.0, 1.0, 11)]
    assert np.all(np.diff(shares) > 0.0) and 0.0 < shares[0] < 0.2 and 0.9 < shares[-1] < 1.0


def test_equal_scores_give_no_change_on_average_and_more_of_them_narrow_the_interval() -> None:
    few, many = (words_change([0.6] * count, [0.6] * count) for count in (2, 200))
    for change in (few, many):
        assert abs(change.change) < 0.02 and change.low < 0.0 < change.high
    assert many.high - many.low < 0.7 * (few.high - few.low)
    assert few == words_change([0.6] * 2, [0.6] * 2)


@pytest.mark.parametrize("scores", [[], [[0.5]], [1.2], [float("nan")]])
def test_bad_scores_are_rejected(scores: list[float]) -> None:
    with pytest.raises(ValueError):
        words_change(scores, [0.5])


def test_a_prediction_without_scores_names_them() -> None:
    with pytest.raises(ValueError, match="expected scores to be HASPI scores"):
        predict_words([float("nan")])
    assert predict_words([0.3, 0.4, float("nan")]) == words_change([0.3, 0.4], [0.5]).before
