"""An audiogram drawn as audiologists do: what ``Audiogram.plot`` calls."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from hlsim.extras import require

if TYPE_CHECKING:
    from hlsim.audiogram import Audiogram

_SHADES = (0.0, 0.05, 0.1, 0.16)  # of the degrees of loss


def plot_audiogram(ear: Audiogram, axes: Any = None, **style: Any) -> Any:
    """``Audiogram.plot``."""
    if axes is None:
        _, axes = require("matplotlib.pyplot", "eval").subplots(layout="constrained")
    if not axes.yaxis_inverted():  # nobody's yet
        _prepare(axes)
    axes.plot(ear.frequencies, ear.levels, **{"marker": "o", "color": "black"} | style)
    return axes


def _prepare(axes: Any) -> None:
    from hlsim.audiogram import FREQUENCIES, HIGHEST_LEVEL, LOWEST_LEVEL, SEVERITIES, SEVERITY_LIMITS

    limits = (LOWEST_LEVEL, *SEVERITY_LIMITS, HIGHEST_LEVEL)
    for name, (low, high), shade in zip(SEVERITIES, pairwise(limits), _SHADES, strict=True):
        axes.axhspan(low, high, color="tab:blue", alpha=shade, linewidth=0)
        at = {"transform": axes.get_yaxis_transform(), "rotation": 90, "ha": "left", "va": "center"}
        axes.text(1.02, (low + high) / 2, name, fontsize="small", color="0.35", **at)
    frequency_axis(axes, (*FREQUENCIES[:4], *FREQUENCIES[5:]))
    axes.set(xlim=(180.0, 11000.0), ylim=(HIGHEST_LEVEL, LOWEST_LEVEL), ylabel="threshold (dB HL)")
    axes.set_yticks(range(0, 121, 20))


def frequency_axis(axes: Any, hertz: Iterable[float]) -> None:
    """A logarithmic axis in kHz with these ticks."""
    ticks = [*hertz]
    axes.set(xscale="log", xlabel="frequency (kHz)")
    axes.set_xticks(ticks, [f"{hz / 1000:g}" for hz in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
