"""Pictures of a study's scores and curves, narrow enough for a phone, on light and dark pages.

All functions raise MissingExtraError without matplotlib. They do not use pyplot, so that no
window, no global state and no notebook's backend is involved.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np

from hlsim.audiogram.plot import frequency_axis
from hlsim.evaluation.measures import MEASURES
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition
from hlsim.extras import require
from hlsim.report.page import Picture, Section
from hlsim.report.results import sort_facts

_MANY_POINTS = 2000
"""Number of points above which they are drawn as pixels, so that a page stays small."""

INK = "#010203"
"""Stand-in for the colour of text, which is dark on a light page and light on a dark page."""

_COLOURS = ("#2f7ed8", "#c96a00", "#128a66", "#b04a92", "#d0433e", "#8a6d3b")
"""Colours of lines and their labels, which can be read on white and on black."""

UNAIDED_COLOUR = "#7d828a"
"""Colour of the condition without an aid."""

_LINE_STYLES = ("-", "--", ":", "-.")
"""Styles of the curves of one aid, from the lowest level to the highest."""

_LINEAR_DB = 0.5
"""Difference between the gains at two levels below which they are drawn as one curve."""

_NO_BREAK = "\N{NO-BREAK SPACE}"
_WIDTH_INCHES = 4.2
_LEGEND_INCHES = 0.2  # for each row of a legend

_INKED = (
    "text.color axes.edgecolor axes.labelcolor xtick.color ytick.color boxplot.boxprops.color "
    "boxplot.medianprops.color boxplot.whiskerprops.color"
)

_STYLE: dict[str, Any] = {
    **dict.fromkeys(_INKED.split(), INK),
    "grid.color": "#9a9fa8",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,  # a $ in the name of a condition is a dollar
    "svg.fonttype": "none",
    "svg.hashsalt": "hlsim",  # the same plot gives the same bytes
}

_CSS = b"svg { color: #1a1c20 } @media (prefers-color-scheme: dark) { svg { color: #e6e8eb } }"

Curve = tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray, Mapping[str, Any]]
"""Horizontal and vertical values of a curve, and keyword arguments of matplotlib for its line."""


def _draw_picture(
    draw: Callable[[Any], None], title: str, *, alt: str = "", note: str = "", height: float = 3.2
) -> Picture:
    """Return an SVG picture for a page of what a function draws on matplotlib axes.

    Args:
        draw: Function that is called with the axes.
        title: Heading above the picture.
        alt: Text for readers who do not see the picture; by default the title.
        note: Sentence below the picture.
        height: Height in inches.

    >>> _draw_picture(lambda axes: axes.plot([1, 2]), "A line").alt
    'A line'
    """
    figures = require("matplotlib.figure", "eval")
    data = io.BytesIO()
    with require("matplotlib", "eval").rc_context(_STYLE):
        figure = figures.Figure(figsize=(_WIDTH_INCHES, height), layout="constrained")
        draw(figure.subplots())
        style = {"transparent": True, "dpi": 150, "metadata": {"Date": None}}
        figure.savefig(data, format="svg", **style)
    svg = data.getvalue().replace(INK.encode(), b"currentColor")
    svg = svg.replace(b"</style>", _CSS + b"</style>", 1)
    return Picture(svg, alt or title, title, note)


def condition_colours(conditions: Sequence[Condition]) -> dict[str, Any]:
    """Return the names of conditions with a colour of matplotlib for each.

    A condition that belongs to another one by its attribute ``of``, such as NAL-R at an aid's
    level, has a paler version of that one's colour.

    >>> condition_colours([Condition("unaided", kind="unaided"), Condition("mine")])
    {'unaided': '#7d828a', 'mine': '#2f7ed8'}
    """
    names = [condition.name for condition in conditions]
    aided = [c.name for c in conditions if c.of not in names and c.kind != "unaided"]
    colours: dict[str, Any] = dict.fromkeys(names, UNAIDED_COLOUR)
    colours |= {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(aided)}
    for condition in conditions:
        if condition.of in names:
            colours[condition.name] = (colours[condition.of], 0.6)
    return colours


def _draw_points(axes: Any, x: Any, y: Any, size: float) -> None:
    """Draw one point per item, as pixels if there are many."""
    style = {"alpha": 0.6, "linewidths": 0, "color": _COLOURS[0]}
    axes.scatter(x, y, s=size, rasterized=len(x) > _MANY_POINTS, **style)


def scatter_picture(
    x: Any, y: Any, axis_titles: tuple[str, str], title: str, axis_range: Any = None
) -> Picture:
    """Draw two values of each item against each other, and a line where both are equal.

    Args:
        x, y: Values of the items. Shape: (items,).
        axis_titles: Titles of the horizontal and of the vertical axis.
        title: Heading above the picture.
        axis_range: Lower and upper end of both axes; by default that of the values.

    >>> scatter_picture([0.2, 0.4], [0.3, 0.5], ("unaided", "aid"), "HASPI of 2 items").title
    'HASPI of 2 items'
    """

    def draw(axes: Any) -> None:
        axes.axline((1.0, 1.0), slope=1.0, color=INK, alpha=0.5, linewidth=1.0, linestyle="--")
        _draw_points(axes, x, y, size=16)
        axes.set(
            xlabel=axis_titles[0],
            ylabel=axis_titles[1],
            xlim=axis_range,
            ylim=axis_range,
        )

    note = "Each point is an item; both values are equal on the dashed line."
    return _draw_picture(draw, title, note=note)


def distribution_picture(groups: Mapping[str, Any], measure: str, by: str) -> Picture:
    """Draw the median, the quartiles and all values of each group of items.

    Args:
        groups: Values of each group as a pandas series, under the name of the group.
        measure: Title of the values.
        by: Noun for the groups, such as "condition".

    >>> import pandas
    >>> scores = {"unaided": pandas.Series([0.2, 0.4]), "aid": pandas.Series([0.5, 0.7])}
    >>> distribution_picture(scores, "HASPI", "condition").alt
    'HASPI by condition; medians: unaided 0.300, aid 0.600.'
    """
    values = {
        name: group.dropna().to_numpy() for name, group in groups.items() if group.notna().any()
    }

    def draw(axes: Any) -> None:
        names = [fill(name, 18) for name in values]
        style = {"orientation": "horizontal", "tick_labels": names, "widths": 0.5}
        axes.boxplot(list(values.values()), whis=0.0, showfliers=False, showcaps=False, **style)
        generator = np.random.default_rng(0)
        for place, group in enumerate(values.values(), 1):
            heights = place + generator.uniform(-0.18, 0.18, len(group))
            _draw_points(axes, group, heights, size=9)
        axes.invert_yaxis()
        axes.set(xlabel=measure)

    medians = [f"{name} {np.median(group):.3f}" for name, group in values.items()]
    title = f"{measure} by {by}"
    alt = f"{title}; medians: {', '.join(medians)}."
    note = "Box: the middle half of the items and their median. Points: all items."
    return _draw_picture(draw, title, alt=alt, note=note, height=0.9 + 0.45 * len(values))


def curves_picture(
    curves: Mapping[str, Curve],
    title: str,
    axis: str,
    *,
    over: str = "",
    axis_range: tuple[float | None, float | None] = (None, None),
    note: str = "",
) -> Picture:
    """Draw curves, with a legend below them.

    Args:
        curves: Horizontal values, vertical values and a dictionary of matplotlib's line properties
            for each curve, under the name that the legend shows.
        title: Heading above the picture.
        axis: Title of the vertical axis.
        over: Title of the horizontal axis; by default, it is frequency in Hz.
        axis_range: Lower and upper end of the vertical axis; None is that of the curves.
        note: Sentence below the picture.

    >>> curves = {"aid": ([250, 1000, 4000], [5.0, 10.0, 20.0], {"color": "#2f7ed8"})}
    >>> curves_picture(curves, "Gain", "insertion gain (dB)").title
    'Gain'
    """

    def draw(axes: Any) -> None:
        for name, (x, y, style) in curves.items():
            # A label that begins with an underscore would be hidden.
            axes.plot(x, y, label=f" {fill(name, 26)}", **style)
        axes.set(ylabel=axis, ylim=axis_range)
        if over:
            axes.set(xlabel=over)
            axes.grid(alpha=0.3)
        else:
            frequency_axis(axes, (250, 500, 1000, 2000, 4000, 8000))
        style = {"frameon": False, "fontsize": 9, "handlelength": 1.5, "columnspacing": 1.0}
        axes.figure.legend(loc="outside lower left", ncols=2, **style)

    height = 2.9 + _LEGEND_INCHES * ((len(curves) + 1) // 2)
    return _draw_picture(draw, title, note=note, height=height)


def gain_picture(
    title: str, results: Sequence[Mapping[str, Any]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the gain of aids for one ear over frequency, with one curve per aid and level.

    An aid whose gains at all levels differ by less than 0.5 dB has a single curve.

    Args:
        title: Heading above the picture.
        results: For each aid, a dictionary of its name ``aid``, ``levels`` in dB SPL,
            ``frequencies`` in Hz, and ``gain_db`` with shape (levels, frequencies).
        colours: Colour of matplotlib for each aid.

    >>> curve = {"aid": "mine", "levels": [65.0], "frequencies": [250, 4000], "gain_db": [[5, 20]]}
    >>> gain_picture("Gain, ear N3", [curve], {"mine": "#2f7ed8"}).title
    'Gain, ear N3'
    """
    curves = {}
    for row in results:
        gains, aid = np.array(row["gain_db"]), row["aid"]
        names = [f"{aid}, {level:g}{_NO_BREAK}dB{_NO_BREAK}SPL" for level in row["levels"]]
        if float(np.ptp(gains, axis=0).max()) < _LINEAR_DB:
            gains, names = gains[:1], [aid]
        for name, line, style in zip(names, gains.tolist(), _LINE_STYLES, strict=False):
            curves[name] = (row["frequencies"], line, {"color": colours[aid], "linestyle": style})
    return curves_picture(curves, title, "insertion gain (dB)")


