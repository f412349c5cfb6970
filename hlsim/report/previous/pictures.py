"""Pictures of a HASPI report, narrow enough to be read on a phone.

All raise MissingExtraError where matplotlib is not installed.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from hlsim.audiogram import FREQUENCIES, SEVERITIES
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.statistics import FEWEST, bootstrap_interval
from hlsim.extras import require
from hlsim.report.page import Picture
from hlsim.report.previous.tables import loss_name

_MANY = 2000  # points beyond which they are drawn as pixels: the page stays small
_LABELLED = 40  # listeners up to which each is named


def draw_svg(draw: Callable[[Any], None]) -> bytes:
    """The SVG of what ``draw`` puts on a matplotlib axes."""
    figure = new_figure((4.2, 3.5))
    draw(figure.subplots())
    return svg(figure)


def svg(figure: Any) -> bytes:
    """A figure's SVG."""
    data = io.BytesIO()
    # the same figures give the same bytes
    with require("matplotlib", "eval").rc_context({"svg.hashsalt": "hlsim"}):
        figure.savefig(data, format="svg", dpi=150, metadata={"Date": None})
    return data.getvalue()


def png(figure: Any, dpi: int) -> bytes:
    """A figure's PNG."""
    data = io.BytesIO()
    figure.savefig(data, dpi=dpi, format="png")
    return data.getvalue()


def new_figure(inches: tuple[float, float]) -> Any:
    """A matplotlib figure by itself, drawn by Agg: without pyplot there is no window and no global state."""
    figure = require("matplotlib.figure", "eval").Figure(figsize=inches, layout="constrained")
    require("matplotlib.backends.backend_agg", "eval").FigureCanvasAgg(figure)
    return figure


def plain(text: str) -> str:
    """Text as it is, for labels: matplotlib reads ``$`` as mathematics and hides from a legend what begins with _."""
    text = text.replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def condition_colours(conditions: Sequence[str]) -> dict[str, Any]:
    """A colour a condition, for all pictures of a page; what is "at X's level" has X's, paler."""
    of = {name: [c for c in conditions if name.endswith(f" at {c}'s level")] for name in conditions}
    own = [name for name in conditions if not of[name]]
    colours: dict[str, Any] = {name: f"C{k}" for k, name in enumerate(own)}
    for name in own:
        beside = [other for other in conditions if name in of[other]]
        colours |= {other: (colours[name], 0.6 / (k + 1)) for k, other in enumerate(beside)}
    return {name: colours[name] for name in conditions}


def legend(axes: Any) -> None:
    """Under the axes, where it covers nothing; the figure grows by it."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if max(map(len, labels)) < 24 else 1
    axes.figure.set_figheight(axes.figure.get_figheight() + 0.21 * -(-len(labels) // columns))
    about = {"ncols": columns, "fontsize": "small", "frameon": False}
    axes.figure.legend(handles, labels, loc="outside lower left", **about)


def scatter(
    axes: Any, x: np.ndarray, y: np.ndarray, severities: Sequence[str], same: str = "no change"
) -> None:
    """Points, a colour a degree of loss, and a dashed line where both are the same; NaN is not drawn."""
    axes.axline((1.0, 1.0), slope=1.0, color="0.5", linewidth=1.0, linestyle="--", label=same)
    there, degrees = np.isfinite(x + y), np.array(severities)
    for number, severity in enumerate(SEVERITIES):
        chosen = there & (degrees == severity)
        if chosen.any():
            style = {
                "color": f"C{number}",
                "label": loss_name(severity),
                "rasterized": chosen.sum() > _MANY,
            }
            axes.scatter(x[chosen], y[chosen], s=14, alpha=0.7, **style)


def draw_report(report: HaspiReport) -> bytes:
    """The PNG of score and level of the headline, after over before."""
    figure, c = new_figure((9.0, 4.8)), report.headline
    scores, levels = (
        report.scores(c.measure, (c.before, c.after)),
        report.levels((c.before, c.after)),
    )
    levels[np.isnan(scores).any(1)] = np.nan
    ends = (float(np.nanmin(levels)) - 3.0, float(np.nanmax(levels)) + 3.0)
    left, right = figure.subplots(1, 2)
    _draw_ends(left, report, scores, score_range(c.measure), c.title)
    left.set(title=f"mean {c.overall.before_mean:.3f} to {c.overall.after_mean:.3f}")
    _draw_ends(right, report, levels, ends, "Level (dB SPL)")
    right.set(title=f"mean {report.before_level_mean:.1f} to {report.after_level_mean:.1f} dB SPL")
    figure.suptitle(plain(f"{c.overall.n} items, {c.before} and {c.after}"))
    legend(left)
    return png(figure, 150)


def score_range(measure: str) -> tuple[float, float]:
    """The axis of a measure."""
    return (0.9, 4.7) if measure == "pesq" else (-0.03, 1.03)


def report_pictures(report: HaspiReport) -> list[Picture]:
    """Before against after, change of level, distributions, by severity, by SNR and by listener (where there are any),
    the audiograms."""
    kinds = [
        _before_after,
        _levels,
        _distributions,
        _by_severity,
        _by_snr,
        _by_listener,
        _audiograms,
    ]
    if all(item.snr is None for item in report.items):
        kinds.remove(_by_snr)
    if report.headline.listeners is None:
        kinds.remove(_by_listener)
    return [
        Picture(draw_svg(draw), alt, caption)
        for draw, alt, caption in (kind(report) for kind in kinds)
    ]


# what each draws on its axes, its words where it is not seen, and its caption
_Drawn = tuple[Callable[[Any], None], str, str]


def _before_after(report: HaspiReport) -> _Drawn:
    c = report.headline
    scores = report.scores(c.measure, (c.before, c.after))
    means = f"mean {c.overall.before_mean:.3f} to {c.overall.after_mean:.3f}"
    alt = f"{c.title} {c.after} over {c.title} {c.before}, {c.overall.n} items: {means}."

    def draw(axes: Any) -> None:
        _draw_ends(axes, report, scores, score_range(c.measure), c.title)
        legend(axes)

    return draw, alt, "Each point is an item; above the dashed line the score rose."


def _draw_ends(
    axes: Any, report: HaspiReport, values: np.ndarray, limits: tuple[float, float], what: str
) -> None:
    """The headline's conditions, after over before. Shape: (items, 2)."""
    scatter(axes, values[:, 0], values[:, 1], report.severities)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    before, after = (
        plain(f"{what}, {name}") for name in (report.headline.before, report.headline.after)
    )
    axes.set(xlabel=before, ylabel=after)


