"""Plots: legible in light and dark, labels as they are, and no picture of a single group."""

import numpy as np
import pytest

from hlsim.evaluation import MEASURES, Condition, compare
from hlsim.evaluation.result import Evaluation
from hlsim.report.plots import (
    INK,
    UNAIDED_COLOUR,
    condition_colours,
    curves_picture,
    gain_picture,
    scores_pictures,
)

pytest.importorskip("matplotlib")
pandas = pytest.importorskip("pandas")


def test_ink_follows_the_colour_scheme_of_the_page_and_plots_are_reproducible() -> None:
    curves = {"_a $b$": ([250, 4000], [1.0, 2.0], {"color": "#2f7ed8"})}
    picture = curves_picture(curves, "A title", "level (dB)")
    assert picture.data == curves_picture(curves, "A title", "level (dB)").data
    text = picture.data.decode()
    assert INK not in text and "currentColor" in text
    assert "prefers-color-scheme: dark" in text
    assert "_a $b$" in text, "the label is shown as it is"


def test_a_linear_aid_has_one_gain_curve() -> None:
    axes = {"frequencies": [250, 1000, 4000], "levels": [50.0, 80.0]}
    gains = {"linear": [[5, 6, 7]] * 2, "compressor": [[5, 6, 7], [1, 2, 3]]}
    rows = [{"aid": aid, "gain_db": gain, **axes} for aid, gain in gains.items()]
    colours = {"linear": "#2f7ed8", "compressor": "#c96a00"}
    text = gain_picture("Gain", rows, colours).data.decode()
    assert text.count("linear") == 1
    assert text.count("compressor") == 2 and "80\N{NO-BREAK SPACE}dB" in text


def test_each_level_has_a_gain_curve() -> None:
    levels = [40.0, 50.0, 60.0, 70.0, 80.0]
    gains = [[20 - place, 20 - place] for place in range(5)]
    row = {"aid": "mine", "frequencies": [250, 4000], "levels": levels, "gain_db": gains}
    text = gain_picture("Gain", [row], {"mine": "#2f7ed8"}).data.decode()
    assert all(f"{level:g}\N{NO-BREAK SPACE}dB" in text for level in levels)


def test_colours_of_conditions() -> None:
    conditions = [
        Condition("none", kind="unaided"),
        Condition("NAL-R, same level", kind="same level", of="mine"),
        Condition("mine"),
        Condition("other"),
    ]
    colours = condition_colours(conditions)
    assert colours["none"] == UNAIDED_COLOUR
    assert colours["NAL-R, same level"] == (colours["mine"], 0.6)
    assert len({str(colour) for colour in colours.values()}) == 4
    many = condition_colours([Condition(f"aid {number}") for number in range(9)])
    assert len({*many.values()}) == 9, "two aids of one colour cannot be told apart"


def test_settings_of_the_user_neither_change_a_picture_nor_are_changed() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    curves = {"a": ([250, 4000], [1.0, 2.0], {"color": "#2f7ed8"})}
    expected = curves_picture(curves, "A title", "level (dB)").data
    with matplotlib.rc_context({"text.usetex": True, "axes.linewidth": 5.0}):
        assert curves_picture(curves, "A title", "level (dB)").data == expected
        assert matplotlib.rcParams["text.usetex"]


def test_thousands_of_points_are_an_image_in_the_picture() -> None:
    scores = np.linspace(0.1, 0.9, 3000)
    parts = [
        pandas.DataFrame({"item": range(3000), "condition": name, "haspi": values})
        for name, values in {"a": scores, "b": scores**2}.items()
    ]
    table, conditions = pandas.concat(parts), [Condition("a"), Condition("b")]
    comparisons = compare(table, ["haspi"])
    evaluation = Evaluation([], conditions, [MEASURES["haspi"]], table, comparisons)
    (picture,) = scores_pictures(evaluation)
    assert b"<image" in picture.data and len(picture.data) < 100_000
