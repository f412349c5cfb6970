"""Drawn audiograms: axes and symbols of audiology."""

import sys

import pytest

from hlsim import Audiogram, Listener
from hlsim.extras import MissingExtraError


def test_axes_and_symbols_are_those_of_audiology() -> None:
    pytest.importorskip("matplotlib")
    axes = Listener("N2", "N4").plot()
    assert Audiogram((10, 40), (500, 3000)).plot(axes) is axes
    assert axes.get_ylim() == (120.0, -10.0) and axes.get_xscale() == "log"
    ticks = [label.get_text() for label in axes.get_xticklabels()]
    assert ticks == "0.25 0.5 1 2 3 4 6 8".split()
    left, right, single = axes.get_lines()
    assert (left.get_marker(), left.get_color()) == ("x", "tab:blue")
    assert (right.get_marker(), right.get_color()) == ("o", "tab:red")
    assert left.get_label() == "left, PTA 31 dB HL"
    assert right.get_label() == "right, PTA 62 dB HL"
    assert tuple(right.get_ydata()) == Audiogram.standard("N4").levels
    assert tuple(single.get_xdata()) == (500, 3000)
    with pytest.raises(ValueError, match="expected ear to be left, right or None, got 'L'"):
        Audiogram.standard("N3").plot(ear="L")  # type: ignore[arg-type]


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(MissingExtraError, match=r"hlsim\[eval\]"):
        Audiogram.standard("N3").plot()
