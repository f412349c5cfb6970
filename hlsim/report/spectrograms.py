"""Spectrograms of signals and of their differences, on one scale of dB SPL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.calibration import PASCAL_SPL
from hlsim.report.page import Picture
from hlsim.report.plots import new_figure, plain, png, svg

RANGE_DB = 75.0
"""What is drawn of levels, from the loudest bin down: speech and the noise in its pauses."""

_APART_DB = 15.0  # a difference beyond is drawn as this one
_HIGHEST = 10000.0  # Hz: MSBG and HASPI end at 8000

_PANEL = (4.6, 2.1)  # inches

Panels = Mapping[str, Callable[[Any, Any], None]]


def panels(
    signals: Mapping[str, Tensor],
    sample_rate: int,
    differences: Mapping[str, tuple[str, str]] | None = None,
) -> Panels:
    """What draws each signal, and after it, where it is one's, a difference: of one name less another, in dB.

    Differences are where either is within the range that is drawn. Shape: (time,) each, in pascals.
    """
    levels = {name: _levels(signal, sample_rate) for name, signal in signals.items()}
    top = 5.0 * round(max(float(level.quantile(0.999)) for level in levels.values()) / 5.0 + 0.5)
    seconds = max(len(signal) for signal in signals.values()) / sample_rate
    extent = (0.0, seconds, 0.0, sample_rate / 2.0e3)
    found: dict[str, Callable[[Any, Any], None]] = {}
    for name, level in levels.items():
        scale = {"vmin": top - RANGE_DB, "vmax": top, "cmap": "gist_heat_r", "extent": extent}
        found[name] = partial(_draw, image=level, title=name, unit="dB SPL in a bin", scale=scale)
        for title, (one, other) in (differences or {}).items():
            if one == name:
                apart = levels[one] - levels[other]
                apart[torch.maximum(levels[one], levels[other]) < top - RANGE_DB] = torch.nan
                scale = {"vmin": -_APART_DB, "vmax": _APART_DB, "cmap": "RdBu_r", "extent": extent}
                found[title] = partial(_draw, image=apart, title=title, unit="dB", scale=scale)
    return found


def pictures(panels: Panels) -> list[Picture]:
    """One a panel, for a page that lays them out by its width."""
    found = []
    for title, draw in panels.items():
        figure = new_figure(_PANEL)
        draw(figure, figure.subplots())
        found.append(Picture(svg(figure), f"Spectrogram: {title}"))
    return found


def composite(panels: Panels) -> bytes:
    """The PNG of all, in two columns."""
    rows = -(-len(panels) // 2)
    figure = new_figure((2.0 * _PANEL[0], rows * _PANEL[1]))
    places = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, draw in zip(places, panels.values(), strict=False):
        draw(figure, axes)
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    return png(figure, 160)


def _levels(signal: Tensor, sample_rate: int) -> Tensor:
    """Windows of 20 ms, every 10 ms; silence is at -46 dB SPL. Shape: (time,) -> (bins, frames) in dB SPL."""
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
    axes.set(xlabel="s", ylabel="kHz", ylim=(0.0, min(_HIGHEST / 1e3, scale["extent"][3])))
    axes.set_title(plain(title), fontsize="medium")
    figure.colorbar(drawn, ax=axes, label=unit, aspect=15, pad=0.02)
