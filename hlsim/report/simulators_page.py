"""The page of ``evaluate-simulator``, which presents what ``evaluation.simulators`` computes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.simulators import agreement
from hlsim.extras import install_command, is_installed
from hlsim.report.page import Page, Section
from hlsim.report.players import listening_sections
from hlsim.report.tables import (
    Columns,
    comparison_table,
    detail_section,
    fact_tables,
    statistic,
    summary_table,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def _agreement(score: str, statistic: str) -> Callable[[DataFrame], float]:
    """Return a function that computes a statistic of ``agreement`` from the rows of a simulator.

    Args:
        score: ``"stoi"`` or ``"pesq"``.
        statistic: ``"lcc"``, ``"srcc"`` or ``"mse"``.
    """
    return lambda rows: agreement(rows, score)[statistic]


_LISTEN = "The input, and the outputs of the teacher and of each simulator."

COLUMNS: Columns = {
    "n": (statistic("snr", "count"), "d"),
    "SNR median (dB)": (statistic("snr", "median"), ".1f"),
    "SNR worst tenth (dB)": (statistic("snr", "worst tenth"), ".1f"),
    "STOI LCC": (_agreement("stoi", "lcc"), ".4f"),
    "STOI SRCC": (_agreement("stoi", "srcc"), ".4f"),
    "STOI MSE": (_agreement("stoi", "mse"), ".5f"),
    "PESQ LCC": (_agreement("pesq", "lcc"), ".4f"),
    "PESQ SRCC": (_agreement("pesq", "srcc"), ".4f"),
    "PESQ MSE": (_agreement("pesq", "mse"), ".4f"),
    "RAW MSE": (statistic("raw_mse"), ".4f"),
    "Band error median (dB)": (statistic("band_error", "median"), ".2f"),
}
"""Columns of the tables by title: those of the paper's Table I, and others."""

_TREATMENTS = {
    "as-is": "Speech as it is",
    "louder": "20 dB louder",
    "nalr": "Amplified by NAL-R for the ear",
    "compressed": "Compressed 3:1",
    "compensated": "The output of a compensator",
}
"""Titles of the treatments of the input."""

_FACTS = {
    "severity": "By MSBG's degree of loss",
    "input_level": "By level before processing (dB SPL)",
    "speech": "Clean or noisy",
}
"""Titles of the tables for each fact of the items."""


def simulators_page(evaluation: Evaluation) -> Page:
    """Return the page of ``evaluate-simulator``: verdict, tables, sounds and details.

    Args:
        evaluation: Evaluation of ``evaluate_simulators``.

    >>> from hlsim import MSBG
    >>> from hlsim.evaluation.simulators import evaluate_simulators
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> speech, settings = EXAMPLE_FILE.parent, {"items": 1, "seconds": 1.0, "jobs": 1}
    >>> evaluation = evaluate_simulators(
    ...     {"exact": MSBG()}, speech=speech, audiograms="standard", **settings
    ... )
    >>> simulators_page(evaluation).verdict[:48]
    'Speech as it is: exact has a median SNR of 200.0'
    """
    sections: list[Section] = []
    details = []
    for treatment, group in evaluation.groups.items():
        title = _TREATMENTS[treatment]
        caption = "Simulators side by side"
        table = summary_table(caption, group.table, COLUMNS, first="Simulator")
        comparisons = []
        if group.comparisons:
            caption = "SNR compared with the first; p adjusted by Holm"
            comparisons.append(comparison_table(group.comparisons, caption))
        notes = [] if sections else evaluation.notes
        sections.append(Section(title, notes, [table, *comparisons]))
        details.append(Section(title, tables=fact_tables(group.table, COLUMNS, _FACTS)))
    sections += listening_sections(evaluation, _LISTEN)
    sections.append(detail_section(evaluation, details, [_about(evaluation)]))
    return Page("Simulators", _verdict(evaluation), sections)


def _teacher(evaluation: Evaluation) -> str:
    """Return words for the teacher in a sentence: its name, or "the exact MSBG"."""
    teacher = evaluation.settings["teacher"]
    return "the exact MSBG" if teacher == "msbg" else teacher


def _verdict(evaluation: Evaluation) -> str:
    """Return a sentence about the SNRs, in dB, of the simulators for the first treatment with any.

    It names the simulator with the highest median first, with its worst tenth, and then the medians
    of the others.
    """
    tables = {name: group.wide("snr") for name, group in evaluation.groups.items()}
    treatment = next(name for name, table in tables.items() if table.notna().any(axis=None))
    snr = tables[treatment].dropna(axis=1, how="all")
    medians = snr.median().sort_values(ascending=False)
    best = snr[medians.index[0]].dropna()
    other_medians = ", ".join(
        f"{name} {median:.1f} dB" for name, median in medians.iloc[1:].items()
    )
    return (
        f"{_TREATMENTS[treatment]}: {best.name} has a median SNR of "
        f"{best.median():.1f} dB (worst tenth {best.quantile(0.1):.1f} dB, {len(best)} items) "
        f"against {_teacher(evaluation)}{other_medians and f'; the others: {other_medians}'}."
    )


def _about(evaluation: Evaluation) -> str:
    """Return a text about the items and the columns of the tables, for the section "Details"."""
    settings = evaluation.settings
    levels = ", ".join(f"{level:g}" for level in settings["levels"])
    text = (
        f"Compared with {_teacher(evaluation)}: {settings['items']} items of "
        f"{settings['seconds']:g} s at {levels} dB SPL in turn. RAW MSE is that of waveforms "
        "scaled to unit power of the teacher's output. STOI and PESQ rate teacher and simulator "
        "against the clean speech; the tables show how well both agree: correlations (LCC, SRCC) "
        "and mean squared difference. PESQ means little where both are nearly inaudible."
    )
    if not is_installed("pesq"):
        text += f" PESQ was left out; to add it, {install_command('pesq')} and run again."
    return text
