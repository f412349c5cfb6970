"""Axes and symbols of drawn audiograms."""

from collections.abc import Sequence
from typing import Any

from hlsim.audiogram.scale import EarName

EAR_STYLES: dict[EarName | None, dict[str, Any]] = {
    None: {"marker": "o", "color": "black"},
    "left": {"marker": "x", "color": "tab:blue"},
    "right": {"marker": "o", "color": "tab:red", "fillstyle": "none"},
}
"""Matplotlib properties of the line for each ear, as audiologists draw it."""


def frequency_axis(axes: Any, ticks: Sequence[float]) -> None:
    """Make the horizontal axis of a plot a logarithmic axis of frequencies, labelled in kHz.

    Args:
        axes: Matplotlib axes.
        ticks: Frequencies to label, in Hz.

    >>> from matplotlib.figure import Figure
    >>> frequency_axis(Figure().subplots(), [250, 1000, 4000])
    """
    axes.set(xscale="log", xlabel="frequency (kHz)")
    axes.set_xticks(ticks, [f"{tick / 1000:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
