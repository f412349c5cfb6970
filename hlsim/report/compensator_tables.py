"""The tables of a comparison of compensators; what they are made from is in ``compensator_result``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hlsim.evaluation.comparison import Comparison, p_text
from hlsim.evaluation.compensator_result import HARD
from hlsim.evaluation.scores import HaspiReport
from hlsim.evaluation.statistics import PairedComparison
from hlsim.report.page import Table

_CHANGES = ("Change", "n", "Δ [95 % interval]", "Paired t", "Wilcoxon", "d")

GROUPS = {
    "clean": "Clean speech",
    "noisy": "Speech in noise",
    "hard": f"Where unaided HASPI is under {HARD:g}, clean and noisy",
}


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
    return Table(f"{GROUPS[group]}: scores, output and what is heard", header, rows)


def tests_table(report: HaspiReport) -> Table:
    """Each compensator against no aid and the prescription, and the latter against the former."""
    rows = [
        (*_changes(f"{c.title}: {c.before} to {c.after}", c.overall, c.p_t_holm, c.p_w_holm), _ears(c))
        for c in _told(report)
    ]
    header = (*_CHANGES, "t over means of ears")
    return Table("Paired tests, p adjusted by Holm within each measure", header, rows)


def severity_tests(report: HaspiReport, group: str) -> Table:
    """The same by degree of loss."""
    rows = [
        _changes(f"{severity}, {c.title}: {c.before} to {c.after}", own, own.p_t, own.p_w)
        for c in _told(report)
        for severity, own in c.by_severity.items()
    ]
    return Table(f"{GROUPS[group]}: paired tests by degree of loss, p not adjusted", _CHANGES, rows)


def _told(report: HaspiReport) -> list[Comparison]:
    return [c for c in report.comparisons if c.before in report.conditions[:2]]


def _changes(name: str, c: PairedComparison, p_t: float | None, p_w: float | None) -> tuple[str, ...]:
    interval = "" if c.ci_low is None else f" [{c.ci_low:+.3f}, {c.ci_high:+.3f}]"
    d = "n/a" if c.cohens_d is None else f"{c.cohens_d:+.2f}"
    tests = (_test("t", c.t, p_t, "+.2f"), _test("W", c.w, p_w, ".1f"))
    return (name, str(c.n), f"{c.delta:+.3f}{interval}", *tests, d)


def loudness_table(result: Mapping[str, Any], group: str) -> Table:
    """Level as heard against the normal ear's, a column an input level."""
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
    return Table(f"{GROUPS[group]}: mean absolute difference in dB (mean difference)", header, rows)


def severity_table(result: Mapping[str, Any], group: str) -> Table:
    """A row a degree of loss and condition."""
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
    return Table(f"{GROUPS[group]}, by degree of loss", header, rows)


def _share(value: float | None, form: str) -> str:
    return "n/a" if value is None else f"{100 * value:{form}} %"


def gap_table(result: Mapping[str, Any]) -> Table:
    """The loss under the three simulators."""
    rows = []
    for group, conditions in result["gap"].items():
        for name, own in conditions.items():
            losses = [f"{own[f'loss_{simulator}']:.2f}" for simulator in ("neuro", "msbg", "pyclarity")]
            gaps = [own["neuro_to_msbg"], own["neuro_to_pyclarity"], own["msbg_to_pyclarity"]]
            row = (f"{group}, {name}", *losses, *(_share(part, "+.1f") for part in gaps))
            rows.append((*row, _share(own["item_median"], ".1f")))
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


def peak_table(result: Mapping[str, Any]) -> Table:
    """Highest peaks, and outputs beyond the limit."""
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


def failure_table(result: Mapping[str, Any]) -> Table:
    """What could not be judged, and why."""
    rows = [(str(f["item"]), f["compensator"], f["name"], f["reason"]) for f in result["failures"]]
    return Table("Outputs that could not be judged", ("Item", "Compensator", "Ear", "Reason"), rows)


def _ears(c: Comparison) -> str:
    return "n/a" if c.listeners is None else _test("t", c.listeners.t, c.listeners.p_t, "+.2f")


def _test(name: str, statistic: float | None, p: float | None, form: str) -> str:
    return "n/a" if statistic is None or p is None else f"{name} = {statistic:{form}}, {p_text(p)}"


def _spread(own: Mapping[str, Any], name: str) -> str:
    mean, deviation = own[f"{name}_mean"], own[f"{name}_std"]
    return f"{mean:.3f}" if deviation is None else f"{mean:.3f} ± {deviation:.3f}"
