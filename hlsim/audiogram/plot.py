"""Audiograms drawn as audiologists draw them: frequency to the right, hearing loss downwards."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

from hlsim.audiogram.scale import (
    HIGHEST_LEVEL,
    LOWEST_LEVEL,
    SEVERITIES,
    SEVERITY_LIMITS,
    EarName,
)
from hlsim.extras import MissingExtraError, require

_TICKS_HZ = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0, 8000.0)

_STYLES: dict[EarName | None, dict[str, Any]] = {
    None: {"marker": "o", "color": "black"},
    "left": {"marker": "x", "color": "tab:blue"},
    "right": {"marker": "o", "color": "tab:red", "fillstyle": "none"},
}
"""Matplotlib's properties of the line of an ear."""


def plot_thresholds(
    frequencies: Iterable[float],
    levels: Iterable[float],
    axes: Any = None,
    ear: EarName | None = None,
    **style: Any,
) -> Any:
    """Draw an audiogram as audiologists do, with bands for mild, moderate and severe losses.

    Args:
        frequencies: Frequencies in Hz.
        levels: Threshold at each frequency in dB HL.
        axes: Matplotlib axes to draw on, which may show other ears; by default new axes.
        ear: ``"left"`` draws blue crosses, ``"right"`` red circles, both with a legend.
        style: Matplotlib's properties of the line, such as ``color="tab:green"``.

    Returns:
        The axes.

    Raises:
        MissingExtraError: matplotlib is not installed.

    >>> axes = plot_thresholds([500, 1000], [20, 30], ear="left", label="left")
    >>> axes.get_xscale()
    'log'
    """
    if axes is None:
        _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
    if not axes.yaxis_inverted():  # axes on which no audiogram has been drawn
        _prepare(axes)
    axes.plot(frequencies, levels, **_STYLES[ear] | style)
    if ear is not None:
        axes.legend()
    return axes


def draw_png(plot: Callable[[Any], Any]) -> bytes | None:
    """Draw a picture, and return it as PNG; return ``None`` if matplotlib is not installed.

    Args:
        plot: Function that draws on matplotlib's axes.

    >>> draw_png(lambda axes: axes.plot([0, 1]))[1:4]
    b'PNG'
    """
    try:
        figure_module = require("matplotlib.figure", "eval")
    except MissingExtraError:
        return None
    figure = figure_module.Figure(figsize=(5.0, 3.5), layout="constrained")
    plot(figure.subplots())
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    return image.getvalue()


def frequency_axis(axes: Any, ticks: Iterable[float]) -> None:
    """Make the horizontal axis of a plot a logarithmic axis of frequencies, labelled in kHz.

    Args:
        axes: Matplotlib axes.
        ticks: Frequencies to label, in Hz.

    >>> from matplotlib.figure import Figure
    >>> frequency_axis(Figure().subplots(), [250, 1000, 4000])
    """
    hertz = list(ticks)
    axes.set(xscale="log", xlabel="frequency (kHz)")
    axes.set_xticks(hertz, [f"{tick / 1000:g}" for tick in hertz])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


def _prepare(axes: Any) -> None:
    """Draw the axes, and bands for the severities of loss."""
    bounds = pairwise((LOWEST_LEVEL, *SEVERITY_LIMITS, HIGHEST_LEVEL))
    label = {"transform": axes.get_yaxis_transform(), "ha": "left", "va": "center"}
    for index, (low, high) in enumerate(bounds):
        axes.axhspan(low, high, color="tab:blue", alpha=0.05 * index, linewidth=0)
        middle = (low + high) / 2
        axes.text(
            1.02, middle, SEVERITIES[index], fontsize="small", color="0.35", rotation=90, **label
        )
    frequency_axis(axes, _TICKS_HZ)
    axes.set(xlim=(180.0, 11000.0), ylim=(HIGHEST_LEVEL, LOWEST_LEVEL), ylabel="threshold (dB HL)")
    axes.set_yticks(range(0, 121, 20))
