"""Drawn audiograms: axes, bands, and the symbols of audiology."""

import sys

import pytest

from hlsim import Audiogram, Listener
from hlsim.audiogram import SEVERITIES, SEVERITY_LIMITS
from hlsim.extras import MissingExtraError


def test_axes_are_those_of_audiology_and_are_prepared_once() -> None:
    figure = pytest.importorskip("matplotlib.figure")
    axes = figure.Figure().subplots()
    right, left = Audiogram.standard("N3"), Audiogram((10, 40), (500, 3000))
    assert right.plot(axes, color="tab:red", label="right") is axes
    assert left.plot(axes, marker="x") is axes
    low, high = axes.get_ylim()
    assert low == 120.0 and high == -10.0 and axes.get_xscale() == "log"
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert ticks == "0.25 0.5 1 2 4 6 8".split()
    first, second = axes.get_lines()
    assert tuple(first.get_ydata()) == right.levels and first.get_label() == "right"
    assert (first.get_color(), first.get_marker()) == ("tab:red", "o")
    assert second.get_marker() == "x"
    assert tuple(second.get_xdata()) == (500, 3000)
    assert [text.get_text() for text in axes.texts] == [*SEVERITIES]
    bounds = [sorted({patch.get_y(), patch.get_y() + patch.get_height()}) for patch in axes.patches]
    assert [pair[1] for pair in bounds] == [*SEVERITY_LIMITS, 120.0]


def test_the_right_ear_has_red_circles_and_the_left_ear_blue_crosses() -> None:
    pytest.importorskip("matplotlib")
    listener = Listener("N2", "N4")
    left, right = listener.plot().get_lines()
    assert (left.get_marker(), left.get_color()) == ("x", "tab:blue")
    assert (right.get_marker(), right.get_color()) == ("o", "tab:red")
    assert left.get_label() == "left, PTA 31 dB HL"
    assert right.get_label() == "right, PTA 62 dB HL"
    ear = Audiogram.standard("N4")
    (line,) = ear.plot(ear="right").get_lines()
    assert line.get_marker() == "o" and tuple(line.get_ydata()) == ear.levels


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(MissingExtraError, match=r"hlsim\[eval\]"):
        Audiogram.standard("N3").plot()
