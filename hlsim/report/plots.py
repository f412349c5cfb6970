"""Plots of a study, narrow enough for a phone. All raise MissingExtraError without matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from hlsim.audiogram.plot import frequency_axis
from hlsim.evaluation.comparison import Comparison
from hlsim.evaluation.measures import MEASURES
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition
from hlsim.extras import require
from hlsim.report.page import Picture, Section
from hlsim.report.results import loss_name, ordered

MANY_POINTS = 2000
"""Number of points above which they are drawn as pixels, so that a page stays small."""

LINE_STYLES = ("-", "--", ":", "-.")

Curves = Mapping[str, tuple[Sequence[float], Sequence[float], Mapping[str, Any]]]
"""Curves by name: x, y, and the style of the line."""


def draw_svg(draw: Callable[[Any], None], height: float = 3.5) -> bytes:
    """Return the SVG of what a function draws on matplotlib axes."""
    figure = new_figure((4.2, height))
    draw(figure.subplots())
    return svg(figure)


def svg(figure: Any) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes."""
    data = io.BytesIO()
    with require("matplotlib", "eval").rc_context({"svg.hashsalt": "hlsim"}):
        figure.savefig(data, format="svg", dpi=150, metadata={"Date": None})
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
    names = [condition.name for condition in conditions]
    heads = [condition.name for condition in conditions if condition.of not in names]
    colours: dict[str, Any] = {name: f"C{place % 10}" for place, name in enumerate(heads)}
    for head in heads:
        belonging = [condition.name for condition in conditions if condition.of == head]
        paler = {name: (colours[head], 0.6 / (k + 1)) for k, name in enumerate(belonging)}
        colours |= paler
    return colours


