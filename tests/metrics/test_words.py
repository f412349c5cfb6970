"""Words understood as HASPI tells them, against a fit made anew of the listeners' responses."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from hlsim.metrics.words import fitted, simulate, words_change

EXAMPLE = Path(__file__).parents[2] / "examples" / "fit_words.py"


@pytest.mark.slow
def test_what_ships_is_what_a_fit_of_the_responses_gives() -> None:
    example = runpy.run_path(str(EXAMPLE))
    rows = example["data"]()
    assert (len(rows), rows.listener.nunique(), rows.system.nunique()) == (2001, 22, 10)
    fit = example["fit"](rows)
    for name, value in fitted()._asdict().items():
        np.testing.assert_allclose(
            value, getattr(fit.curve, name), rtol=2e-2, atol=2e-4, err_msg=name
        )
    by_aid = rows.groupby("system")[["haspi", "correctness"]].mean()
    assert by_aid.corr().iloc[0, 1] > 0.96  # as its docstring says, 0.97
    # the plain logistic of the challenge misses a sentence by 26.4 points
    error = 100.0 * (example["expected"](fit.curve, rows) - rows.hits / rows.n_words)
    assert np.sqrt(np.square(error).mean()) < 26.4


@pytest.mark.slow
def test_a_listener_who_was_left_out_lies_in_the_interval() -> None:
    example = runpy.run_path(str(EXAMPLE))
    rows = example["data"]()
    own = rows[rows.listener == "L0209"]  # average
    curve = example["fit"](rows[rows.listener != "L0209"].reset_index(drop=True)).curve
    aids = [own[own.system == name] for name in ("E001", "E003")]
    drawn = simulate(curve, [(aid.haspi.to_numpy(), aid["mean"].iloc[0]) for aid in aids])
    low, high = np.quantile(drawn, [0.05, 0.95])
    heard = (aids[1].hits / aids[1].n_words).mean() - (aids[0].hits / aids[0].n_words).mean()
    assert low < heard < high and 0.2 < high - low < 0.8


def test_more_haspi_is_more_words() -> None:
    shares = [words_change([0.3] * 20, [h] * 20).after for h in np.linspace(0.0, 1.0, 11)]
    assert np.all(np.diff(shares) > 0.0) and 0.0 < shares[0] < 0.2 and 0.9 < shares[-1] < 1.0


def test_the_same_scores_change_nothing_on_average_and_more_sentences_narrow_the_interval() -> None:
    few, many = (words_change([0.6] * count, [0.6] * count) for count in (2, 200))
    assert abs(few.change) < 0.02 and few.low < 0.0 < few.high and many.low < 0.0 < many.high
    assert many.high - many.low < 0.7 * (few.high - few.low)
    assert few == words_change([0.6] * 2, [0.6] * 2)  # the same every time
    drawn = simulate(fitted(), [(np.full(200, 0.6), 0.6)] * 2)
    assert abs(drawn.mean()) < 0.02
    half = words_change([0.6] * 2, [0.6] * 2, interval=0.5)
    assert few.low < half.low < half.high < few.high


@pytest.mark.parametrize("scores", [[], [[0.5]], [1.2], [float("nan")]])
def test_what_is_no_score_is_refused(scores: list[float]) -> None:
    with pytest.raises(ValueError):
        words_change(scores, [0.5])
    with pytest.raises(ValueError):
        words_change([0.5], [0.5], interval=1)
