"""A report as tables of text, in Markdown and in LaTeX; the page takes the same tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.comparison import Comparison, p_text
from hlsim.evaluation.statistics import MixedModel, PairedComparison
from hlsim.metrics.registry import MEASURES
from hlsim.report.page import Table

if TYPE_CHECKING:
    from hlsim.evaluation.scores import HaspiReport

GAIN_SENTENCE = (
    "HASPI rewards any gain, however loud, so the output level stands beside it: a higher score at a much higher level "
    "may be no more than amplification."
)

_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "Δ": r"$\Delta$",
    "<": "$<$",
    ">": "$>$",
}


def opening(report: HaspiReport) -> list[str]:
    """What is to be known before the figures: that HASPI rewards gain, where it is among the measures."""
    return [GAIN_SENTENCE] if "haspi" in report.measures else []


def title(report: HaspiReport) -> str:
    """The report's title: "HASPI before and after", or the measures and conditions."""
    if list(report.conditions) == ["before", "after"]:
        return f"{_titles(report)} before and after"
    return f"{_titles(report)}: {', '.join(report.conditions)}"


def paper_table(comparison: Comparison) -> Table:
    """The paper's last table, with the interval and the levels."""
    c = comparison.overall
    louder = comparison.level_after_mean - comparison.level_before_mean
    name = comparison.title
    rows = [
        (
            f"{name} (mean ± std)",
            _spread(c.before_mean, c.before_std),
            _spread(c.after_mean, c.after_std),
            f"{c.delta:+.3f}",
        ),
        ("95 % interval of Δ", "", "", _interval(c) or "not defined"),
        ("t-test (paired)", "", "", _test("t", c.t, c.p_t, "+.3f") or "not defined"),
        ("Wilcoxon signed-rank", "", "", _test("W", c.w, c.p_w, ".1f") or "not defined"),
        ("Cohen's d (paired)", "", "", "not defined" if c.cohens_d is None else f"d = {c.cohens_d:+.3f}"),
        (
            "Level (dB SPL, mean)",
            f"{comparison.level_before_mean:.1f}",
            f"{comparison.level_after_mean:.1f}",
            f"{louder:+.1f}",
        ),
    ]
    header = ("Metric", _capital(comparison.before), _capital(comparison.after), "Change (Δ)")
    return Table(f"{name}, {comparison.before} against {comparison.after}, {c.n} items", header, rows)


def severity_table(comparison: Comparison) -> Table:
    """A row a degree of loss."""
    rows = [
        (f"{name} loss" if name != "none" else "no loss", *_row(c))
        for name, c in comparison.by_severity.items()
    ]
    return Table(
        f"{comparison.title} by degree of loss, {comparison.before} against {comparison.after}",
        ("Degree of loss", *_columns(comparison)),
        rows,
    )


def listener_table(comparison: Comparison) -> Table | None:
    """Items, listener means and the mixed model side by side; None where listeners are not named."""
    if comparison.listeners is None:
        return None
    rows = [("items", *_row(comparison.overall)), ("listener means", *_row(comparison.listeners))]
    model = comparison.mixed
    if isinstance(model, MixedModel):
        change = f"{model.delta:+.3f} [{model.ci_low:+.3f}, {model.ci_high:+.3f}]"
        test = f"z = {model.z:+.3f}, {p_text(model.p)}"
        rows.append(
            (f"mixed model ({model.listeners} listeners)", str(model.n), "", "", change, test, "", "")
        )
    return Table(
        f"{comparison.title} with items nested in listeners, {comparison.before} against {comparison.after}",
        ("Unit", *_columns(comparison)),
        rows,
    )


def comparisons_table(report: HaspiReport) -> Table:
    """A row a pair of conditions and measure, with p values adjusted by Holm."""
    rows = []
    for c in report.comparisons:
        o = c.overall
        rows.append(
            (
                f"{c.title}: {c.before} to {c.after}",
                str(o.n),
                f"{o.before_mean:.3f}",
                f"{o.after_mean:.3f}",
                f"{o.delta:+.3f}" + (f" {_interval(o)}" if _interval(o) else ""),
                "n/a" if c.p_t_holm is None else p_text(c.p_t_holm),
                "n/a" if c.p_w_holm is None else p_text(c.p_w_holm),
                "n/a" if o.cohens_d is None else f"{o.cohens_d:+.3f}",
                f"{c.level_after_mean - c.level_before_mean:+.1f}",
            )
        )
    header = (
        "Comparison",
        "n",
        "From",
        "To",
        "Δ [95 % interval]",
        "t-test, Holm",
        "Wilcoxon, Holm",
        "d",
        "Level change (dB)",
    )
    return Table("All comparisons, p adjusted by Holm within each measure", header, rows)


def failure_table(report: HaspiReport) -> Table:
    """The scores that could not be made, and why."""
    rows = [(f.file, f.condition, MEASURES[f.measure].title, f.reason) for f in report.failures]
    return Table("Scores that could not be made", ("Item", "Condition", "Measure", "Reason"), rows)