def _levels(report: HaspiReport) -> _Drawn:
    c, ends = report.headline, (report.headline.before, report.headline.after)
    x, y = (
        np.diff(values)[:, 0] for values in (report.levels(ends), report.scores(c.measure, ends))
    )
    there = np.isfinite(x + y)
    x, y = x[there], y[there]

    def draw(axes: Any) -> None:
        axes.axhline(0.0, color="0.5", linewidth=1.0, linestyle="--")
        axes.scatter(x, y, s=14, alpha=0.7, rasterized=len(x) > _MANY)
        axes.set_xlim(min(x.min(), 0.0) - 1.0, max(x.max(), 0.0) + 1.0)
        axes.set(xlabel="change of level (dB)", ylabel=f"change of {c.title}")

    alt = f"Change of {c.title} over the change of level; the level changed by {x.min():+.1f} to {x.max():+.1f} dB."
    return draw, alt, "What gain may explain: the change of the score over that of the level."


def _distributions(report: HaspiReport) -> _Drawn:
    measure, title = report.measures[0], report.headline.title
    values = [_known(column) for column in report.scores(measure).T]
    labels = [plain(fill(name, 18)) for name in report.conditions]

    def draw(axes: Any) -> None:
        generator = np.random.default_rng(0)
        axes.figure.set_figheight(1.0 + 0.45 * len(values))
        for place, group in enumerate(values):
            if len(group):
                low, middle, high = np.percentile(group, (25, 50, 75))
                axes.barh(place, high - low, 0.56, low, color="0.85")
                axes.plot((middle, middle), (place - 0.28, place + 0.28), color="black")
            shift = generator.uniform(-0.18, 0.18, len(group))
            axes.scatter(
                group,
                place + shift,
                s=7,
                alpha=0.4,
                linewidths=0,
                rasterized=len(group) > _MANY,
                color="C0",
            )
        axes.set_yticks(range(len(values)), labels, fontsize="small")
        axes.invert_yaxis()
        axes.set(xlim=score_range(measure), xlabel=title)

    named = zip(report.conditions, values, strict=True)
    medians = ", ".join(f"{name} {np.median(group):.3f}" for name, group in named if len(group))
    return draw, f"{title} by condition; medians: {medians}.", "Quartiles, median and every item."


