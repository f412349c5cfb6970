"""A comparison of compensators as JSON, Markdown and one HTML page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hlsim.evaluation.gain_curves import gain_section
from hlsim.evaluation.scores import HaspiReport
from hlsim.evaluation.steadiness import steadiness_sections
from hlsim.files import write_whole
from hlsim.report.compensator_tables import (
    GROUPS,
    failure_table,
    gap_table,
    loudness_table,
    main_table,
    peak_table,
    severity_table,
    severity_tests,
    tests_table,
)
from hlsim.report.haspi_pictures import report_pictures
from hlsim.report.haspi_text import GAIN_SENTENCE, markdown_table
from hlsim.report.page import Section, Table, render_page

FILES = ("compensators.json", "compensators.md", "compensators.html")


def write_compensators(
    result: Mapping[str, Any], reports: Mapping[str, HaspiReport], out: str | Path
) -> None:
    """Write ``compensator_result`` with ``gain_curves``, ``steady_tones``, ``shifts`` and ``notes`` in it into a folder.

    Each file whole or not at all.

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
        write_whole(Path(out) / name, contents[name])


def _lead(result: Mapping[str, Any]) -> str:
    levels = ", ".join(f"{level:g}" for level in result["levels"])
    # few items do not come to every ear
    ears = len({own["name"] for own in (*result["rows"], *result["failures"])})
    about = (
        f"{result['items']} items of {result['seconds']:g} s, {ears} ears in turn, speech at {levels} "
        f"dB SPL in turn, seed {result['seed']}: {', '.join(result['limits'])}. HASPI v2 and HASQI v2 are pyclarity's, "
        "against the clean speech, in noise too."
    )
    return " ".join([*result["notes"], about])


def _sections(result: Mapping[str, Any], reports: Mapping[str, HaspiReport]) -> list[Section]:
    sections = []
    for name, report in reports.items():
        tables = [main_table(result, name), tests_table(report)]
        sections.append(Section(GROUPS[name], [GAIN_SENTENCE] if name == "clean" else [], tables))
    sections += [
        Section("As loud as a normal ear hears it?", [_LOUDNESS], _each(result, loudness_table)),
        Section(
            "By degree of loss",
            [_HASQI],
            [
                *_each(result, severity_table),
                *(severity_tests(reports[group], group) for group in ("clean", "noisy") if group in reports),
            ],
        ),
        Section("The surrogate gap", [_GAP.format(**result)], [gap_table(result)]),
        Section("Does any output pass the limit?", (), [peak_table(result)]),
        gain_section(result["gain_curves"]),
        *steadiness_sections(result["steady_tones"], result["shifts"]),
    ]
    for name in ("clean", "noisy"):
        if name in reports:
            pictures = report_pictures(reports[name])
            sections.append(Section(f"Pictures: {GROUPS[name].lower()}", pictures=pictures))
    if result["failures"]:
        sections.append(Section("Failures", ["Items that count in no table."], [failure_table(result)]))
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    sections.append(Section("How the figures were made", [*_NOTES, f"{versions}."]))
    return sections


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
    "of the differences. Intervals are percentiles of 9999 bootstrap resamples of the items, expanded for few "
    "(Hesterberg 2015). Several items share an ear, which makes p too small and intervals too narrow: the last column of "
    "the tests is a t-test of the means of each ear, p not adjusted. Both ears of a person count as two.",
)


def _each(result: Mapping[str, Any], table: Any) -> list[Table]:
    return [table(result, group) for group in ("clean", "noisy") if group in result["groups"]]


def _markdown(title: str, lead: str, sections: list[Section]) -> str:
    """The page without its pictures."""
    blocks = [f"# {title}", lead]
    for section in sections:
        if section.paragraphs or section.tables:
            blocks += [f"## {section.title}", *section.paragraphs]
            blocks += [f"**{table.caption}**\n\n{markdown_table(table)}" for table in section.tables]
    return "\n\n".join(blocks) + "\n"
