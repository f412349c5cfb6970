"""The page of ``evaluate-simulator``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.simulators import agreement, example_item
from hlsim.evaluation.study import Item
from hlsim.extras import install_command, is_installed
from hlsim.report import spectrograms
from hlsim.report.listening import players
from hlsim.report.page import Page, Picture, Section, write_page
from hlsim.report.plots import distribution_picture, scatter_picture
from hlsim.report.results import (
    Columns,
    comparison_table,
    detail_section,
    loss_name,
    of,
    ordered,
    parts,
    summary_table,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def _agreement(score: str, statistic: str) -> Callable[[DataFrame], float | None]:
    return lambda rows: agreement(rows, score)[statistic]


COLUMNS: Columns = {
    "n": (of("snr", "count"), "d"),
    "SNR median (dB)": (of("snr", "median"), ".1f"),
    "SNR worst tenth (dB)": (of("snr", "worst tenth"), ".1f"),
    "STOI LCC": (_agreement("stoi", "lcc"), ".4f"),
    "STOI SRCC": (_agreement("stoi", "srcc"), ".4f"),
    "STOI MSE": (_agreement("stoi", "mse"), ".5f"),
    "PESQ LCC": (_agreement("pesq", "lcc"), ".4f"),
    "PESQ SRCC": (_agreement("pesq", "srcc"), ".4f"),
    "PESQ MSE": (_agreement("pesq", "mse"), ".4f"),
    "RAW MSE": (of("raw_mse"), ".4f"),
    "Band error median (dB)": (of("band_error", "median"), ".2f"),
}
"""Columns of the tables by title: those of the paper's Table I, and others."""

_TREATMENTS = {
    "as-is": "Speech as it is",
    "louder": "20 dB louder",
    "nal-r": "Amplified by NAL-R for the ear",
    "compressed": "Compressed 3:1",
    "compensated": "The output of a compensator",
}


def write_simulators(evaluation: Evaluation, out: str | Path) -> Path:
    """Write what ``evaluate_simulators`` returns into a folder, as ``write_report`` does."""
    return write_page(simulators_page(evaluation), evaluation.to_dict(), out)


def simulators_page(evaluation: Evaluation, listen: int = 1) -> Page:
    """Return the page of simulators: verdict, side by side, sounds, pictures, details."""
    first = next(iter(evaluation.groups.values()))
    sections, details = [], []
    for treatment, group in evaluation.groups.items():
        tables = [
            summary_table("Simulators side by side", parts(group.table), COLUMNS, first="Simulator")
        ]
        if group.comparisons:
            tables.append(
                comparison_table(
                    group.comparisons, "SNR compared with the first; p adjusted by Holm"
                )
            )
        about = [_about(evaluation)] if group is first else []
        sections.append(Section(_TREATMENTS[treatment], about, tables))
        grouped = [
            summary_table(title, parts(group.table, fact), COLUMNS, first="Items")
            for fact, title in {
                "severity": "By degree of loss",
                "input_level": "By level (dB SPL)",
                "speech": "Clean or noisy",
            }.items()
            if group.table[fact].nunique() > 1
        ]
        details.append(Section(_TREATMENTS[treatment], tables=grouped))
    if listen:
        sections.append(_listening_section(evaluation))
    drawn = [
        Section(name, pictures=[*_pictures(rows)]) for name, rows in parts(first.table).items()
    ]
    sections += [Section("Pictures", sections=drawn), detail_section(evaluation, *details)]
    return Page("Simulators", _verdict(evaluation, first), sections)


def _teacher(evaluation: Evaluation) -> str:
    teacher: str = evaluation.settings["teacher"]
    return "the exact MSBG" if teacher == "msbg" else teacher


def _verdict(evaluation: Evaluation, first: Evaluation) -> str:
    """Say which simulator is closest to the teacher, by the SNR of the first treatment."""
    snr = {name: rows["snr"].dropna() for name, rows in parts(first.table).items()}
    order = sorted(snr, key=lambda name: -snr[name].median() if len(snr[name]) else 0.0)
    best = snr[order[0]]
    others = ", ".join(f"{name} {snr[name].median():.1f} dB" for name in order[1:])
    return (
        f"{_TREATMENTS[evaluation.settings['inputs'][0]]}: {order[0]} has a median SNR of {best.median():.1f} dB "
        f"(worst tenth {best.quantile(0.1):.1f} dB, {len(best)} items) against {_teacher(evaluation)}"
        + (f"; the others: {others}." if others else ".")
    )


def _about(evaluation: Evaluation) -> str:
    settings = evaluation.settings
    levels = ", ".join(f"{level:g}" for level in settings["levels"])
    text = (
        f"Compared with {_teacher(evaluation)}: {settings['items']} items of {settings['seconds']:g} s at {levels} "
        f"dB SPL in turn, seed {settings['seed']}. RAW MSE is that of waveforms scaled to unit power of the "
        "teacher's output. STOI and PESQ rate teacher and simulator against the clean speech; the tables "
        "show how well both agree: correlations (LCC, SRCC) and mean squared difference. PESQ means little "
        "where both are nearly inaudible."
    )
    if not is_installed("pesq"):
        text += f" PESQ was left out; to add it, {install_command('pesq')} and run again."
    return text


def _listening_section(evaluation: Evaluation) -> Section:
    """Play one item: the input, the teacher's output, and each simulator's."""
    item, expected = example_item(evaluation)
    signals = {"input": item.signal, "teacher": expected, **_outputs(evaluation, item)}
    # a short clip is filled up with silence
    end = int(item.signal.nonzero().max()) + item.sample_rate // 10
    signals = {name: signal[:end] for name, signal in signals.items()}
    differences = {f"{name} minus teacher": (name, "teacher") for name in [*signals][2:]}
    panels = spectrograms.panels(signals, item.sample_rate, differences)
    facts = item.facts
    text = (
        f"{_TREATMENTS[facts['treatment']]}, {facts['speech']}, {facts['input_level']:g} dB SPL, "
        f"{loss_name(facts['severity'])}. All players have the same gain. A difference is drawn where either "
        "signal is loud enough to be seen."
    )
    pictures = spectrograms.pictures({name: panels[name] for name in differences})
    played = players(signals, item.sample_rate)
    return Section("Listen", [text], players=played, pictures=pictures)


def _outputs(evaluation: Evaluation, item: Item) -> dict[str, Tensor]:
    """Return the finite outputs of the simulators; a failure is in the table."""
    outputs = {}
    for condition in evaluation.conditions:
        with suppress(Exception), torch.no_grad():
            output = condition.output(item)
            if output.isfinite().all():
                outputs[condition.name] = output
    return outputs


def _pictures(rows: DataFrame) -> Iterator[Picture]:
    """Draw the scores of simulator over teacher, and the errors by degree of loss."""
    for score, title in (("stoi", "STOI"), ("pesq", "PESQ")):
        pairs = rows.reindex(columns=[f"{score}_teacher", f"{score}_simulator"]).astype(float)
        if not pairs.dropna().empty:
            text = f"{title} of the simulator's output over that of the teacher's."
            titles = (f"{title}, teacher", f"{title}, simulator")
            x, y = pairs.to_numpy().T
            yield scatter_picture(x, y, rows["severity"].to_numpy(), titles, text)
    degrees = ordered(rows["severity"].unique())
    for column, title in (("snr", "SNR (dB)"), ("band_error", "Band error (dB)")):
        groups = {degree: rows.loc[rows["severity"] == degree, column] for degree in degrees}
        if len(groups) > 1:
            yield distribution_picture(groups, title, "degree of loss")
