"""Plots of a study, narrow enough for a phone. All raise MissingExtraError without matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from hlsim.audiogram import FREQUENCIES, SEVERITIES, Audiogram
from hlsim.audiogram.plot import frequency_axis
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.measures import MEASURES, title_of
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.statistics import FEWEST, bootstrap_interval
from hlsim.evaluation.study import Condition
from hlsim.extras import require
from hlsim.report.page import Picture
from hlsim.report.results import loss_name

MANY_POINTS = 2000
"""Number of points above which they are drawn as pixels, so that a page stays small."""

MOST_NAMES = 40
"""Number of listeners up to which each is named."""

FREQUENCY_TICKS = (250, 500, 1000, 2000, 4000)

Draw = Callable[[Any], None]
"""A function that draws on matplotlib axes."""


def draw_svg(draw: Draw) -> bytes:
    """Return the SVG of what a function draws."""
    figure = new_figure((4.2, 3.5))
    draw(figure.subplots())
    return svg(figure)


def svg(figure: Any) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes."""
    data = io.BytesIO()
    with require("matplotlib", "eval").rc_context({"svg.hashsalt": "hlsim"}):
        figure.savefig(data, format="svg", dpi=150, metadata={"Date": None})
    return data.getvalue()


def png(figure: Any, dpi: int) -> bytes:
    """Return a figure as PNG."""
    data = io.BytesIO()
    figure.savefig(data, dpi=dpi, format="png")
    return data.getvalue()


def new_figure(inches: tuple[float, float]) -> Any:
    """Return a figure of its own: without pyplot there is no window and no global state."""
    figure = require("matplotlib.figure", "eval").Figure(figsize=inches, layout="constrained")
    require("matplotlib.backends.backend_agg", "eval").FigureCanvasAgg(figure)
    return figure


def plain(text: str) -> str:
    """Return a label that matplotlib shows as it is: no mathematics, nothing hidden from a legend."""
    text = text.replace("$", r"\$")
    return f"\u200b{text}" if text.startswith("_") else text


def condition_colours(conditions: Sequence[Condition]) -> dict[str, Any]:
    """Return a colour for each condition; one that belongs to another has its colour, paler."""
    names = {condition.name for condition in conditions}
    heads = [condition.name for condition in conditions if condition.of not in names]
    colours: dict[str, Any] = {name: f"C{place % 10}" for place, name in enumerate(heads)}
    for head in heads:
        belonging = [condition.name for condition in conditions if condition.of == head]
        for place, name in enumerate(belonging):
            colours[name] = (colours[head], 0.6 / (place + 1))
    return {condition.name: colours[condition.name] for condition in conditions}


