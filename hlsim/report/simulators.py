"""The page of ``evaluate-simulator``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.simulators import GROUPINGS, example_item, summaries, summary
from hlsim.evaluation.study import Item
from hlsim.extras import install_command, is_installed
from hlsim.report import spectrograms
from hlsim.report.listening import players
from hlsim.report.page import Page, Picture, Section, Table, write_page
from hlsim.report.plots import distribution_picture, draw_svg, legend, scatter
from hlsim.report.results import (
    comparisons_table,
    failure_section,
    inner,
    loss_name,
    number,
    versions_text,
)

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = {
    "n": ("n", "d"),
    "SNR median (dB)": ("snr_median", ".1f"),
    "SNR worst tenth (dB)": ("snr_worst_tenth", ".1f"),
    "STOI LCC": ("stoi_lcc", ".4f"),
    "STOI SRCC": ("stoi_srcc", ".4f"),
    "STOI MSE": ("stoi_mse", ".5f"),
    "PESQ LCC": ("pesq_lcc", ".4f"),
    "PESQ SRCC": ("pesq_srcc", ".4f"),
    "PESQ MSE": ("pesq_mse", ".4f"),
    "RAW MSE": ("raw_mse", ".4f"),
    "Band error median (dB)": ("band_error_median", ".2f"),
}
"""Columns of a table by title, with the value of ``summary`` and its format."""

_GROUPINGS = dict(
    zip(GROUPINGS, ("By degree of loss", "By level (dB SPL)", "Clean or noisy"), strict=True)
)

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
    sections: list[Section] = []
    for treatment, group in evaluation.groups.items():
        about = [] if sections else [_about(evaluation)]
        tables = [side_by_side(group)]
        if group.comparisons:
            tables.append(comparisons_table(group.comparisons))
        sections.append(Section(_TREATMENTS[treatment], about, tables))
    if listen:
        sections.append(_listening_section(evaluation))
    first = next(iter(evaluation.groups.values()))
    pictures = [
        Section(name, pictures=_pictures(part)) for name, part in _parts(first) if len(part) > 1
    ]
    if pictures:
        sections.append(Section("Pictures", sections=pictures))
    details = [
        Section(f"{name}: {inner(_TREATMENTS[treatment])}", tables=_summary_tables(part))
        for treatment, group in evaluation.groups.items()
        for name, part in _parts(group)
    ]
    failures = failure_section(evaluation.failures, "Simulator")
    details += [] if failures is None else [failures]
    details.append(Section("Versions", [versions_text(evaluation.versions)]))
    sections.append(Section("Details", sections=details, folded=True))
    return Page("Simulators", _verdict(evaluation), sections)


def _teacher(evaluation: Evaluation) -> str:
    teacher: str = evaluation.settings["teacher"]
    return "the exact MSBG" if teacher == "msbg" else teacher


def _parts(evaluation: Evaluation) -> Iterator[tuple[str, DataFrame]]:
    """Yield name and rows of each simulator."""
    for name in evaluation.names:
        yield name, evaluation.table[evaluation.table["condition"] == name]


def _verdict(evaluation: Evaluation) -> str:
    """Say which simulator is closest to the teacher, by the SNR of the first treatment."""
    treatment, group = next(iter(evaluation.groups.items()))
    found = {name: summary(part) for name, part in _parts(group)}
    best = max(found, key=lambda name: found[name]["snr_median"] or -math.inf)
    snr = (
        f"median SNR {number(found[best]['snr_median'], '.1f')} dB (worst tenth "
        f"{number(found[best]['snr_worst_tenth'], '.1f')} dB, {found[best]['snr_n']} items)"
    )
    others = ", ".join(
        f"{name} {number(values['snr_median'], '.1f')} dB"
        for name, values in found.items()
        if name != best
    )
    text = f"{_TREATMENTS[treatment]}: {best} has a {snr} against {_teacher(evaluation)}"
    return f"{text}; the others: {others}." if others else f"{text}."


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


def side_by_side(evaluation: Evaluation) -> Table:
    """Return one row per simulator, over all items: the columns of the paper's Table I and others."""
    rows = {name: summary(part) for name, part in _parts(evaluation)}
    return _table("Simulators side by side", "Simulator", rows)


