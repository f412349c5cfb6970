"""Pictures of a HASPI report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.audiogram import SEVERITIES
from hlsim.extras import require

if TYPE_CHECKING:
    from hlsim.evaluation.report import HaspiReport


def draw_report(report: HaspiReport, path: str | Path) -> None:
    """Write a PNG of HASPI and of the level, after over before, with the diagonal of no change and a colour a severity.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    # the figure by itself, drawn by Agg: without pyplot there is no window and no global state
    figure = require("matplotlib.figure", "eval").Figure(figsize=(9.0, 4.8), layout="constrained")
    require("matplotlib.backends.backend_agg", "eval").FigureCanvasAgg(figure)
    scores = [(item.before, item.after) for item in report.items]
    levels = [(item.before_level, item.after_level) for item in report.items]
    lowest, highest = min(map(min, levels)) - 3.0, max(map(max, levels)) + 3.0
    c = report.comparison
    panels = (
        (scores, (-0.03, 1.03), "HASPI", f"mean {c.before_mean:.3f} to {c.after_mean:.3f}"),
        (
            levels,
            (lowest, highest),
            "Level (dB SPL)",
            f"mean {report.before_level_mean:.1f} to {report.after_level_mean:.1f} dB SPL",
        ),
    )
    severities = [item.audiogram.severity for item in report.items]
    for axes, (points, limits, what, title) in zip(figure.subplots(1, 2), panels, strict=True):
        axes.plot(limits, limits, color="0.5", linewidth=1.0, linestyle="--", label="no change")
        for number, severity in enumerate(SEVERITIES):
            chosen = [point for point, own in zip(points, severities, strict=True) if own == severity]
            if chosen:
                before, after = zip(*chosen, strict=True)
                label = "no loss" if severity == "none" else f"{severity} loss"
                axes.scatter(before, after, s=18, alpha=0.7, color=f"C{number}", label=label)
        axes.set(xlim=limits, ylim=limits, aspect="equal", title=title)
        axes.set(xlabel=f"{what}, before", ylabel=f"{what}, after")
        axes.legend(fontsize="small")
    figure.suptitle(f"{c.n} items before and after")
    figure.savefig(path, dpi=150, format="png")