def means_picture(evaluation: Evaluation, column: str, fact: str, title: str, over: str) -> Picture:
    """Draw mean scores against a property of the items, such as their SNR, per condition.

    The curve of a condition has one point for each value of the property that occurs: the mean over
    all items with this value.

    Args:
        evaluation: The evaluation.
        column: Column of its table with the scores, such as ``"haspi"``.
        fact: Column of its table with the property, such as ``"snr"``.
        title: Title of the scores.
        over: Title of the property.

    >>> import pandas
    >>> rows = [(0, "aid", 5.0, 0.5), (1, "aid", 10.0, 0.7)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "snr", "haspi"])
    >>> evaluation = Evaluation([], [Condition("aid")], [], table)
    >>> means_picture(evaluation, "haspi", "snr", "HASPI", "SNR (dB)").title
    'Mean HASPI by SNR (dB)'
    """
    colours = condition_colours(evaluation.conditions)
    means = evaluation.table.groupby(["condition", fact])[column].mean()
    curves = {}
    for name in means.index.unique(0).intersection(evaluation.names):
        x = sort_facts(means[name].index)
        style = {"color": colours[name], "marker": "."}
        curves[name] = (x, [means[name][value] for value in x], style)
    return curves_picture(curves, f"Mean {title} by {over}", title, over=over)


