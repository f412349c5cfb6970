"""Pictures of a study's scores and curves, narrow enough for a phone, on light and dark pages.

Drawing a picture raises MissingExtraError without matplotlib. Pyplot is not used, so that no
window, no global state and no notebook's backend is involved.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from colorsys import hls_to_rgb
from functools import partial
from itertools import cycle
from textwrap import fill
from typing import Any

import numpy as np

from hlsim.audiogram.plot import frequency_axis
from hlsim.evaluation.fitting.verification import PERCENTILES, Verification
from hlsim.evaluation.measures import column_title
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.statistics import MIN_ITEMS_FOR_INTERVAL, bootstrap_interval
from hlsim.evaluation.study import Condition
from hlsim.extras import require
from hlsim.report.page import Picture

INK = "#010203"
"""Placeholder for the colour of text, which is dark on a light page and light on a dark page."""

_COLOURS = ("#2f7ed8", "#c96a00", "#128a66", "#b04a92", "#d0433e", "#8a6d3b")
"""Colours of lines and their labels, which can be read on white and on black."""

UNAIDED_COLOUR = "#7d828a"
"""Colour of the condition without an aid."""

_LINE_STYLES = ("-", "--", ":", "-.")
"""Styles of the curves of one aid, in the order of the levels."""

_LINEAR_DB = 0.5
"""Largest difference in dB between gains at several levels that are drawn as one curve."""

_MOST_DRAWN_POINTS = 2000
"""Number of points above which they become an image in the drawing."""

_NO_BREAK = "\N{NO-BREAK SPACE}"
_WIDTH_INCHES = 4.2
_LEGEND_INCHES = 0.2  # for each row of a legend

_LEGEND: dict[str, Any] = {
    "ncols": 2,
    "frameon": False,
    "fontsize": 9,
    "handlelength": 1.5,
    "columnspacing": 1.0,
}
"""Properties of the legend below curves."""

_INKED = "text.color axes.edgecolor axes.labelcolor xtick.color ytick.color"

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
"""Horizontal values, vertical values, and matplotlib's properties of a line, such as ``color``."""


