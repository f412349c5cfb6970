"""Drawing an audiogram as audiologists do, and the frequency axis that other plots share."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from hlsim.extras import MissingExtraError, require

DEGREE_SHADES = (0.0, 0.05, 0.1, 0.16)
"""Opacity of the bands of the degrees of loss, the mildest first."""

FREQUENCY_TICKS = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0, 8000.0)


def plot_audiogram(
    frequencies: Sequence[float],
    levels: Sequence[float],
    degrees: Mapping[str, tuple[float, float]],
    axes: Any = None,
    **style: Any,
) -> Any:
    """Draw thresholds over frequency, as ``Audiogram.plot``, which calls this, describes it.

    Args:
        frequencies: frequencies in Hz.
        levels: thresholds in dB HL.
        degrees: lowest and highest level in dB HL of each degree of loss by name, the mildest first.
        axes: matplotlib axes; by default those of a new figure.
        style: properties of the line.

    Returns: the axes.
    """
    if axes is None:
        _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
    if not axes.yaxis_inverted():  # no audiogram was drawn there before
        _prepare(axes, degrees)
    axes.plot(frequencies, levels, **{"marker": "o", "color": "black"} | style)
    return axes


def draw_png(plot: Callable[[Any], Any]) -> bytes | None:
    """Return a PNG of what a function draws on axes, or ``None`` if matplotlib is not installed."""
    try:
        figure_module = require("matplotlib.figure", "eval")
    except MissingExtraError:
        return None
    figure = figure_module.Figure(figsize=(5.0, 3.5), layout="constrained")
    plot(figure.subplots())
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    return image.getvalue()


def frequency_axis(axes: Any, frequencies: Iterable[float]) -> None:
    """Make the horizontal axis logarithmic in kHz, with ticks at frequencies in Hz."""
    ticks = list(frequencies)
    axes.set(xscale="log", xlabel="frequency (kHz)")
    axes.set_xticks(ticks, [f"{frequency / 1000:g}" for frequency in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)


def _prepare(axes: Any, degrees: Mapping[str, tuple[float, float]]) -> None:
    """Draw the degrees of loss and both axes."""
    text = {"rotation": 90, "ha": "left", "va": "center", "fontsize": "small", "color": "0.35"}
    for (name, (lowest, highest)), shade in zip(degrees.items(), DEGREE_SHADES, strict=True):
        axes.axhspan(lowest, highest, color="tab:blue", alpha=shade, linewidth=0)
        middle = (lowest + highest) / 2
        axes.text(1.02, middle, name, transform=axes.get_yaxis_transform(), **text)
    frequency_axis(axes, FREQUENCY_TICKS)
    limits = [level for degree in degrees.values() for level in degree]
    axes.set(xlim=(180.0, 11000.0), ylim=(max(limits), min(limits)), ylabel="threshold (dB HL)")
    axes.set_yticks(range(0, 121, 20))
