"""The pictures of a report's page, as SVG narrow enough to be read on a phone."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.statistics import FEWEST, bootstrap_interval
from hlsim.extras import require
from hlsim.metrics.registry import MEASURES
from hlsim.report.page import Picture
from hlsim.report.pictures import plain, score_range

if TYPE_CHECKING:
    from hlsim.evaluation.scores import HaspiReport, ItemScore

_INCHES = (4.2, 3.5)
_MANY = 2000  # points beyond which they are drawn as pixels: the page stays small
_TICKS = (250, 500, 1000, 2000, 4000, 8000)


def report_pictures(report: HaspiReport) -> list[Picture]:
    """Before against after, change of level, distributions, by severity, by SNR (where there are any), the audiograms.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    headline = report.headline
    pictures = [_scatter(report, headline), _levels(report, headline), _distributions(report)]
    pictures.append(_by_severity(report))
    if sum(item.snr is not None for item in report.items):
        pictures.append(_by_snr(report))
    pictures.append(_audiograms(report))
    return pictures


def draw_svg(draw: Callable[[Any], None], inches: tuple[float, float] = _INCHES) -> bytes:
    """The SVG of what ``draw`` puts on a matplotlib axes.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    matplotlib = require("matplotlib", "eval")
    figure = require("matplotlib.figure", "eval").Figure(figsize=inches, layout="constrained")
    axes = figure.subplots()
    draw(axes)
    data = io.BytesIO()
    # the same figures give the same bytes
    with matplotlib.rc_context({"svg.hashsalt": "hlsim"}):
        figure.savefig(data, format="svg", dpi=150, metadata={"Date": None})
    return data.getvalue()


def _scatter(report: HaspiReport, c: Comparison) -> Picture:
    low, high = score_range(c.measure)
    title = c.title

    def draw(axes: Any) -> None:
        axes.plot((low, high), (low, high), color="0.5", linewidth=1.0, linestyle="--")
        for number, severity in enumerate(SEVERITIES):
            points = [
                (scores[c.before], scores[c.after])
                for item in report.items
                if item.audiogram.severity == severity
                and {c.before, c.after} <= (scores := item.scores.get(c.measure, {})).keys()
            ]
            if points:
                x, y = zip(*points, strict=True)
                axes.scatter(
                    x,
                    y,
                    s=14,
                    alpha=0.7,
                    color=f"C{number}",
                    label=_loss(severity),
                    rasterized=len(x) > _MANY,
                )
        axes.set(xlim=(low, high), ylim=(low, high), aspect="equal")
        axes.set(xlabel=plain(f"{title}, {c.before}"), ylabel=plain(f"{title}, {c.after}"))
        axes.legend(fontsize="small")

    caption = "Each point is an item; above the dashed line the score rose."
    alt = (
        f"{title} {c.after} over {title} {c.before}, {c.overall.n} items: mean {c.overall.before_mean:.3f} to "
        f"{c.overall.after_mean:.3f}."
    )
    return Picture(draw_svg(draw), alt, caption)


def _levels(report: HaspiReport, c: Comparison) -> Picture:
    title = c.title
    points = []
    for item in report.items:
        scores, first, second = item.scores.get(c.measure, {}), item.levels[c.before], item.levels[c.after]
        if c.before in scores and c.after in scores and first is not None and second is not None:
            points.append((second - first, scores[c.after] - scores[c.before]))
    x, y = np.array(points).T

    def draw(axes: Any) -> None:
        axes.axhline(0.0, color="0.5", linewidth=1.0, linestyle="--")
        axes.scatter(x, y, s=14, alpha=0.7, rasterized=len(points) > _MANY)
        axes.set_xlim(min(x.min(), 0.0) - 1.0, max(x.max(), 0.0) + 1.0)
        axes.set(xlabel="change of level (dB)", ylabel=f"change of {title}")

    alt = f"Change of {title} over the change of level; the level changed by {x.min():+.1f} to {x.max():+.1f} dB."
    return Picture(
        draw_svg(draw), alt, "What gain may explain: the change of the score over that of the level."
    )


def _distributions(report: HaspiReport) -> Picture:
    measure = report.measures[0]
    title = MEASURES[measure].title
    values = [_scores(report.items, measure, condition) for condition in report.conditions]

    def draw(axes: Any) -> None:
        generator = np.random.default_rng(0)
        places = range(1, len(values) + 1)
        axes.boxplot(values, positions=places, widths=0.5, showfliers=False, medianprops={"color": "black"})
        for place, own in zip(places, values, strict=True):
            shift = generator.uniform(-0.18, 0.18, len(own))
            axes.scatter(place + shift, own, s=7, alpha=0.4, linewidths=0, rasterized=len(own) > _MANY)
        axes.set_xticks(list(places), _labels(report.conditions))
        axes.set(ylim=score_range(measure), ylabel=title)

    medians = ", ".join(
        f"{name} {np.median(own):.3f}"
        for name, own in zip(report.conditions, values, strict=True)
        if len(own)
    )
    return Picture(
        draw_svg(draw), f"{title} by condition; medians: {medians}.", "Quartiles, median and every item."
    )


def _by_severity(report: HaspiReport) -> Picture:
    measure = report.measures[0]
    severities = [s for s in SEVERITIES if any(item.audiogram.severity == s for item in report.items)]
    groups = [[item for item in report.items if item.audiogram.severity == s] for s in severities]

    def draw(axes: Any) -> None:
        width = 0.8 / len(report.conditions)
        for k, condition in enumerate(report.conditions):
            at = np.arange(len(groups)) + (k - (len(report.conditions) - 1) / 2) * width
            scores = [_scores(group, measure, condition) for group in groups]
            axes.bar(at, [_mean(own) for own in scores], width * 0.9, label=plain(condition))
            for place, own in zip(at, scores, strict=True):
                if len(own) >= FEWEST:
                    axes.plot((place, place), bootstrap_interval(own), color="black", linewidth=1.0)
        axes.set_xticks(
            range(len(groups)), [f"{s} ({len(g)})" for s, g in zip(severities, groups, strict=True)]
        )
        axes.set(
            ylim=(0.0, score_range(measure)[1]),
            ylabel=f"mean {MEASURES[measure].title}",
            xlabel="loss (items)",
        )
        axes.legend(fontsize="small")

    what = "; ".join(
        f"{severity}: " + _means(report, group) for severity, group in zip(severities, groups, strict=True)
    )
    caption = (
        "By degree of loss, of the items that have each score, with 95 % bootstrap intervals of the means from "
        f"{FEWEST} items on."
    )
    return Picture(draw_svg(draw), f"Mean {MEASURES[measure].title} by degree of loss: {what}.", caption)


def _by_snr(report: HaspiReport) -> Picture:
    measure = report.measures[0]
    snrs = sorted({item.snr for item in report.items if item.snr is not None})
    groups = [[item for item in report.items if item.snr == snr] for snr in snrs]

    def draw(axes: Any) -> None:
        for condition in report.conditions:
            means = [_mean(_scores(group, measure, condition)) for group in groups]
            axes.plot(snrs, means, marker="o", label=plain(condition))
        axes.set(xlabel="SNR (dB)", ylabel=f"mean {MEASURES[measure].title}", ylim=score_range(measure))
        axes.legend(fontsize="small")

    what = "; ".join(f"{snr:g} dB: " + _means(report, group) for snr, group in zip(snrs, groups, strict=True))
    caption = "By SNR, of the items that have each score."
    return Picture(draw_svg(draw), f"Mean {MEASURES[measure].title} by SNR: {what}.", caption)


def _means(report: HaspiReport, items: Sequence[ItemScore]) -> str:
    """Each condition's mean in words."""
    told = []
    for name in report.conditions:
        scores = _scores(items, report.measures[0], name)
        told.append(f"{name} " + (f"{_mean(scores):.3f}" if len(scores) else "n/a"))
    return ", ".join(told)


