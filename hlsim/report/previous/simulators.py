"""A comparison of simulators as JSON, Markdown, one HTML page, and a picture of spectrograms."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.previous.items import Item
from hlsim.evaluation.statistics import PairedComparison
from hlsim.extras import install_command, is_installed
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.page import Picture, Section, render_markdown, render_page, write_files
from hlsim.report.previous.pictures import draw_svg, legend, scatter
from hlsim.report.previous.tables import Table, inner, loss_name, number, paired_cells
from hlsim.report.spectrograms import composite, panels, pictures

FILES = ("fidelity.json", "fidelity.md", "fidelity.html", "spectrograms.png")

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
"""Titles of a table's columns, with the figure and its format."""

_GROUPS = {
    "severity": "By degree of loss",
    "level": "By level (dB SPL)",
    "condition": "By condition",
}

_TEACHERS = {"msbg": "hlsim's exact MSBG"}

_INPUT_TITLES = {
    "as-is": "Speech as it is",
    "louder": "20 dB louder",
    "nal-r": "Amplified by NAL-R for the ear",
    "compressed": "Compressed 3:1",
    "compensated": "The output of a compensator",
}

Row = Mapping[str, Any]


def write_fidelity(result: Row, heard: Mapping[str, Tensor], shown: Item, out: str | Path) -> None:
    """Write the files into a folder, each whole or not at all, or ValueError.

    ``heard`` is what is heard of ``shown``, the truth first, by name, in pascals at 16 kHz.
    """
    truth, *others = heard
    named = {
        "original": shown.signal,
        "reference": heard[truth],
        **{name: heard[name] for name in others},
    }
    end = (
        int(shown.signal.nonzero().max()) + NEURO_RATE // 10
    )  # a short clip is filled up with silence
    named = {name: signal[:end] for name, signal in named.items()}
    drawn = panels(
        named, NEURO_RATE, {f"{name} less reference": (name, "reference") for name in others}
    )
    page = (
        "Fidelity to MSBG" if result["teacher"] in _TEACHERS else "Fidelity",
        _sections(result, pictures(drawn), shown),
        _lead(result),
    )
    contents = (
        json.dumps(result, indent=1),
        render_markdown(*page),
        render_page(*page),
        composite(drawn),
    )
    write_files(out, dict(zip(FILES, contents, strict=True)))


def _lead(result: Row) -> str:
    """Each simulator's SNR, the best first."""
    given = result["inputs"][0]
    found = {
        name: entry["inputs"][given]["overall"] for name, entry in result["simulators"].items()
    }
    told = [
        f"{name} {number(own['snr_median'], '.1f')} ({number(own['snr_worst_tenth'], '.1f')})"
        for name, own in sorted(
            found.items(), key=lambda pair: -(pair[1]["snr_median"] or -math.inf)
        )
    ]
    reference = _TEACHERS.get(result["teacher"], result["teacher"])
    return f"SNR in dB against {reference}, median item (worst tenth): {', '.join(told)}."


def _about(result: Row) -> str:
    reference = _TEACHERS.get(result["teacher"], result["teacher"])
    levels = ", ".join(f"{level:g}" for level in result["levels"])
    about = (
        f"Against {reference}: {result['items']} items of {result['seconds']:g} s at {levels} dB SPL in turn, seed "
        f"{result['seed']}. RAW MSE is on waveforms scaled to unit power of the reference. STOI and PESQ are of what is "
        "heard against the clean speech, of the reference and of the simulator: correlations (LCC, SRCC) and mean "
        "squared difference. PESQ says little where both signals are nearly inaudible."
    )
    if not is_installed("pesq"):
        about += f" PESQ was not computed. To add it, install pesq ({install_command('pesq')}) and run again."
    return about