def legend(axes: Any) -> None:
    """Draw the legend below the axes, where it covers nothing; the figure grows by it."""
    handles, labels = axes.get_legend_handles_labels()
    columns = 2 if max(map(len, labels)) < 24 else 1
    rows = -(-len(labels) // columns)
    axes.figure.set_figheight(axes.figure.get_figheight() + 0.21 * rows)
    style = {"ncols": columns, "fontsize": "small", "frameon": False}
    axes.figure.legend(handles, labels, loc="outside lower left", **style)


def scatter_picture(
    x: Any, y: Any, severities: Any, titles: tuple[str, str], alt: str, ends: Any = None
) -> Picture:
    """Draw one point per item, coloured by degree of loss, and a line where both values are equal."""
    known = np.isfinite(x + y)

    def draw(axes: Any) -> None:
        line = {"color": "0.5", "linewidth": 1.0, "linestyle": "--", "label": "equal"}
        axes.axline((1.0, 1.0), slope=1.0, **line)
        for place, severity in enumerate(ordered(np.unique(severities).tolist())):
            chosen = known & (severities == severity)
            pixels = chosen.sum() > MANY_POINTS
            style = {"color": f"C{place}", "label": loss_name(severity), "rasterized": pixels}
            axes.scatter(x[chosen], y[chosen], s=14, alpha=0.7, **style)
        axes.set(xlabel=plain(titles[0]), ylabel=plain(titles[1]), xlim=ends, ylim=ends)
        legend(axes)

    return Picture(draw_svg(draw), alt, alt)


def distribution_picture(groups: Mapping[str, Any], title: str, by: str) -> Picture:
    """Draw quartiles, median and every value of each group."""
    groups = {name: values.dropna().to_numpy() for name, values in groups.items()}
    groups = {name: values for name, values in groups.items() if len(values)}

    def draw(axes: Any) -> None:
        generator = np.random.default_rng(0)
        for place, values in enumerate(groups.values()):
            low, middle, high = np.percentile(values, (25, 50, 75))
            axes.barh(place, high - low, 0.56, low, color="0.85")
            axes.plot((middle, middle), (place - 0.28, place + 0.28), color="black")
            heights = place + generator.uniform(-0.18, 0.18, len(values))
            pixels = len(values) > MANY_POINTS
            style = {"s": 7, "alpha": 0.4, "linewidths": 0, "color": "C0", "rasterized": pixels}
            axes.scatter(values, heights, **style)
        names = [plain(fill(name, 18)) for name in groups]
        axes.set_yticks(range(len(groups)), names, fontsize="small")
        axes.invert_yaxis()
        axes.set(xlabel=title)

    medians = [f"{name} {np.median(values):.3f}" for name, values in groups.items()]
    text = f"{title} by {by}: quartiles, median and every item"
    data = draw_svg(draw, height=1.0 + 0.45 * len(groups))
    return Picture(data, f"{text}; medians: {', '.join(medians)}.", f"{text}.")


def curves_picture(
    curves: Curves, alt: str, axis: str, over: str = "", lowest: float | None = None
) -> Picture:
    """Draw curves over frequency, or over what ``over`` names."""

    def draw(axes: Any) -> None:
        for name, (x, y, style) in curves.items():
            axes.plot(x, y, label=plain(name), marker="." if over else "", **style)
        axes.set(ylabel=axis, ylim=(lowest, None))
        if over:
            axes.set(xlabel=over)
            axes.grid(alpha=0.3)
        else:
            frequency_axis(axes, (250, 500, 1000, 2000, 4000))
        legend(axes)

    return Picture(draw_svg(draw), alt, alt)


def gain_picture(
    title: str, results: Sequence[Mapping[str, Any]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the insertion gains of ``gain_curves``: one colour per aid, one line style per level."""
    curves = {
        f"{row['aid']}, {level:g} dB SPL": (
            row["frequencies"],
            gains,
            {"color": colours[row["aid"]], "linestyle": LINE_STYLES[place % 4]},
        )
        for row in results
        for place, (level, gains) in enumerate(zip(row["levels"], row["gain_db"], strict=True))
    }
    return curves_picture(curves, f"Insertion gain, {title}.", "insertion gain (dB)")


def means_picture(evaluation: Evaluation, column: str, fact: str, title: str, over: str) -> Picture:
    """Draw the mean of a column over a fact of the items, one curve per condition."""
    colours = condition_colours(evaluation.conditions)
    means = evaluation.table.groupby(["condition", fact])[column].mean()
    curves = {}
    for name in evaluation.names:
        x = ordered(means[name].index) if name in means else []
        curves[name] = (x, [means[name][value] for value in x], {"color": colours[name]})
    return curves_picture(curves, f"Mean {title} over {over}.", f"mean {title}", over)


def pictures_section(evaluation: Evaluation) -> Section | None:
    """Draw a study of scores; a picture that would show a single group or item is left out."""
    headline = evaluation.headline
    if headline is None or headline.overall.n < 2:
        return None
    column, title = headline.measure, headline.title
    pictures = [*_headline_pictures(evaluation, headline)]
    by_condition = dict(evaluation.wide(column).items())
    pictures.append(distribution_picture(by_condition, title, "condition"))
    for fact, name in {"severity": "degree of loss", "snr": "SNR (dB)"}.items():
        if fact in evaluation.table and evaluation.table[fact].nunique() > 1:
            pictures.append(means_picture(evaluation, column, fact, title, name))
    return Section("Pictures", pictures=pictures)


def _headline_pictures(evaluation: Evaluation, c: Comparison) -> list[Picture]:
    """Draw the scores of the headline's items, and their change over that of the level."""
    scores = evaluation.wide(c.measure)[[c.before, c.after]].dropna()
    levels = evaluation.wide("level").loc[scores.index]
    facts = evaluation.table.drop_duplicates("item").set_index("item").loc[scores.index]
    before, after = scores[c.before].to_numpy(), scores[c.after].to_numpy()
    ends = MEASURES[c.measure].ends if c.measure in MEASURES else None
    margin = None if ends is None else (ends[0] - 0.03, ends[1] + 0.03)
    titles = (f"{c.title}, {c.before}", f"{c.title}, {c.after}")
    text = f"{c.title} of {len(scores)} items under {c.before} and {c.after}."
    change = (levels[c.after] - levels[c.before]).to_numpy()

    def draw(axes: Any) -> None:
        axes.axhline(0.0, color="0.5", linewidth=1.0, linestyle="--")
        axes.scatter(change, after - before, s=14, alpha=0.7, rasterized=len(change) > MANY_POINTS)
        axes.set(xlabel="change of level (dB)", ylabel=f"change of {c.title}")

    gain = f"What gain may explain: change of {c.title} over the change of level."
    severities = facts["severity"].to_numpy()
    return [
        scatter_picture(before, after, severities, titles, text, margin),
        Picture(draw_svg(draw), gain, gain),
    ]
