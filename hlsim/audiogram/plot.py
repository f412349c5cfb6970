"""An audiogram drawn as audiologists do: what ``Audiogram.plot`` calls."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from hlsim.extras import MissingExtraError, require

_SHADES = (0.0, 0.05, 0.1, 0.16)  # of the degrees of loss
_TICKS = (250.0, 500.0, 1000.0, 2000.0, 4000.0, 6000.0, 8000.0)


def plot_audiogram(
    frequencies: Sequence[float],
    levels: Sequence[float],
    degrees: Mapping[str, tuple[float, float]],
    axes: Any = None,
    **style: Any,
) -> Any:
    """``Audiogram.plot``.

    Args:
        degrees: of loss by name, from which to which level in dB HL, the least first.
    """
    if axes is None:
        _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
    if not axes.yaxis_inverted():  # nobody's yet
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


def _prepare(axes: Any, degrees: Mapping[str, tuple[float, float]]) -> None:
    for (name, (low, high)), shade in zip(degrees.items(), _SHADES, strict=True):
        axes.axhspan(low, high, color="tab:blue", alpha=shade, linewidth=0)
        at = {"transform": axes.get_yaxis_transform(), "rotation": 90, "ha": "left", "va": "center"}
        axes.text(1.02, (low + high) / 2, name, fontsize="small", color="0.35", **at)
    frequency_axis(axes, _TICKS)
    ends = [level for limits in degrees.values() for level in limits]
    axes.set(xlim=(180.0, 11000.0), ylim=(max(ends), min(ends)), ylabel="threshold (dB HL)")
    axes.set_yticks(range(0, 121, 20))


def frequency_axis(axes: Any, hertz: Iterable[float]) -> None:
    """A logarithmic axis in kHz with these ticks."""
    ticks = [*hertz]
    axes.set(xscale="log", xlabel="frequency (kHz)")
    axes.set_xticks(ticks, [f"{hz / 1000:g}" for hz in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