def _audiograms(report: HaspiReport) -> Picture:
    ears = list(dict.fromkeys(item.audiogram for item in report.items))

    def draw(axes: Any) -> None:
        for ear in ears:
            axes.plot(ear.frequencies, ear.levels, color="C0", alpha=max(0.15, 1.0 / len(ears)), marker=".")
        if len(ears) > 1:
            mean = np.mean([ear.thresholds for ear in ears], axis=0)
            axes.plot((250, 500, 1000, 2000, 3000, 4000, 6000, 8000), mean, color="black", label="mean")
            axes.legend(fontsize="small")
        axes.set(xscale="log", ylim=(125.0, -15.0), xlabel="frequency (kHz)", ylabel="threshold (dB HL)")
        axes.set_xticks(_TICKS, [f"{hz / 1000:g}" for hz in _TICKS])
        axes.minorticks_off()
        axes.grid(alpha=0.3)

    return Picture(
        draw_svg(draw), f"Audiograms of {len(ears)} ears.", f"Audiograms: {len(ears)} different ears."
    )


def _scores(items: Sequence[ItemScore], measure: str, condition: str) -> np.ndarray:
    return np.array([own[condition] for item in items if condition in (own := item.scores.get(measure, {}))])


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _loss(severity: str) -> str:
    return "no loss" if severity == "none" else f"{severity} loss"


def _labels(names: Sequence[str]) -> list[str]:
    return [plain(name if len(name) < 13 else name[:11] + "…") for name in names]