def _summary_tables(part: DataFrame) -> list[Table]:
    """Return the tables of one simulator by the facts that differ between the items."""
    tables = [_table("All items", "Items", {"all": summary(part)})]
    for fact, title in _GROUPINGS.items():
        if part[fact].nunique() > 1:
            tables.append(_table(title, fact.replace("_", " ").capitalize(), summaries(part, fact)))
    return tables


def _table(caption: str, first: str, rows: Mapping[str, Mapping[str, Any]]) -> Table:
    cells = [(name, *_cells(values)) for name, values in rows.items()]
    return Table(caption, (first, *COLUMNS), cells)


def _cells(values: Mapping[str, Any]) -> list[str]:
    """Format the values of a row, each with its own n if that is smaller."""
    cells = []
    for key, form in COLUMNS.values():
        cell = number(values[key], form)
        used = values.get(f"{key.split('_')[0]}_n", values["snr_n"])
        fewer = key != "n" and used != values["n"] and values[key] is not None
        cells.append(f"{cell} ({used} of {values['n']})" if fewer else cell)
    return cells


def _listening_section(evaluation: Evaluation) -> Section:
    """Play one item: the input, the teacher's output, and each simulator's."""
    item, expected = example_item(evaluation)
    signals = {"input": item.signal, "teacher": expected, **_outputs(evaluation, item)}
    # a short clip is filled up with silence
    end = int(item.signal.nonzero().max()) + item.sample_rate // 10
    signals = {name: signal[:end] for name, signal in signals.items()}
    names = list(signals)[2:]
    differences = {f"{name} minus teacher": (name, "teacher") for name in names}
    panels = spectrograms.panels(signals, item.sample_rate, differences)
    facts = item.facts
    text = (
        f"{_TREATMENTS[facts['treatment']]}, {facts['speech']}, {facts['input_level']:g} dB SPL, "
        f"{loss_name(facts['severity'])}. All players have the same gain. A difference is drawn where either "
        "signal is loud enough to be seen."
    )
    return Section(
        "Listen",
        [text],
        players=players(signals, item.sample_rate),
        pictures=spectrograms.pictures({name: panels[name] for name in differences}),
    )


def _outputs(evaluation: Evaluation, item: Item) -> dict[str, Tensor]:
    """Return the finite outputs of the simulators; a failure is in the table."""
    outputs = {}
    for condition in evaluation.conditions:
        with suppress(Exception), torch.no_grad():
            output = condition.output(item)
            if output.isfinite().all():
                outputs[condition.name] = output
    return outputs


def _pictures(part: DataFrame) -> list[Picture]:
    """Draw the scores of simulator over teacher, and the errors by degree of loss."""
    pictures = []
    for name, title in (("stoi", "STOI"), ("pesq", "PESQ (wide band)")):
        columns = [f"{name}_teacher", f"{name}_simulator"]
        pairs = part.reindex(columns=columns).astype(float)
        if pairs.dropna().empty:
            continue
        x, y = pairs.to_numpy().T
        draw = partial(_draw_pairs, x=x, y=y, severities=list(part["severity"]), title=title)
        text = f"{title} of the simulator's output over that of the teacher's, one point per item."
        pictures.append(Picture(draw_svg(draw), text, text))
    for column, title in (("snr", "SNR (dB)"), ("band_error", "Band error (dB)")):
        groups = {
            severity: part.loc[part["severity"] == severity, column].dropna().to_numpy()
            for severity in SEVERITIES
        }
        known = {severity: values for severity, values in groups.items() if len(values)}
        if len(known) > 1:
            pictures.append(distribution_picture(known, title, "by degree of loss"))
    return pictures


def _draw_pairs(axes: Any, x: Any, y: Any, severities: list[str], title: str) -> None:
    scatter(axes, x, y, severities, "equal")
    axes.set(xlabel=f"{title}, teacher", ylabel=f"{title}, simulator")
    legend(axes)