def legend(axes: Any) -> None:
    """Draw the legend below the axes, where it covers nothing; the figure grows by it."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if max(map(len, labels)) < 24 else 1
    rows = -(-len(labels) // columns)
    axes.figure.set_figheight(axes.figure.get_figheight() + 0.21 * rows)
    style = {"ncols": columns, "fontsize": "small", "frameon": False}
    axes.figure.legend(handles, labels, loc="outside lower left", **style)


def scatter(axes: Any, x: np.ndarray, y: np.ndarray, severities: Sequence[str], equal: str) -> None:
    """Draw one point per item, coloured by degree of loss, and a line where both values are equal."""
    axes.axline((1.0, 1.0), slope=1.0, color="0.5", linewidth=1.0, linestyle="--", label=equal)
    known, degrees = np.isfinite(x + y), np.array(severities)
    for place, severity in enumerate(SEVERITIES):
        chosen = known & (degrees == severity)
        if chosen.any():
            pixels = chosen.sum() > MANY_POINTS
            style = {"color": f"C{place}", "label": loss_name(severity), "rasterized": pixels}
            axes.scatter(x[chosen], y[chosen], s=14, alpha=0.7, **style)


def distribution_picture(groups: Mapping[str, np.ndarray], title: str, alt: str) -> Picture:
    """Draw quartiles, median and every value of each group."""

    def draw(axes: Any) -> None:
        axes.figure.set_figheight(1.0 + 0.45 * len(groups))
        generator = np.random.default_rng(0)
        for place, values in enumerate(groups.values()):
            if len(values):
                low, middle, high = np.percentile(values, (25, 50, 75))
                axes.barh(place, high - low, 0.56, low, color="0.85")
                axes.plot((middle, middle), (place - 0.28, place + 0.28), color="black")
            heights = place + generator.uniform(-0.18, 0.18, len(values))
            pixels = len(values) > MANY_POINTS
            style = {"s": 7, "alpha": 0.4, "linewidths": 0, "color": "C0", "rasterized": pixels}
            axes.scatter(values, heights, **style)
        labels = [plain(fill(name, 18)) for name in groups]
        axes.set_yticks(range(len(groups)), labels, fontsize="small")
        axes.invert_yaxis()
        axes.set(xlabel=title)

    medians = [f"{name} {np.median(values):.3f}" for name, values in groups.items() if len(values)]
    return Picture(
        draw_svg(draw),
        f"{title} {alt}; medians: {', '.join(medians)}.",
        f"{title} {alt}: quartiles, median and every item.",
    )


def curves_picture(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    colours: Mapping[str, Any],
    alt: str,
    *,
    axis: str,
    over: str = "",
    caption: str = "",
    dashed: Sequence[str] = (),
    lowest: float | None = None,
) -> Picture:
    """Draw curves of (x, y) by name, over frequency unless ``over`` names another axis."""

    def draw(axes: Any) -> None:
        for name, (x, y) in curves.items():
            style = {"linestyle": "--"} if name in dashed else {"marker": "." if over else ""}
            axes.plot(x, y, color=colours.get(name, "black"), label=plain(name), **style)
        axes.set(ylabel=axis, ylim=(lowest, None))
        if over:
            axes.set(xlabel=over)
            axes.grid(alpha=0.3)
        else:
            frequency_axis(axes, FREQUENCY_TICKS)
        legend(axes)

    return Picture(draw_svg(draw), alt, caption or alt)


def gain_picture(
    title: str, curves: Sequence[Mapping[str, Any]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the insertion gains of ``gain_curves``: one colour per aid, one line style per level."""
    levels = curves[0]["levels"]
    styles = ("-", "--", ":", "-.")

    def draw(axes: Any) -> None:
        for curve in curves:
            for place, gains in enumerate(curve["gain_db"]):
                style = {"linestyle": styles[place % 4], "lw": 1.5 * (1 + place // 4)}
                label = None if place else plain(curve["aid"])
                colour = colours[curve["aid"]]
                axes.plot(curve["frequencies"], gains, color=colour, label=label, **style)
        for place, level in enumerate(levels):
            style = {"linestyle": styles[place % 4], "lw": 1.5 * (1 + place // 4)}
            axes.plot([], [], color="black", label=f"input of {level:g} dB SPL", **style)
        axes.set(ylabel="insertion gain (dB)")
        frequency_axis(axes, FREQUENCY_TICKS)
        legend(axes)

    at_2_khz = []
    for curve in curves:
        bands = np.log(curve["frequencies"])
        gains = [np.interp(np.log(2000.0), bands, gains) for gains in curve["gain_db"]]
        at_2_khz.append(f"{curve['aid']} {', '.join(f'{gain:.0f}' for gain in gains)}")
    inputs = ", ".join(f"{level:g}" for level in levels)
    alt = f"Insertion gain, {title}; at 2 kHz for inputs of {inputs} dB SPL: {'; '.join(at_2_khz)} dB."
    return Picture(draw_svg(draw), alt, f"Insertion gain, {title}.")


def study_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw a study of scores; a picture that would show a single group or item is left out."""
    headline = evaluation.headline
    if headline is None or headline.overall.n < 2:
        return []
    column = headline.measure
    pictures = [
        _before_after(evaluation, headline),
        _change_over_level(evaluation, headline),
        distribution_picture(
            {name: values.dropna().to_numpy() for name, values in evaluation.wide(column).items()},
            headline.title,
            "by condition",
        ),
    ]
    items = evaluation.table.drop_duplicates("item")
    if items["severity"].nunique() > 1:
        order = [name for name in SEVERITIES if name in set(items["severity"])]
        pictures.append(_bars(evaluation, column, "severity", order))
    if "snr" in items and items["snr"].nunique() > 1:
        pictures.append(_by_snr(evaluation, column))
    if headline.unit_means is not None:
        pictures.append(_by_unit(evaluation, headline))
    ears = dict.fromkeys(tuple(ear) for ear in items["audiogram"])
    if len(ears) > 1:
        pictures.append(_audiograms([Audiogram(ear) for ear in ears]))
    return pictures


def _ends(evaluation: Evaluation, c: Comparison, column: str) -> tuple[np.ndarray, np.ndarray]:
    """Return one column under both conditions of a comparison, for the items with both scores."""
    scored = evaluation.wide(c.measure)[[c.before, c.after]].notna().all(axis=1)
    wide = evaluation.wide(column)[scored]
    return wide[c.before].to_numpy(), wide[c.after].to_numpy()


def _score_axis(column: str) -> tuple[float, float] | None:
    """Return the ends of a score's axis, with a margin; None if they are not known."""
    ends = MEASURES[column].ends if column in MEASURES else None
    return None if ends is None else (ends[0] - 0.03, ends[1] + 0.03)


def _before_after(evaluation: Evaluation, c: Comparison) -> Picture:
    before, after = _ends(evaluation, c, c.measure)
    scored = evaluation.wide(c.measure)[[c.before, c.after]].dropna().index
    severities = evaluation.table.drop_duplicates("item").set_index("item").loc[scored, "severity"]

    def draw(axes: Any) -> None:
        scatter(axes, before, after, list(severities), "no change")
        limits = _score_axis(c.measure)
        axes.set(xlim=limits, ylim=limits, aspect="equal")
        axes.set(xlabel=plain(f"{c.title}, {c.before}"), ylabel=plain(f"{c.title}, {c.after}"))
        legend(axes)

    means = f"mean {c.overall.before_mean:.3f} and {c.overall.after_mean:.3f}"
    return Picture(
        draw_svg(draw),
        f"{c.title} of {c.overall.n} items under {c.before} and {c.after}: {means}.",
        "One point per item; above the dashed line the score rose.",
    )


def _change_over_level(evaluation: Evaluation, c: Comparison) -> Picture:
    scores, levels = _ends(evaluation, c, c.measure), _ends(evaluation, c, "level")
    score_change, level_change = scores[1] - scores[0], levels[1] - levels[0]

    def draw(axes: Any) -> None:
        axes.axhline(0.0, color="0.5", linewidth=1.0, linestyle="--")
        pixels = len(level_change) > MANY_POINTS
        axes.scatter(level_change, score_change, s=14, alpha=0.7, rasterized=pixels)
        axes.set(xlabel="change of level (dB)", ylabel=f"change of {c.title}")

    ends = f"{level_change.min():+.1f} to {level_change.max():+.1f} dB"
    return Picture(
        draw_svg(draw),
        f"Change of {c.title} over the change of level, which is {ends}.",
        "What gain may explain: change of the score over change of the level.",
    )


def _bars(evaluation: Evaluation, column: str, by: str, groups: Sequence[Any]) -> Picture:
    """Draw means with bootstrap intervals, by a fact of the items."""
    colours = condition_colours(evaluation.conditions)
    table, count = evaluation.table, len(evaluation.conditions)
    values = {
        name: [_values(table, column, name, by, group) for group in groups] for name in colours
    }

    def draw(axes: Any) -> None:
        width = 0.8 / count
        for place, (name, of_groups) in enumerate(values.items()):
            at = np.arange(len(groups)) + (place - (count - 1) / 2) * width
            means = [group.mean() if len(group) else np.nan for group in of_groups]
            axes.bar(at, means, width * 0.9, color=colours[name], label=plain(name))
            for x, group in zip(at, of_groups, strict=True):
                if len(group) >= FEWEST:
                    axes.plot((x, x), bootstrap_interval(group), color="black", linewidth=1.0)
        items = table.drop_duplicates("item")[by]
        axes.set_xticks(range(len(groups)), [f"{g} ({(items == g).sum()})" for g in groups])
        axes.set(
            ylim=_score_axis(column), xlabel=f"{by} (items)", ylabel=f"mean {title_of(column)}"
        )
        legend(axes)

    return Picture(
        draw_svg(draw),
        f"Mean {title_of(column)} by {by}.",
        f"Means by {by}, with 95 % bootstrap intervals from {FEWEST} items on.",
    )


def _by_snr(evaluation: Evaluation, column: str) -> Picture:
    means = evaluation.table.groupby(["condition", "snr"])[column].mean()
    curves = {
        name: (list(means[name].index), list(means[name]))
        for name in evaluation.names
        if name in means
    }
    title = title_of(column)
    return curves_picture(
        curves,
        condition_colours(evaluation.conditions),
        f"Mean {title} over SNR.",
        axis=f"mean {title}",
        over="SNR (dB)",
    )


def _by_unit(evaluation: Evaluation, c: Comparison) -> Picture:
    both = evaluation.wide(c.measure)[[c.before, c.after]].dropna()
    units = evaluation.table.drop_duplicates("item").set_index("item").loc[both.index, c.unit]
    means = both.groupby(units).mean().sort_values(c.before)
    colour = condition_colours(evaluation.conditions)[c.after]

    def draw(axes: Any) -> None:
        places, named = np.arange(len(means)), len(means) <= MOST_NAMES
        axes.figure.set_figheight(1.2 + 0.19 * len(means) if named else 5.0)
        axes.hlines(places, means[c.before], means[c.after], color="0.6", linewidth=1.0)
        hollow = {"facecolor": "white", "edgecolor": "0.3", "zorder": 2, "s": 16}
        axes.scatter(means[c.before], places, label=plain(c.before), **hollow)
        axes.scatter(means[c.after], places, s=16, color=colour, label=plain(c.after), zorder=2)
        names = list(map(plain, means.index)) if named else []
        axes.set_yticks(places if named else [], names, fontsize="small")
        axes.set(xlim=_score_axis(c.measure), xlabel=f"mean {c.title}")
        legend(axes)

    rose = int((means[c.after] > means[c.before]).sum())
    return Picture(
        draw_svg(draw),
        f"Mean {c.title} of each of {len(means)} {c.unit}s; it rose for {rose}.",
        f"One line for each of {len(means)} {c.unit}s.",
    )


def _audiograms(ears: Sequence[Audiogram]) -> Picture:
    def draw(axes: Any) -> None:
        for ear in ears:
            ear.plot(axes, color="C0", alpha=max(0.15, 1.0 / len(ears)), marker=".")
        mean = np.mean([ear.thresholds for ear in ears], axis=0)
        axes.plot(FREQUENCIES, mean, color="black", label="mean")
        legend(axes)

    text = f"Audiograms of {len(ears)} ears, with the degrees of loss that MSBG knows."
    return Picture(draw_svg(draw), text, text)


def _values(table: Any, column: str, condition: str, by: str, group: Any) -> np.ndarray:
    chosen = table[(table["condition"] == condition) & (table[by] == group)]
    return np.asarray(chosen[column].dropna())
