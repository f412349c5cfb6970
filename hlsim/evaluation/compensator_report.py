"""A comparison of compensators as JSON, Markdown and one HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hlsim.data.files import Whole
from hlsim.evaluation.comparison import Comparison, p_text
from hlsim.evaluation.compensator_result import HARD
from hlsim.evaluation.gain_curves import gain_section
from hlsim.evaluation.page import Section, Table, render_page
from hlsim.evaluation.report import HaspiReport
from hlsim.evaluation.report_figures import report_pictures
from hlsim.evaluation.report_text import GAIN_SENTENCE, markdown_table
from hlsim.evaluation.significance import PairedComparison

FILES = ("compensators.json", "compensators.md", "compensators.html")

_CHANGES = ("Change", "n", "Δ [95 % interval]", "Paired t", "Wilcoxon", "d")

_GROUPS = {
    "clean": "Clean speech",
    "noisy": "Speech in noise",
    "hard": f"Where unaided HASPI is under {HARD:g}, clean and noisy",
}


def write_compensators(
    result: Mapping[str, Any], reports: Mapping[str, HaspiReport], out: str | Path
) -> None:
    """Write what ``compensator_result`` made, with ``gain_curves`` in it, into a folder; each file whole or not at all.

    Raises:
        ValueError: a file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    title, lead = "Compensators", _lead(result)
    sections = _sections(result, reports)
    contents = {
        "compensators.json": json.dumps(result, indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        "compensators.md": _markdown(title, lead, sections),
        "compensators.html": render_page(title, sections, lead),
    }
    for name in FILES:
        with Whole(Path(out) / name) as file:
            file.write(contents[name])
            file.keep()


def _lead(result: Mapping[str, Any]) -> str:
    levels = ", ".join(f"{level:g}" for level in result["levels"])
    return (
        f"{result['items']} items of {result['seconds']:g} s, {len(result['ears'])} ears in turn, speech at {levels} "
        f"dB SPL in turn, seed {result['seed']}: {', '.join(result['limits'])}. HASPI v2 and HASQI v2 are pyclarity's, "
        "against the clean speech, in noise too."
    )


def _sections(result: Mapping[str, Any], reports: Mapping[str, HaspiReport]) -> list[Section]:
    sections = []
    for name, report in reports.items():
        tables = [main_table(result, name), _tests_table(report)]
        sections.append(Section(_GROUPS[name], [GAIN_SENTENCE] if name == "clean" else [], tables))
    sections += [
        Section("As loud as a normal ear hears it?", [_LOUDNESS], _each(result, _loudness_table)),
        Section(
            "By degree of loss",
            [_HASQI],
            [
                *_each(result, _severity_table),
                *(_severity_tests(reports[group], group) for group in ("clean", "noisy") if group in reports),
            ],
        ),
        Section("The surrogate gap", [_GAP.format(**result)], [_gap_table(result)]),
        Section("Does any output pass the limit?", (), [_peak_table(result)]),
        gain_section(result["gain_curves"]),
    ]
    for name in ("clean", "noisy"):
        if name in reports:
            pictures = report_pictures(reports[name])
            sections.append(Section(f"Pictures: {_GROUPS[name].lower()}", pictures=pictures))
    if result["failures"]:
        sections.append(Section("Failures", ["Items that count in no table."], [_failure_table(result)]))
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    sections.append(Section("How the figures were made", [*_NOTES, f"{versions}."]))
    return sections


def main_table(result: Mapping[str, Any], group: str) -> Table:
    """A row a condition: scores, levels, and how far what is heard lies from what a normal ear hears."""
    rows = [
        (
            name,
            str(own["n"]),
            _spread(own, "haspi"),
            _spread(own, "hasqi"),
            f"{own['level_mean']:.1f}",
            f"{own['peak_max']:.1f}",
            f"{own['heard_off']:+.1f}",
            f"{own['heard_off_abs']:.1f}",
            f"{own['band_error_mean']:.1f}",
        )
        for name, own in result["groups"][group]["conditions"].items()
    ]
    header = (
        "What the ear is given",
        "n",
        "HASPI (mean ± std)",
        "HASQI (mean ± std)",
        "Level (dB SPL)",
        "Highest peak (dB SPL)",
        "Heard, against normal (dB)",
        "the same, mean absolute",
        "Bands, against normal (dB)",
    )
    return Table(f"{_GROUPS[group]}: scores, output and what is heard", header, rows)


def _tests_table(report: HaspiReport) -> Table:
    """Each compensator against no aid and the prescription, and the latter against the former."""
    rows = [
        (*_changes(f"{c.title}: {c.before} to {c.after}", c.overall, c.p_t_holm, c.p_w_holm), _ears(c))
        for c in _told(report)
    ]
    header = (*_CHANGES, "t over means of ears")
    return Table("Paired tests, p adjusted by Holm within each measure", header, rows)


def _severity_tests(report: HaspiReport, group: str) -> Table:
    rows = [
        _changes(f"{severity}, {c.title}: {c.before} to {c.after}", own, own.p_t, own.p_w)
        for c in _told(report)
        for severity, own in c.by_severity.items()
    ]
    return Table(f"{_GROUPS[group]}: paired tests by degree of loss, p not adjusted", _CHANGES, rows)


def _told(report: HaspiReport) -> list[Comparison]:
    return [c for c in report.comparisons if c.before in report.conditions[:2]]


def _changes(name: str, c: PairedComparison, p_t: float | None, p_w: float | None) -> tuple[str, ...]:
    interval = "" if c.ci_low is None else f" [{c.ci_low:+.3f}, {c.ci_high:+.3f}]"
    d = "n/a" if c.cohens_d is None else f"{c.cohens_d:+.2f}"
    tests = (_test("t", c.t, p_t, "+.2f"), _test("W", c.w, p_w, ".1f"))
    return (name, str(c.n), f"{c.delta:+.3f}{interval}", *tests, d)


def _loudness_table(result: Mapping[str, Any], group: str) -> Table:
    conditions = result["groups"][group]["conditions"]
    levels = list(next(iter(conditions.values()))["by_level"])
    rows = []
    for name, own in conditions.items():
        cells = [own["by_level"][level] for level in levels]
        rows.append((name, *(f"{cell['heard_off_abs']:.1f} ({cell['heard_off']:+.1f})" for cell in cells)))
        if group == "noisy":
            text = [f"{cell['heard_off_clean_abs']:.1f} ({cell['heard_off_clean']:+.1f})" for cell in cells]
            rows.append((f"{name}, against the speech in it", *text))
    header = ("What the ear is given", *(f"Speech at {level} dB SPL" for level in levels))
    return Table(f"{_GROUPS[group]}: mean absolute difference in dB (mean difference)", header, rows)


def _severity_table(result: Mapping[str, Any], group: str) -> Table:
    conditions = result["groups"][group]["conditions"]
    first = next(iter(conditions.values()))
    rows = []
    for severity in first["by_severity"]:
        unaided = first["by_severity"][severity]
        for name, condition in conditions.items():
            own = condition["by_severity"][severity]
            rows.append(
                (
                    f"{severity}, {name}",
                    str(own["n"]),
                    _spread(own, "haspi"),
                    _spread(own, "hasqi"),
                    f"{own['haspi_mean'] - unaided['haspi_mean']:+.3f}",
                    f"{own['hasqi_mean'] - unaided['hasqi_mean']:+.3f}",
                    f"{own['heard_off_abs']:.1f}",
                    f"{own['band_error_mean']:.1f}",
                )
            )
    header = (
        "Degree of loss",
        "n",
        "HASPI (mean ± std)",
        "HASQI (mean ± std)",
        "HASPI over unaided",
        "HASQI over unaided",
        "Heard, mean absolute (dB)",
        "Bands (dB)",
    )
    return Table(f"{_GROUPS[group]}, by degree of loss", header, rows)


def _gap_table(result: Mapping[str, Any]) -> Table:
    rows = []
    for group, conditions in result["gap"].items():
        for name, own in conditions.items():
            losses = [f"{own[f'loss_{simulator}']:.2f}" for simulator in ("neuro", "msbg", "pyclarity")]
            gaps = [own["neuro_to_msbg"], own["neuro_to_pyclarity"], own["msbg_to_pyclarity"]]
            row = (f"{group}, {name}", *losses, *(f"{100 * part:+.1f} %" for part in gaps))
            rows.append((*row, f"{100 * own['item_median']:.1f} %"))
    header = (
        "What the ear is given",
        "Neuro-MSBG",
        "exact MSBG",
        "pyclarity",
        "Neuro to exact",
        "Neuro to pyclarity",
        "exact to pyclarity",
        "Neuro to pyclarity, median item",
    )
    return Table("Mean loss in dB on the same utterances, and relative differences", header, rows)


def _peak_table(result: Mapping[str, Any]) -> Table:
    rows = [
        (
            name,
            "none" if own["limit"] is None else f"{own['limit']:g}",
            f"{own['highest']:.2f}",
            "n/a" if own["over"] is None else f"{own['over']} of {own['n']}",
        )
        for name, own in result["peaks"].items()
    ]
    header = ("What the ear is given", "Limit (dB SPL)", "Highest peak (dB SPL)", "Outputs beyond")
    return Table("Peaks of all outputs, a sample of 1.0 being 94 dB SPL", header, rows)


def _failure_table(result: Mapping[str, Any]) -> Table:
    rows = [(str(f["item"]), f["compensator"], f["name"], f["reason"]) for f in result["failures"]]
    return Table("Outputs that could not be judged", ("Item", "Compensator", "Ear", "Reason"), rows)


_LOUDNESS = (
    "RMS level after the exact MSBG, less what a normal ear hears there of the same input. In noise that input has the "
    "noise in it: what takes noise away is held against the speech alone as well."
)
_HASQI = (
    "HASQI's own reference is the clean speech amplified by NAL-R, so that NAL-R is its ceiling: what is nearer to "
    "normal hearing than NAL-R loses HASQI by it."
)
_GAP = (
    "The loss is that of HearingLossLoss with the criterion bands, of the outputs above, with the Neuro-MSBG "
    "{simulator}. A compensator that has learned to fool the network has a lower loss under it than under the others."
)
_NOTES = (
    "Bands: median absolute difference between the levels of 24 ERB-wide bands in frames of 32 ms of what the impaired "
    "ear hears and what a normal ear hears of the clean speech, both by the exact MSBG, where the latter is audible; "
    "mean over items.",
    "Holm's family is every pair of conditions by one measure in one group. d is the mean difference over the deviation "
    "of the differences. Intervals are percentiles of 9999 bootstrap resamples of the items. Several items share an ear: "
    "the last column of the tests is a t-test of the means of each ear, p not adjusted.",
)


def _each(result: Mapping[str, Any], table: Any) -> list[Table]:
    return [table(result, group) for group in ("clean", "noisy") if group in result["groups"]]


def _ears(c: Comparison) -> str:
    return "n/a" if c.listeners is None else _test("t", c.listeners.t, c.listeners.p_t, "+.2f")


def _test(name: str, statistic: float | None, p: float | None, form: str) -> str:
    return "n/a" if statistic is None or p is None else f"{name} = {statistic:{form}}, {p_text(p)}"


def _spread(own: Mapping[str, Any], name: str) -> str:
    mean, deviation = own[f"{name}_mean"], own[f"{name}_std"]
    return f"{mean:.3f}" if deviation is None else f"{mean:.3f} ± {deviation:.3f}"


def _markdown(title: str, lead: str, sections: list[Section]) -> str:
    """The page without its pictures."""
    blocks = [f"# {title}", lead]
    for section in sections:
        if section.paragraphs or section.tables:
            blocks += [f"## {section.title}", *section.paragraphs]
            blocks += [f"**{table.caption}**\n\n{markdown_table(table)}" for table in section.tables]
    return "\n\n".join(blocks) + "\n"
