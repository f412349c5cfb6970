"""Pictures: a HASPI report, and spectrograms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import torch
from torch import Tensor

from hlsim.audiogram import SEVERITIES
from hlsim.calibration import PASCAL_SPL
from hlsim.extras import require

if TYPE_CHECKING:
    from hlsim.evaluation.scores import HaspiReport


def draw_report(report: HaspiReport, path: str | Path) -> None:
    """Write a PNG of score and level of the headline, after over before: a dashed line of no change, a colour a severity.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    # the figure by itself, drawn by Agg: without pyplot there is no window and no global state
    figure = require("matplotlib.figure", "eval").Figure(figsize=(9.0, 4.8), layout="constrained")
    require("matplotlib.backends.backend_agg", "eval").FigureCanvasAgg(figure)
    first, last = report.headline.before, report.headline.after
    items = [
        item for item in report.items if {first, last} <= item.scores.get(report.headline.measure, {}).keys()
    ]
    name = report.headline.title
    scores = [tuple(item.scores[report.headline.measure][end] for end in (first, last)) for item in items]
    levels = [tuple(float(item.levels[end] or 0.0) for end in (first, last)) for item in items]
    lowest, highest = min(map(min, levels)) - 3.0, max(map(max, levels)) + 3.0
    c = report.comparison
    panels = (
        (
            scores,
            score_range(report.headline.measure),
            name,
            f"mean {c.before_mean:.3f} to {c.after_mean:.3f}",
        ),
        (
            levels,
            (lowest, highest),
            "Level (dB SPL)",
            f"mean {report.before_level_mean:.1f} to {report.after_level_mean:.1f} dB SPL",
        ),
    )
    severities = [item.audiogram.severity for item in items]
    for axes, (points, limits, what, title) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.plot(limits, limits, color="0.5", linewidth=1.0, linestyle="--", label="no change")
        for number, severity in enumerate(SEVERITIES):
            chosen = [point for point, own in zip(points, severities, strict=True) if own == severity]
            if chosen:
                before, after = zip(*chosen, strict=True)
                label = "no loss" if severity == "none" else f"{severity} loss"
                axes.scatter(before, after, s=18, alpha=0.7, color=f"C{number}", label=label)
        axes.set(xlim=limits, ylim=limits, aspect="equal", title=title)
        axes.set(xlabel=plain(f"{what}, {first}"), ylabel=plain(f"{what}, {last}"))
        axes.legend(fontsize="small")
    figure.suptitle(plain(f"{c.n} items, {first} and {last}"))
    figure.savefig(path, dpi=150, format="png")


def plain(text: str) -> str:
    """Text as it is, for labels: matplotlib reads ``$`` as mathematics and hides from a legend what begins with _."""
    text = text.replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def score_range(measure: str) -> tuple[float, float]:
    """The axis of a measure."""
    return (0.9, 4.7) if measure == "pesq" else (-0.03, 1.03)


def draw_spectrograms(
    signals: Mapping[str, Tensor], sample_rate: int, path: str | Path | BinaryIO, *, width: float = 9.0
) -> None:
    """Write a PNG of log-magnitude spectrograms, one a signal, on one scale of dB SPL.

    Args:
        path: or an open binary file.
        width: inches.

    Shape: (time,) each, in pascals.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = require("matplotlib.figure", "eval").Figure(
        figsize=(width, 2.2 * len(signals)), layout="constrained"
    )
    require("matplotlib.backends.backend_agg", "eval").FigureCanvasAgg(figure)
    points = 2 * (sample_rate // 100)  # 20 ms
    window = torch.hann_window(points)
    panels = figure.subplots(len(signals), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, (name, signal) in zip(panels, signals.items(), strict=True):
        spectrum = torch.stft(signal.float().cpu(), points, points // 4, window=window, return_complex=True)
        level = 20.0 * torch.log10(spectrum.abs() * 2.0**0.5 / window.sum() + 1e-7) + PASCAL_SPL
        image = axes.imshow(
            level.numpy(),
            origin="lower",
            aspect="auto",
            vmin=-20.0,
            vmax=70.0,
            extent=(0.0, len(signal) / sample_rate, 0.0, sample_rate / 2000.0),
        )
        # MSBG and HASPI end at 8 kHz
        axes.set(title=plain(name), ylabel="kHz", ylim=(0.0, min(10.0, sample_rate / 2000.0)))
    panels[-1].set(xlabel="s")
    figure.colorbar(image, ax=list(panels), label="dB SPL in a bin", aspect=40)
    figure.savefig(path, dpi=110, format="png")
