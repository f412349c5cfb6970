"""Tables and sections that all studies of scores share: conditions, comparisons, failures, items."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.comparison import Comparison, p_text
from hlsim.evaluation.measures import MEASURES, title_of
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.statistics import RESAMPLES, PairedComparison
from hlsim.report.page import Section, Table

if TYPE_CHECKING:
    from pandas import DataFrame

GAIN_NOTE = (
    "HASPI rewards any gain, however loud: compare conditions at equal level, and read the level beside "
    "every score."
)

STATISTICS_NOTES = (
    "A change is the later condition minus the earlier one. Standard deviations divide by n - 1; the "
    "tests are two-sided; d is the mean change over the standard deviation of the changes. Intervals "
    f"are percentiles of {RESAMPLES} bootstrap resamples, expanded for few items (Hesterberg 2015); "
    "there is none for fewer than six.",
    "Wilcoxon's test leaves out items that did not change; W is the smaller rank sum.",
)


def number(value: float | None, form: str, none: str = "n/a") -> str:
    """Format a number, or return ``none`` if there is none."""
    return none if value is None or math.isnan(value) else f"{value:{form}}"


def spread(mean: float | None, deviation: float | None) -> str:
    """Format a mean and its standard deviation, if there is one."""
    if deviation is None or math.isnan(deviation):
        return number(mean, ".3f")
    return f"{mean:.3f} ± {deviation:.3f}"


def inner(title: str) -> str:
    """Return a title for use within a sentence."""
    return title[:1].lower() + title[1:]


def loss_name(severity: str) -> str:
    """Return a degree of loss in words."""
    return "no loss" if severity == "none" else f"{severity} loss"


def mean_verdict(evaluation: Evaluation, measure: str) -> str:
    """Say in one sentence what a single condition scores."""
    scored = evaluation.table.dropna(subset=[measure])
    mean, level = float(scored[measure].mean()), float(scored["level"].mean())
    (name,) = evaluation.names
    return (
        f"{title_of(measure)} of the condition {name} is {mean:.3f} on average ({len(scored)} items, "
        f"at {level:.1f} dB SPL)."
    )


def conditions_table(evaluation: Evaluation, columns: Sequence[str]) -> Table:
    """Return mean scores and levels, one row per condition."""
    groups = dict(list(evaluation.table.groupby("condition")))
    rows = []
    for name in evaluation.names:
        part = groups[name]
        row = {"Condition": name, "n": str(int(part[columns[0]].count()))}
        for column in columns:
            row[f"{title_of(column)} (mean ± std)"] = spread(
                part[column].mean(), part[column].std()
            )
        rows.append({**row, "Level (dB SPL)": number(part["level"].mean(), ".1f")})
    return Table.of("Means of all items", rows)


def headline_table(c: Comparison) -> Table:
    """Return the two conditions of a comparison with all its statistics."""
    cells = paired_cells(c.overall, c.p_t, c.p_w)
    rows = [
        (f"{c.title} (mean ± std)", *_means(c.overall), f"{c.overall.delta:+.3f}"),
        ("95 % interval of the change", "", "", _interval(c.overall) or "not defined"),
        ("t-test (paired)", "", "", cells["t-test (paired)"]),
        ("Wilcoxon signed-rank", "", "", cells["Wilcoxon"]),
        ("Cohen's d (paired)", "", "", cells["d"]),
        (
            "Level (dB SPL, mean)",
            number(c.level_before_mean, ".1f"),
            number(c.level_after_mean, ".1f"),
            number(c.level_change, "+.1f"),
        ),
    ]
    planned = ", planned comparison" if c.planned else ""
    caption = f"{c.title}, {c.before} against {c.after}, {c.overall.n} items{planned}"
    return Table(caption, ("", c.before, c.after, "Change"), rows)


def severity_table(c: Comparison) -> Table:
    """Return a comparison by degree of loss; p values are not adjusted."""
    rows = {loss_name(name): part for name, part in c.by_severity.items()}
    return _paired_table(c, "by degree of loss", "Degree of loss", rows)


def unit_table(c: Comparison) -> Table | None:
    """Return items and means of units side by side; None if units are not known."""
    if c.unit_means is None:
        return None
    rows = {"items": c.overall, f"{c.unit} means": c.unit_means}
    return _paired_table(c, f"with items nested in {c.unit}s, p not adjusted", "Unit", rows)


def comparisons_table(comparisons: Sequence[Comparison]) -> Table:
    """Return one row per comparison, with the p values that the sentences state."""
    rows = []
    for c in comparisons:
        row = {
            "Comparison": comparison_name(c) + (" (planned)" if c.planned else ""),
            "n": str(c.overall.n),
            "From": f"{c.overall.before_mean:.3f}",
            "To": f"{c.overall.after_mean:.3f}",
            **paired_cells(c.overall, c.p_t, c.p_w),
        }
        if not math.isnan(c.level_change):
            row["Level change (dB)"] = f"{c.level_change:+.1f}"
        rows.append(row)
    caption = "Comparisons"
    if len(comparisons) > 1:
        caption += "; p adjusted by Holm within each measure"
        caption += ", but for a planned one" if any(c.planned for c in comparisons) else ""
    return Table.of(caption, rows)


def comparison_name(c: Comparison) -> str:
    """Return measure and conditions of a comparison."""
    return f"{c.title}: {c.before} to {c.after}"


def paired_cells(
    c: PairedComparison, p_t: float | None, p_w: float | None, digits: int = 3
) -> dict[str, str]:
    """Return change and interval, both tests with the given p values, and d."""
    return {
        "Change [95 % interval]": f"{c.delta:+.3f} {_interval(c)}".rstrip(),
        "t-test (paired)": _test(f"t = {number(c.t, f'+.{digits}f')}", p_t),
        "Wilcoxon": _test(f"W = {number(c.w, '.1f')}", p_w),
        "d": number(c.cohens_d, f"+.{digits}f"),
    }


def comparison_sections(evaluation: Evaluation) -> list[Section]:
    """Return the details of all comparisons: further pairs, degrees of loss, units."""
    headline = evaluation.headline
    if headline is None:
        return []
    sections = []
    if len(evaluation.comparisons) > 1:
        table = comparisons_table(evaluation.comparisons)
        sections.append(Section("All comparisons", [_plan(headline)], [table]))
    if len(headline.by_severity) > 1:
        sections.append(Section("By degree of loss", tables=[severity_table(headline)]))
    nested = unit_table(headline)
    if nested is not None:
        sections.append(Section(f"Items and {headline.unit}s", tables=[nested]))
    return sections


def _plan(headline: Comparison) -> str:
    if not headline.planned:
        return ""
    return (
        f"The comparison of {headline.before} with {headline.after} by {headline.title} was planned "
        "before the scores were known; its p values are not adjusted, here and everywhere on this page."
    )


def failure_section(failures: DataFrame, condition: str = "Condition") -> Section | None:
    """List what could not be scored, with the reasons; None if there is nothing."""
    rows = failures[["name", "condition", "failure"]].to_numpy().tolist()
    if not rows:
        return None
    table = Table("Outputs without all scores", ("Item", condition, "Reason"), rows)
    return Section("Failures", ["The other items were scored."], [table])


def items_table(evaluation: Evaluation, columns: Sequence[str]) -> Table:
    """Return scores and level of every item under every condition."""
    rows = []
    for _, part in evaluation.table.groupby("item", sort=False):
        by_condition = part.set_index("condition")
        first = part.iloc[0]
        row = {"Item": first["name"], "Loss": first["severity"]}
        for name in evaluation.names:
            found = by_condition.loc[name]
            for column in columns:
                row[f"{title_of(column)}, {name}"] = number(found[column], ".3f")
            row[f"dB SPL, {name}"] = number(found["level"], ".1f")
        rows.append(row)
    return Table.of("Scores and levels of every item", rows)


def scored_by(evaluation: Evaluation) -> str:
    """Say what computed HASPI and HASQI."""
    versions = evaluation.versions
    named = [MEASURES[name].title for name in ("haspi", "hasqi") if name in _names(evaluation)]
    if not named:
        return ""
    return (
        f"{' and '.join(named)} (version 2) are computed by hlsim {versions['hlsim']} as pyclarity 0.9 "
        "computes them."
    )


def severity_counts(evaluation: Evaluation) -> str:
    """Say how many items have which degree of loss."""
    severities = list(evaluation.table.drop_duplicates("item")["severity"])
    counts = [f"{name} {severities.count(name)}" for name in SEVERITIES if name in severities]
    return f"Degrees of hearing loss by item: {', '.join(counts)}."


def versions_text(versions: Mapping[str, Any]) -> str:
    """Return versions of packages as a sentence."""
    return f"Versions: {', '.join(f'{name} {version}' for name, version in versions.items())}."


def _names(evaluation: Evaluation) -> set[str]:
    return {measure.name for measure in evaluation.measures}


def _paired_table(c: Comparison, by: str, unit: str, rows: Mapping[str, PairedComparison]) -> Table:
    header = (unit, "n", c.before, c.after, *paired_cells(c.overall, None, None))
    cells = [
        (name, str(part.n), *_means(part), *paired_cells(part, part.p_t, part.p_w).values())
        for name, part in rows.items()
    ]
    return Table(f"{c.title} {by}, {c.before} against {c.after}", header, cells)


def _means(c: PairedComparison) -> tuple[str, str]:
    return spread(c.before_mean, c.before_std), spread(c.after_mean, c.after_std)


def _interval(c: PairedComparison) -> str:
    return "" if c.ci_low is None else f"[{c.ci_low:+.3f}, {c.ci_high:+.3f}]"


def _test(statistic: str, p: float | None) -> str:
    return "n/a" if p is None else f"{statistic}, {p_text(p)}"
