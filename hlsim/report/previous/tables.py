"""Tables of text, as Markdown and LaTeX write them (HTML: ``page``), their cells, and those of a paired comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hlsim.evaluation.previous.comparison import ALPHA, Comparison, compare_conditions, p_text
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.evaluation.statistics import PairedComparison
from hlsim.report.page import Table

_CHANGE = "Δ [95 % interval]"


def number(value: float | None, form: str, none: str = "n/a") -> str:
    """A figure, or what stands where there is none."""
    return none if value is None else f"{value:{form}}"


def cells(figures: Mapping[str, Any], columns: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    """Figures by title of the column, of which is given the name of the figure and its format."""
    return {title: number(figures[name], form) for title, (name, form) in columns.items()}


def spread(mean: float, deviation: float | None) -> str:
    """A mean and its standard deviation, where there is one."""
    return f"{mean:.3f}" if deviation is None else f"{mean:.3f} ± {deviation:.3f}"


def inner(title: str) -> str:
    """A title within another."""
    return title[:1].lower() + title[1:]


def loss_name(severity: str) -> str:
    """A degree of loss in words."""
    return "no loss" if severity == "none" else f"{severity} loss"


def paper_table(comparison: Comparison) -> Table:
    """The paper's last table, with the interval and the levels."""
    c, name = comparison.overall, comparison.title
    levels = (comparison.level_before_mean, comparison.level_after_mean)
    _, t, w, d = paired_cells(c, none="not defined").values()
    rows = [
        (f"{name} (mean ± std)", *_means(c), f"{c.delta:+.3f}"),
        ("95 % interval of Δ", "", "", _interval(c) or "not defined"),
        ("t-test (paired)", "", "", t),
        ("Wilcoxon signed-rank", "", "", w),
        ("Cohen's d (paired)", "", "", d if c.cohens_d is None else f"d = {d}"),
        (
            "Level (dB SPL, mean)",
            *(f"{level:.1f}" for level in levels),
            f"{levels[1] - levels[0]:+.1f}",
        ),
    ]
    caption = f"{name}, {comparison.before} against {comparison.after}, {c.n} items"
    return Table(caption, ("Metric", *_ends(comparison), "Change (Δ)"), rows)


def severity_table(comparison: Comparison) -> Table:
    """A row a degree of loss."""
    rows = {loss_name(name): c for name, c in comparison.by_severity.items()}
    return _paired_table(comparison, "by degree of loss", "Degree of loss", rows)


def listener_table(comparison: Comparison) -> Table | None:
    """Items and listener means side by side; None where listeners are not named."""
    if comparison.listeners is None:
        return None
    rows = {"items": comparison.overall, "listener means": comparison.listeners}
    return _paired_table(comparison, "with items nested in listeners", "Unit", rows)


def comparisons_table(comparisons: Sequence[Comparison]) -> Table:
    """A row a pair of conditions and measure, with p values adjusted by Holm."""
    rows = []
    for c in comparisons:
        paired, tests = paired_cells(c.overall), {"t-test": c.p_t_holm, "Wilcoxon": c.p_w_holm}
        rows.append(
            {"Comparison": change_name(c), "n": str(c.overall.n)}
            | {"From": f"{c.overall.before_mean:.3f}", "To": f"{c.overall.after_mean:.3f}"}
            | {_CHANGE: paired[_CHANGE]}
            | {f"{test}, Holm": "n/a" if p is None else p_text(p) for test, p in tests.items()}
            | {
                "d": paired["d"],
                "Level change (dB)": f"{c.level_after_mean - c.level_before_mean:+.1f}",
            }
        )
    return Table.of("All comparisons, p adjusted by Holm within each measure", rows)


def change_name(c: Comparison) -> str:
    """Measure and conditions."""
    return f"{c.title}: {c.before} to {c.after}"


def verdict(items: Sequence[ItemScore], before: str, after: str, aid: str, rival: str) -> str:
    """What the condition ``after`` is against ``before`` by HASPI, in one clause: better or worse at one level alone.

    A question asked beforehand, so that p values are not adjusted for other comparisons.
    """
    (c,) = compare_conditions(items, ["haspi"], [before, after])
    o, louder = c.overall, c.level_after_mean - c.level_before_mean
    by_chance = [p < ALPHA for p in (o.p_t, o.p_w) if p is not None]
    is_, scores = ("is", "scores") if all(by_chance) else ("may be", "may score")
    if not any(by_chance):
        told = f"cannot be told from {rival}"
    elif c.level_alike:
        told = f"{is_} {'better' if o.delta > 0 else 'worse'} than {rival}"
    else:
        told = f"{scores} {'higher' if o.delta > 0 else 'lower'} than {rival}"
    if not c.level_alike:
        told += f", which is {abs(louder):.1f} dB {'softer' if louder > 0 else 'louder'}"
    facts = f"{o.n} items, change {o.delta:+.3f}"
    if o.ci_low is not None:
        facts += f", 95 % interval {o.ci_low:+.3f} to {o.ci_high:+.3f}"
    if any(by_chance) and not all(by_chance):
        facts += ", the tests disagree"
    return f"{aid} {told}: HASPI {o.after_mean:.3f} against {o.before_mean:.3f} ({facts})"


def paired_cells(
    c: PairedComparison,
    p_t: float | None = None,
    p_w: float | None = None,
    none: str = "n/a",
    digits: int = 3,
) -> dict[str, str]:
    """Change and interval, both tests, and d; where ``p_t`` or ``p_w`` is given, it is told, such as an adjusted one."""
    return {
        _CHANGE: f"{c.delta:+.3f} {_interval(c)}".rstrip(),
        "t-test (paired)": _test(
            f"t = {number(c.t, f'+.{digits}f')}", c.p_t if p_t is None else p_t, none
        ),
        "Wilcoxon": _test(f"W = {number(c.w, '.1f')}", c.p_w if p_w is None else p_w, none),
        "d": number(c.cohens_d, f"+.{digits}f", none),
    }


def _paired_table(
    comparison: Comparison, by: str, unit: str, rows: Mapping[str, PairedComparison]
) -> Table:
    # two conditions may differ in their capitals alone: no titles of a dictionary
    header = (unit, "n", *_ends(comparison), *paired_cells(comparison.overall))
    cells = [(name, str(c.n), *_means(c), *paired_cells(c).values()) for name, c in rows.items()]
    caption = f"{comparison.title} {by}, {comparison.before} against {comparison.after}"
    return Table(caption, header, cells)


def _means(c: PairedComparison) -> tuple[str, str]:
    return spread(c.before_mean, c.before_std), spread(c.after_mean, c.after_std)


def _ends(comparison: Comparison) -> tuple[str, ...]:
    return tuple(name[:1].upper() + name[1:] for name in (comparison.before, comparison.after))


def _interval(c: PairedComparison) -> str:
    return "" if c.ci_low is None else f"[{c.ci_low:+.3f}, {c.ci_high:+.3f}]"


def _test(statistic: str, p: float | None, none: str) -> str:
    return none if p is None else f"{statistic}, {p_text(p)}"