def _sections(result: Row, spectrograms: Sequence[Picture], shown: Item) -> list[Section]:
    sections = [
        Section(
            _INPUT_TITLES[given], tables=[side_by_side(result, given), *_over_first(result, given)]
        )
        for given in result["inputs"]
    ]
    about = (
        f"{_INPUT_TITLES[shown.about['input']]}, {shown.about['condition']}, {shown.about['level']:g} dB SPL, "
        f"{loss_name(shown.about['severity'])}. A difference is drawn where either is loud enough to be seen."
    )
    sections[0] = replace(sections[0], paragraphs=[_about(result)])
    sections.append(Section("Spectrograms", [about], pictures=spectrograms))
    for name, entry in result["simulators"].items():
        for given, summary in entry["inputs"].items():
            rows = [row for row in entry["items"] if row["input"] == given]
            drawn = _pictures(rows) if given == result["inputs"][0] else []
            title = f"{name}: {inner(_INPUT_TITLES[given])}"
            sections.append(Section(title, (), summary_tables(summary), drawn))
    failures = [
        (name, str(row["item"]), _INPUT_TITLES[row["input"]], row["severity"], reason)
        for name, entry in result["simulators"].items()
        for row in entry["items"]
        for reason in row.get("reasons", ())
    ]
    if failures:
        header = ("Simulator", "Item", "Input", "Degree of loss", "Reason")
        table = Table("Without a score, and in no figure that needs it", header, failures)
        sections.append(Section("Failures", tables=[table]))
    return sections


def side_by_side(result: Row, given: str) -> Table:
    """The paper's Table I and our columns: a row a simulator, over all items of one input."""
    figures = {
        name: entry["inputs"][given]["overall"] for name, entry in result["simulators"].items()
    }
    return _table("Simulators side by side", "Simulator", figures)


def _over_first(result: Row, given: str) -> list[Table]:
    """Whether the others are nearer than the first: a row each, paired over the items of one input."""
    first, *others = result["simulators"].items()
    found = {name: entry["snr_over_first"][given] for name, entry in others}
    compared = {name: PairedComparison(**paired) for name, paired in found.items() if paired}
    rows = [{"Simulator": name, "n": str(c.n)} | paired_cells(c) for name, c in compared.items()]
    return (
        [Table.of(f"SNR (dB) less that of {first[0]}, mean over the items", rows)] if rows else []
    )


def summary_tables(summary: Row) -> list[Table]:
    """What ``summarise`` returned: the whole first, then each of severity, level and condition that the items have."""
    groups = [
        _table(title, key.capitalize(), summary[key])
        for key, title in _GROUPS.items()
        if summary.get(key)
    ]
    return [_table("All items", "Items", {"all": summary["overall"]}), *groups]


def _table(caption: str, of: str, groups: Mapping[str, Row]) -> Table:
    return Table(
        caption,
        (of, *COLUMNS),
        [(name, *column_cells(figures)) for name, figures in groups.items()],
    )


def column_cells(figures: Row) -> list[str]:
    """The figures of ``summarise`` under ``COLUMNS``, ``n/a`` where there is none; with their n where it is less."""
    cells = []
    for key, form in COLUMNS.values():
        cell = number(figures[key], form)
        # raw MSE and band error are there where an SNR is
        used = figures.get(f"{key.split('_')[0]}_n", figures["snr_n"])
        fewer = key != "n" and used != figures["n"] and figures[key] is not None
        cells.append(f"{cell} ({used} of {figures['n']})" if fewer else cell)
    return cells


def _pictures(rows: Sequence[Row]) -> list[Picture]:
    severities = [row["severity"] for row in rows]

    def points(axes: Any, key: str, title: str) -> None:
        sides = ([row.get(f"{key}_{whose}") for row in rows] for whose in ("true", "sim"))
        x, y = (np.array(side, dtype=np.float64) for side in sides)  # None becomes NaN
        scatter(axes, x, y, severities, "equal")
        axes.set(xlabel=f"{title}, reference", ylabel=f"{title}, simulated")
        legend(axes)

    def boxes(axes: Any, key: str, title: str) -> None:
        groups = {
            s: [row[key] for row in rows if row["severity"] == s and key in row] for s in SEVERITIES
        }
        if there := {severity: values for severity, values in groups.items() if values}:
            axes.boxplot([*there.values()], tick_labels=[*there])
        axes.set(ylabel=title)

    against = "against that of the reference, a point an item"
    by_loss = "by degree of loss: quartiles, and the range within 1.5 of them"
    kinds: list[tuple[Callable[..., None], str, str, str]] = [
        (points, "stoi", "STOI", f"of the simulated {against}"),
        (points, "pesq", "PESQ (wide band)", f"of the simulated {against}"),
        (boxes, "snr", "Waveform SNR (dB)", by_loss),
        (boxes, "band_error", "Band level error (dB)", by_loss),
    ]
    return [
        Picture(draw_svg(partial(draw, key=key, title=title)), f"{title} {about}")
        for draw, key, title, about in kinds
    ]