def _draw_svg(draw: Callable[[Any], None], height: float = 3.2) -> bytes:
    """Return the contents of an SVG file that a function draws with matplotlib.

    Args:
        draw: Function that is called with matplotlib's axes.
        height: Height in inches.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figures = require("matplotlib.figure", "eval")
    data = io.BytesIO()
    matplotlib = require("matplotlib", "eval")
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # Settings of the user, such as TeX, must not fail or change pages.
        matplotlib.rcParams.update(_STYLE)
        figure = figures.Figure(figsize=(_WIDTH_INCHES, height), layout="constrained")
        draw(figure.subplots())
        figure.savefig(data, format="svg", transparent=True, metadata={"Date": None})
    svg = data.getvalue().replace(INK.encode(), b"currentColor")
    return svg.replace(b"</style>", _CSS + b"</style>", 1)


def condition_colours(conditions: Sequence[Condition]) -> dict[str, Any]:
    """Return a colour of matplotlib for each condition, by its name.

    A condition that belongs to another one by its attribute ``of``, such as NAL-R at an aid's
    level, has the colour of that one, but paler: a tuple of this colour and an opacity.

    >>> condition_colours([Condition("unaided", kind="unaided"), Condition("mine")])
    {'unaided': '#7d828a', 'mine': '#2f7ed8'}
    """
    names = [condition.name for condition in conditions]
    aided = [c.name for c in conditions if c.of not in names and c.kind != "unaided"]
    colours: dict[str, Any] = dict.fromkeys(names, UNAIDED_COLOUR)
    colours.update(zip(aided, _palette(len(aided)), strict=False))
    for condition in conditions:
        if condition.of in names:
            colours[condition.name] = (colours[condition.of], 0.6)
    return colours


def _palette(count: int) -> Sequence[Any]:
    """Return ``count`` or more different colours of matplotlib."""
    if count <= len(_COLOURS):
        return _COLOURS
    return [hls_to_rgb(number / count, 0.45, 0.6) for number in range(count)]


def curves_picture(
    curves: Mapping[str, Curve],
    title: str,
    axis: str,
    *,
    axis_range: tuple[float | None, float | None] = (None, None),
    note: str = "",
) -> Picture:
    """Draw curves over frequency in Hz, with a legend below them.

    Args:
        curves: Frequencies in Hz, vertical values and matplotlib's line properties of each curve,
            under the name that the legend shows.
        title: Heading above the picture.
        axis: Title of the vertical axis.
        axis_range: Values at the lower and the upper end of the vertical axis; None fits an end to
            the curves.
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
        frequency_axis(axes, (250, 500, 1000, 2000, 4000, 8000))
        axes.figure.legend(loc="outside lower left", **_LEGEND)

    height = 2.9 + _LEGEND_INCHES * ((len(curves) + 1) // 2)
    return Picture(partial(_draw_svg, draw, height), title, note)


def verification_picture(result: Verification) -> Picture:
    """Draw the percentiles of an aid's output, their targets, threshold and uncomfortable level.

    All are levels in dB SPL over frequency.

    Args:
        result: Result of ``verify``.

    >>> import hlsim
    >>> from hlsim.evaluation.fitting.verification import verify
    >>> speech = hlsim.example_speech()
    >>> verification_picture(verify(speech, speech, "N3", 16000)).title
    'Output of the aid in third octaves'
    """
    limit = {"color": UNAIDED_COLOUR, "linestyle": "--"}
    curves: dict[str, Curve] = {"uncomfortable level": (result.hertz, result.uncomfortable, limit)}
    styles = (":", "-", "--")
    for share, levels, style in zip(PERCENTILES, result.output_levels, styles, strict=True):
        line = {"color": _COLOURS[0], "linestyle": style}
        curves[f"output, {share} % of sections"] = (result.hertz, levels, line)
    curves["threshold"] = (result.hertz, result.thresholds, {"color": UNAIDED_COLOUR})
    targets = result.input_levels + result.targets
    for share, levels, style in zip(PERCENTILES, targets, styles, strict=True):
        line = {"color": _COLOURS[1], "linestyle": style}
        curves[f"target, {share} %"] = (result.hertz, levels, line)
    return curves_picture(curves, "Output of the aid in third octaves", "level (dB SPL)")


def gain_picture(
    title: str, results: Sequence[Mapping[str, Any]], colours: Mapping[str, Any]
) -> Picture:
    """Draw the gain of aids for one ear over frequency, with one curve per aid and level.

    An aid whose gains at all levels differ by less than 0.5 dB has a single curve. With more than
    four levels, the styles of the lines are used again.

    Args:
        title: Heading above the picture.
        results: One dict per aid with its name ``aid``, ``levels`` in dB SPL, ``frequencies`` in
            Hz, and ``gain_db`` with shape (levels, frequencies).
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
        for name, line, style in zip(names, gains.tolist(), cycle(_LINE_STYLES), strict=False):
            curves[name] = (row["frequencies"], line, {"color": colours[aid], "linestyle": style})
    return curves_picture(curves, title, "insertion gain (dB)")


def ears_picture(
    title: str,
    axis: str,
    values: Sequence[tuple[str, str, Sequence[float]]],
    colours: Mapping[str, Any],
) -> Picture:
    """Draw a value with its interval for each ear and aid, with the aids of an ear side by side.

    Args:
        title: Heading above the picture.
        axis: Title of the vertical axis.
        values: Tuples (ear, aid, value), where the value has three numbers: the value itself, and
            the lower and the upper limit of its interval. Infinite ones are not drawn.
        colours: Colour of matplotlib for each aid.

    >>> values = [("N3", "mine", (-5.0, -6.0, -4.0)), ("N4", "mine", (2.0, 1.0, 3.0))]
    >>> ears_picture("Thresholds", "threshold (dB)", values, {"mine": "#2f7ed8"}).title
    'Thresholds'
    """
    ears = [*dict.fromkeys(ear for ear, _, _ in values)]
    aids = [*dict.fromkeys(aid for _, aid, _ in values)]

    def draw(axes: Any) -> None:
        for number, aid in enumerate(aids):
            shift = 0.6 * (number + 0.5) / len(aids) - 0.3
            values_of_aid = {ear: value for ear, name, value in values if name == aid}
            places = [ears.index(ear) + shift for ear in values_of_aid]
            points, low, high = np.array([*values_of_aid.values()]).T
            # A label that begins with an underscore would be hidden.
            axes.plot(places, points, "o", color=colours[aid], label=f" {fill(aid, 26)}")
            axes.vlines(places, low, high, colors=[colours[aid]])
        axes.set(ylabel=axis, xlim=(-0.5, len(ears) - 0.5))
        axes.set_xticks(range(len(ears)), ears)
        axes.grid(axis="y", alpha=0.4)
        axes.figure.legend(loc="outside lower left", **_LEGEND)

    height = 2.9 + _LEGEND_INCHES * ((len(aids) + 1) // 2)
    return Picture(partial(_draw_svg, draw, height), title)


def means_pictures(evaluation: Evaluation, part: str = "") -> list[Picture]:
    """Draw the mean of the first score under each condition, with its 95 % interval.

    Args:
        evaluation: Evaluation with the scores.
        part: Name of the part of the items, such as "Clean speech", for the title.

    Returns: A list with the picture, or an empty list if fewer than two conditions have scores.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> conditions = [Condition("a"), Condition("b")]
    >>> evaluation = Evaluation([], conditions, [MEASURES["haspi"]], table)
    >>> [picture.title for picture in means_pictures(evaluation)]
    ['HASPI of all conditions']
    """
    measure = evaluation.scores[0]
    title = column_title(measure)
    scores = evaluation.wide(measure).dropna(axis=1, how="all")
    count = len(scores.columns)
    if count < 2:
        return []
    colours = condition_colours(evaluation.conditions)

    def draw(axes: Any) -> None:
        for place, name in enumerate(scores):
            values = scores[name].dropna().to_numpy()
            interval = bootstrap_interval(values)
            if interval is not None:
                axes.plot(interval, [place, place], color=colours[name], linewidth=2.0)
            axes.plot([values.mean()], [place], "o", color=colours[name])
        axes.set_yticks(range(count), [fill(name, 22) for name in scores])
        axes.set(xlabel=title, ylim=(count - 0.5, -0.5))
        axes.grid(axis="x", alpha=0.4)

    note = (
        "Points are means over items, lines their 95 % intervals if there are "
        f"{MIN_ITEMS_FOR_INTERVAL} items or more. The intervals of two conditions may overlap "
        "although their difference is significant, because each item is scored under both."
    )
    heading = f"{title} of all conditions" + (f", {part[0].lower()}{part[1:]}" if part else "")
    return [Picture(partial(_draw_svg, draw, 1.0 + 0.4 * count), heading, note)]


def scores_pictures(evaluation: Evaluation) -> list[Picture]:
    """Draw each item's scores under the two conditions of ``evaluation.headline`` as a point.

    Args:
        evaluation: Evaluation with comparisons.

    Returns: A list with the picture, or an empty list without a comparison of two or more items.

    >>> import pandas
    >>> from hlsim.evaluation import MEASURES, compare
    >>> rows = [(0, "a", 0.2), (1, "a", 0.4), (0, "b", 0.3), (1, "b", 0.5)]
    >>> table = pandas.DataFrame(rows, columns=["item", "condition", "haspi"])
    >>> conditions, comparisons = [Condition("a"), Condition("b")], compare(table, ["haspi"])
    >>> evaluation = Evaluation([], conditions, [MEASURES["haspi"]], table, comparisons)
    >>> [picture.title for picture in scores_pictures(evaluation)]
    ['HASPI of the 2 items']
    """
    c = evaluation.headline
    if c is None or c.overall.n < 2:
        return []
    before, after = evaluation.wide(c.measure)[[c.before, c.after]].dropna().to_numpy().T
    axis_range = (-0.03, 1.03) if c.measure in ("haspi", "hasqi", "haaqi", "stoi") else None

    def draw(axes: Any) -> None:
        axes.axline((1.0, 1.0), slope=1.0, color=INK, alpha=0.5, linewidth=1.0, linestyle="--")
        # Thousands of points as drawings would make the page large and slow.
        is_raster = len(before) > _MOST_DRAWN_POINTS
        style = {"alpha": 0.6, "linewidths": 0, "color": _COLOURS[0], "rasterized": is_raster}
        axes.scatter(before, after, s=16, **style)
        axes.set(xlabel=f"{c.title}, {c.before}", ylabel=f"{c.title}, {c.after}")
        axes.set(xlim=axis_range, ylim=axis_range)

    note = "Each point is an item; both scores are equal on the dashed line."
    return [Picture(partial(_draw_svg, draw), f"{c.title} of the {len(before)} items", note)]