def pictures_sections(evaluation: Evaluation) -> list[Section]:
    """Return the section "Pictures" of a page with the scores by which its conditions are compared.

    A picture that would show a single group or item is left out.

    Returns: The section, or an empty list if there is no comparison.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES, compare
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> conditions, comparisons = [Condition("a"), Condition("b")], compare(table, ["haspi"])
    >>> evaluation = Evaluation([], conditions, [MEASURES["haspi"]], table, comparisons)
    >>> [picture.title for picture in pictures_sections(evaluation)[0].pictures]
    ['HASPI by condition', 'HASPI of the 2 items']
    """
    c = evaluation.headline
    if c is None or c.overall.n < 2:
        return []
    scores = evaluation.wide(c.measure)
    before, after = scores[[c.before, c.after]].dropna().to_numpy().T
    scale = MEASURES[c.measure].score_range if c.measure in MEASURES else None
    axis_range = scale and (scale[0] - 0.03, scale[1] + 0.03)
    axis_titles = (f"{c.title}, {c.before}", f"{c.title}, {c.after}")
    title = f"{c.title} of the {len(before)} items"
    pictures = [
        distribution_picture(dict(scores.items()), c.title, "condition"),
        scatter_picture(before, after, axis_titles, title, axis_range),
    ]
    for fact, name in {"severity": "degree of loss", "snr": "SNR (dB)"}.items():
        if fact in evaluation.table and evaluation.table[fact].nunique() > 1:
            pictures.append(means_picture(evaluation, c.measure, fact, c.title, name))
    return [Section("Pictures", pictures=pictures)]
