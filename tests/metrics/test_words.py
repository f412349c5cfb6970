"""The model of the words understood equals a new fit and predicts a listener left out of it."""

import runpy

import numpy as np
import pytest

from hlsim.metrics.words import load_curve, simulate_proportions, words_change
from tests.helpers import FIGURES

EXAMPLE = FIGURES / "fit_words.py"


@pytest.mark.slow
def test_bundled_parameters_are_those_of_a_new_fit() -> None:
    example = runpy.run_path(str(EXAMPLE))
    rows = example["read_responses"]()
    assert (len(rows), rows.listener.nunique(), rows.system.nunique()) == (2001, 22, 10)
    fit = example["fit"](rows)
    for name, value in load_curve()._asdict().items():
        expected = getattr(fit.curve, name)
        np.testing.assert_allclose(value, expected, rtol=2e-2, atol=2e-4, err_msg=name)
    means_of_aids = rows.groupby("system")[["haspi", "correctness"]].mean()
    # The docstring of the module says 0.97.
    assert means_of_aids.corr().iloc[0, 1] > 0.96
    # The logistic function of the challenge has an RMS error of 26.4 points per sentence.
    error = 100.0 * (example["predict"](fit.curve, rows) - rows.hits / rows.n_words)
    assert np.sqrt(np.square(error).mean()) < 26.4


@pytest.mark.slow
def test_the_interval_contains_a_listener_left_out_of_the_fit() -> None:
    example = runpy.run_path(str(EXAMPLE))
    rows = example["read_responses"]()
    average_listener = "L0209"
    responses = rows[rows.listener == average_listener]
    curve = example["fit"](rows[rows.listener != average_listener].reset_index(drop=True)).curve
    first, second = (responses[responses.system == name] for name in ("E001", "E003"))
    aids = [(aid.haspi.to_numpy(), aid["mean"].iloc[0]) for aid in (first, second)]
    before, after = simulate_proportions(curve, aids)
    low, high = np.quantile(after - before, [0.05, 0.95])
    change = (second.hits / second.n_words).mean() - (first.hits / first.n_words).mean()
    assert low < change < high and 0.2 < high - low < 0.8


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
