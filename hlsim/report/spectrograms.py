"""Spectrograms of signals and of their differences, on one scale of dB SPL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.report.page import Picture
from hlsim.report.plots import new_figure, plain, svg

RANGE_DB = 75.0
"""Range of levels that is drawn, from the loudest bin down: speech and the noise in its pauses."""

PANEL_INCHES = (4.6, 2.1)

_LARGEST_DIFFERENCE_DB = 15.0
_HIGHEST_KHZ = 10.0  # MSBG and HASPI end at 8

Panels = Mapping[str, Callable[[Any, Any], None]]
"""Functions that draw on a matplotlib figure and axes, by title."""


def panels(
    signals: Mapping[str, Tensor],
    sample_rate: int,
    differences: Mapping[str, tuple[str, str]] | None = None,
) -> Panels:
    """Return functions that draw each signal and then each difference of two of them in dB.

    A difference, by its title, is that of the first name minus the second, where either is within the range.

    Shape: (time,) each, in pascals.
    """
    levels = {name: _levels(signal, sample_rate) for name, signal in signals.items()}
    top = 5.0 * round(max(float(level.quantile(0.999)) for level in levels.values()) / 5.0 + 0.5)
    seconds = max(len(signal) for signal in signals.values()) / sample_rate
    extent = (0.0, seconds, 0.0, sample_rate / 2.0e3)
    scale = {"vmin": top - RANGE_DB, "vmax": top, "cmap": "gist_heat_r", "extent": extent}
    drawn: dict[str, Callable[[Any, Any], None]] = {
        name: partial(_draw, image=level, title=name, unit="dB SPL in a bin", scale=scale)
        for name, level in levels.items()
    }
    most = _LARGEST_DIFFERENCE_DB
    scale = {"vmin": -most, "vmax": most, "cmap": "RdBu_r", "extent": extent}
    for title, (first, second) in (differences or {}).items():
        image = levels[first] - levels[second]
        image[torch.maximum(levels[first], levels[second]) < top - RANGE_DB] = torch.nan
        drawn[title] = partial(_draw, image=image, title=title, unit="dB", scale=scale)
    return drawn


def pictures(panels: Panels) -> list[Picture]:
    """Return one picture per panel, for a page that lays them out by its width."""
    drawn = []
    for title, draw in panels.items():
        figure = new_figure(PANEL_INCHES)
        draw(figure, figure.subplots())
        drawn.append(Picture(svg(figure), f"Spectrogram: {title}"))
    return drawn


def _levels(signal: Tensor, sample_rate: int) -> Tensor:
    """Return levels in windows of 20 ms, every 10 ms; silence has -46 dB SPL.

    Shape: (time,) -> (bins, frames) in dB SPL.
    """
    points = 2 * (sample_rate // 100)
    window = torch.hann_window(points)
    spectrum = torch.stft(
        signal.float().cpu(), points, points // 2, window=window, return_complex=True
    )
    return 20.0 * torch.log10(spectrum.abs() * 2.0**0.5 / window.sum() + 1e-7) + PASCAL_SPL


def _draw(
    figure: Any, axes: Any, image: Tensor, title: str, unit: str, scale: Mapping[str, Any]
) -> None:
    # without interpolation a page's picture holds the bins themselves, sharp at any size
    drawn = axes.imshow(image.numpy(), origin="lower", aspect="auto", interpolation="none", **scale)
    axes.set(xlabel="s", ylabel="kHz", ylim=(0.0, min(_HIGHEST_KHZ, scale["extent"][3])))
    axes.set_title(plain(title), fontsize="medium")
    figure.colorbar(drawn, ax=axes, label=unit, aspect=15, pad=0.02)