def _by_severity(report: HaspiReport) -> _Drawn:
    names = [name for name in SEVERITIES if name in report.severities]
    groups, alt = _groups(report, report.severities, names, "degree of loss")

    def draw(axes: Any) -> None:
        width, colours = 0.8 / len(report.conditions), condition_colours(report.conditions)
        for k, condition in enumerate(report.conditions):
            at = np.arange(len(groups)) + (k - (len(report.conditions) - 1) / 2) * width
            scores = [group[k] for group in groups.values()]
            means = [_mean(group) for group in scores]
            axes.bar(at, means, width * 0.9, color=colours[condition], label=plain(condition))
            for place, group in zip(at, scores, strict=True):
                if len(group) >= FEWEST:
                    axes.plot(
                        (place, place), bootstrap_interval(group), color="black", linewidth=1.0
                    )
        counts = [f"{name} ({report.severities.count(name)})" for name in groups]
        axes.set_xticks(range(len(groups)), counts)
        axes.set(ylim=(0.0, score_range(report.measures[0])[1]), xlabel="loss (items)")
        axes.set(ylabel=f"mean {report.headline.title}")
        legend(axes)

    caption = (
        "By degree of loss, of the items that have each score, with 95 % bootstrap intervals of the means from "
        f"{FEWEST} items on."
    )
    return draw, alt, caption


def _by_snr(report: HaspiReport) -> _Drawn:
    snrs = [item.snr for item in report.items]
    groups, alt = _groups(
        report, snrs, sorted({snr for snr in snrs if snr is not None}), "SNR", " dB"
    )

    def draw(axes: Any) -> None:
        for k, (condition, colour) in enumerate(condition_colours(report.conditions).items()):
            means = [_mean(group[k]) for group in groups.values()]
            axes.plot([*groups], means, marker="o", color=colour, label=plain(condition))
        axes.set(xlabel="SNR (dB)", ylabel=f"mean {report.headline.title}")
        axes.set(ylim=score_range(report.measures[0]))
        legend(axes)

    return draw, alt, "By SNR, of the items that have each score."


def _by_listener(report: HaspiReport) -> _Drawn:
    c = report.headline
    scores = report.scores(c.measure, (c.before, c.after))
    listeners = np.array([item.listener for item in report.items])
    both = np.isfinite(scores).all(1)
    names = np.unique(listeners[both])
    means = np.array([scores[both & (listeners == name)].mean(0) for name in names])
    order = means[:, 0].argsort()
    names, means = names[order], means[order]

    def draw(axes: Any) -> None:
        few, places = len(names) <= _LABELLED, np.arange(len(names))
        axes.figure.set_figheight(1.2 + 0.19 * len(names) if few else 5.0)
        axes.hlines(places, means[:, 0], means[:, 1], color="0.6", linewidth=1.0)
        axes.scatter(
            means[:, 0],
            places,
            s=16,
            facecolor="white",
            edgecolor="0.3",
            label=plain(c.before),
            zorder=2,
        )
        colour = condition_colours(report.conditions)[c.after]
        axes.scatter(means[:, 1], places, s=16, color=colour, label=plain(c.after), zorder=2)
        axes.set_yticks(places if few else [], map(plain, names) if few else [], fontsize="small")
        axes.set(
            xlim=score_range(c.measure), ylim=(-0.6, len(names) - 0.4), xlabel=f"mean {c.title}"
        )
        legend(axes)

    rose = int((means[:, 1] > means[:, 0]).sum())
    alt = f"Mean {c.title} of each of {len(names)} {report.unit}; it rose for {rose}."
    return draw, alt, f"A line for each of {len(names)} {report.unit}."


def _audiograms(report: HaspiReport) -> _Drawn:
    ears = list(dict.fromkeys(item.audiogram for item in report.items))
    many = len(ears) > 1

    def draw(axes: Any) -> None:
        for ear in ears:
            ear.plot(
                axes, color="C0", alpha=max(0.15, 1.0 / len(ears)), marker="." if many else "o"
            )
        if many:
            mean = np.mean([ear.thresholds for ear in ears], axis=0)
            axes.plot(FREQUENCIES, mean, color="black", label="mean")
            legend(axes)

    told = f"Audiograms of {len(ears)} ears." if many else "The ear's audiogram."
    return draw, told, f"{told} The bands are MSBG's degrees of loss."


def _groups(
    report: HaspiReport, of_items: Sequence[Any], names: Sequence[Any], by: str, unit: str = ""
) -> tuple[dict[Any, list[np.ndarray]], str]:
    """Known scores of the first measure by what the items are, a list of conditions each, and their means in words."""
    scores = report.scores(report.measures[0])
    chosen = {name: scores[[group == name for group in of_items]] for name in names}
    groups = {name: [_known(column) for column in group.T] for name, group in chosen.items()}
    told = []
    for name, group in groups.items():
        pairs = zip(report.conditions, group, strict=True)
        means = ", ".join(
            f"{c} {_mean(known):.3f}" if len(known) else f"{c} n/a" for c, known in pairs
        )
        told.append(f"{name if isinstance(name, str) else f'{name:g}'}{unit}: {means}")
    return groups, f"Mean {report.headline.title} by {by}: {'; '.join(told)}."


def _known(values: np.ndarray) -> np.ndarray:
    return values[np.isfinite(values)]


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