def notes(report: HaspiReport) -> list[str]:
    """How the figures were made, a sentence or two each."""
    degrees = [item.audiogram.severity for item in report.items]
    ears = ", ".join(f"{name} {degrees.count(name)}" for name in SEVERITIES if name in degrees)
    listeners = len({item.listener for item in report.items if item.listener})
    zeros, n = report.comparison.zeros, report.comparison.n
    lines = [
        f"Degrees of hearing loss: {ears}. "
        + (f"Listeners: {listeners}. " if listeners else "")
        + f"Clean speech at {report.clean_level_mean:.1f} dB SPL on average. {_full_scale(report)}",
        "Changes are after minus before, so a gain is positive. Deviations with n - 1; tests two-sided; "
        "d is the mean difference over the deviation of the differences, t / sqrt(n). "
        "Intervals are percentiles of 9999 bootstrap resamples, expanded for few items (Hesterberg 2015); under six "
        "there is none.",
        f'Wilcoxon: zero differences dropped ({zeros} of {n}; scipy\'s zero_method "wilcox"); W is the smaller rank sum.',
        "Tests and intervals take the items as independent; where several share a talker or a listener, p is too small "
        "and the interval too narrow.",
    ]
    if isinstance(report.headline.mixed, str):
        lines.append(f"No mixed model: {report.headline.mixed}.")
    else:
        lines.append(
            "Mixed model: difference = mean + listener's deviation + residual, by REML, Wald test"
            + (f" ({report.headline.mixed.note})." if report.headline.mixed.note else ".")
        )
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    lines.append(f"Numpy's seed {report.seed}; each item's own is in report.json. {versions}.")
    return lines


def markdown(report: HaspiReport) -> str:
    """What ``report.md`` says: the paper's table first, then the rest."""
    headline = report.headline
    blocks = [
        f"# {title(report)}",
        " ".join([f"{report.comparison.n} items.", *opening(report)]),
        markdown_table(paper_table(headline)),
        f"**What the figures show.** {headline.in_words()}",
        "![HASPI and level, before against after](before-after.png)".replace("HASPI", headline.title),
    ]
    tables = [severity_table(headline), listener_table(headline)]
    if len(report.comparisons) > 1:
        tables.append(comparisons_table(report))
    if report.failures:
        tables.append(failure_table(report))
    blocks += [f"**{table.caption}**\n\n{markdown_table(table)}" for table in tables if table is not None]
    if len(report.comparisons) > 1:
        blocks.append("\n".join(f"- {c.in_short()}" for c in report.comparisons if c is not headline))
    lines = [f"- {note}" for note in notes(report)]
    lines += [
        f"- {name}: {value}" for name, value in report.extra.items() if isinstance(value, str | int | float)
    ]
    return "\n\n".join([*blocks, "\n".join(lines)]) + "\n"


def latex(report: HaspiReport) -> str:
    """What ``report.tex`` says: tables for ``\\input``, which need the package booktabs."""
    tables = [paper_table(report.headline), severity_table(report.headline), listener_table(report.headline)]
    if len(report.comparisons) > 1:
        tables.append(comparisons_table(report))
    comments = [f"% {line}" for line in (f"{title(report)}. Needs \\usepackage{{booktabs}}.", *notes(report))]
    return "\n".join(comments) + "\n" + "\n".join(_latex(table) for table in tables if table is not None)


def _titles(report: HaspiReport) -> str:
    return ", ".join(MEASURES[name].title for name in report.measures)


def _columns(comparison: Comparison) -> tuple[str, ...]:
    ends = (_capital(comparison.before), _capital(comparison.after))
    return ("n", *ends, "Δ [95 % interval]", "t-test (paired)", "Wilcoxon", "d")


def _row(c: PairedComparison) -> tuple[str, ...]:
    return (
        str(c.n),
        _spread(c.before_mean, c.before_std),
        _spread(c.after_mean, c.after_std),
        f"{c.delta:+.3f}" + (f" {_interval(c)}" if _interval(c) else ""),
        _test("t", c.t, c.p_t, "+.3f") or "n/a",
        _test("W", c.w, c.p_w, ".1f") or "n/a",
        "n/a" if c.cohens_d is None else f"{c.cohens_d:+.3f}",
    )


def _full_scale(report: HaspiReport) -> str:
    if report.full_scale_spl is not None:
        return f"A signal of RMS 1.0 is taken as {report.full_scale_spl:g} dB SPL."
    scales = [item.full_scale_spl for item in report.items]
    return f"A signal of RMS 1.0 is taken as {min(scales):.1f} to {max(scales):.1f} dB SPL, by item."


def _spread(mean: float, deviation: float | None) -> str:
    return f"{mean:.3f}" if deviation is None else f"{mean:.3f} ± {deviation:.3f}"


def _interval(c: PairedComparison) -> str:
    return "" if c.ci_low is None else f"[{c.ci_low:+.3f}, {c.ci_high:+.3f}]"


def _test(name: str, statistic: float | None, p: float | None, form: str) -> str:
    return "" if statistic is None or p is None else f"{name} = {statistic:{form}}, {p_text(p)}"


def _capital(name: str) -> str:
    return name[:1].upper() + name[1:]


def markdown_table(table: Table) -> str:
    """A table as Markdown writes it."""
    lines = [table.header, ["---"] * len(table.header), *table.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _latex(table: Table) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(_LATEX.get(c, c) for c in cell) for cell in cells) + r" \\"

    caption = "".join(_LATEX.get(c, c) for c in table.caption)
    body = "\n".join(line(row) for row in table.rows)
    columns = "l" + "r" * (len(table.header) - 1)
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{caption}.}}\n\\begin{{tabular}}{{{columns}}}\n"
        f"\\toprule\n{line(table.header)}\n\\midrule\n{body}\n\\bottomrule\n\\end{{tabular}}\n\\end{{table}}\n"
    )
