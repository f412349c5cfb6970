"""A comparison of simulators as JSON, Markdown, one HTML page, and a picture of spectrograms."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.items import Item
from hlsim.files import write_whole
from hlsim.neuro.config import NEURO_RATE
from hlsim.report.haspi_pictures import draw_svg
from hlsim.report.haspi_text import markdown_table
from hlsim.report.page import Picture, Section, Table, render_page
from hlsim.report.pictures import draw_spectrograms

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

GROUPS = {"severity": "By degree of loss", "level": "By level (dB SPL)", "condition": "By condition"}


_INPUT_TITLES = {
    "as-is": "Speech as it is",
    "louder": "20 dB louder",
    "nal-r": "Amplified by NAL-R for the ear",
    "compressed": "Compressed 3:1",
    "compensated": "The output of a compensator",
}


def fidelity_markdown(summary: Mapping[str, Any]) -> str:
    """What ``summarise`` returned as Markdown tables: the whole first, then each grouping."""
    whole = Table("", ["Items", *COLUMNS], [["all", *column_cells(summary["overall"])]])
    groups = [f"**{table.caption}**\n\n{markdown_table(table)}" for table in group_tables(summary)]
    return "\n\n".join([markdown_table(whole), *groups]) + "\n"


def group_tables(summary: Mapping[str, Any]) -> list[Table]:
    """A table for each of severity, level and condition that the items have."""
    return [
        Table(
            title,
            [key.capitalize(), *COLUMNS],
            [[group, *column_cells(figures)] for group, figures in summary[key].items()],
        )
        for key, title in GROUPS.items()
        if summary.get(key)
    ]


def column_cells(figures: Mapping[str, float | int | None]) -> list[str]:
    """The figures of ``summarise`` under ``COLUMNS``, ``n/a`` where there is none; with their n where it is less."""
    cells = []
    for key, form in COLUMNS.values():
        cell = "n/a" if figures[key] is None else f"{figures[key]:{form}}"
        # raw MSE and band error are there where an SNR is
        used = figures.get(f"{key.split('_')[0]}_n", figures["snr_n"])
        fewer = key != "n" and used != figures["n"] and figures[key] is not None
        cells.append(f"{cell} ({used} of {figures['n']})" if fewer else cell)
    return cells


def side_by_side(result: Mapping[str, Any], given: str) -> Table:
    """The paper's Table I and our columns: a row a simulator, over all items of one input."""
    rows = [
        [name, *column_cells(entry["inputs"][given]["overall"])]
        for name, entry in result["simulators"].items()
    ]
    return Table(_INPUT_TITLES[given], ["Simulator", *COLUMNS], rows)


def failure_table(result: Mapping[str, Any]) -> Table | None:
    """What simulators failed on, and scores that could not be made; None if there is nothing of it."""
    rows = [
        (name, str(row["item"]), _INPUT_TITLES[row["input"]], row["severity"], reason)
        for name, entry in result["simulators"].items()
        for row in entry["items"]
        for reason in row.get("reasons", ())
    ]
    header = ("Simulator", "Item", "Input", "Degree of loss", "Reason")
    return Table("Without a score, and in no figure that needs it", header, rows) if rows else None


def fidelity_text(result: Mapping[str, Any]) -> str:
    """The comparison in Markdown: simulators side by side for each input, then each by itself."""
    parts = ["# Fidelity to MSBG", _what(result)]
    for given in result["inputs"]:
        table = side_by_side(result, given)
        parts.append(f"## {table.caption}\n\n{markdown_table(table)}")
    for name, entry in result["simulators"].items():
        for given, summary in entry["inputs"].items():
            parts.append(
                f"## {name}: {_INPUT_TITLES[given].lower()}\n\n{fidelity_markdown(summary).rstrip()}"
            )
    if (failures := failure_table(result)) is not None:
        parts.append(f"## Failures\n\n{failures.caption}.\n\n{markdown_table(failures)}")
    return "\n\n".join(parts) + "\n"


def write_fidelity(
    result: Mapping[str, Any], panels: Mapping[str, Tensor], shown: Item, out: str | Path
) -> None:
    """Write the files into a folder, each whole or not at all.

    Args:
        panels: what is heard of ``shown`` by name, in pascals at 16 kHz.

    Raises:
        ValueError: a file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    picture = io.BytesIO()
    draw_spectrograms(panels, NEURO_RATE, picture)
    contents: dict[str, str | bytes] = {
        "fidelity.json": json.dumps(result, indent=1),
        "fidelity.md": fidelity_text(result),
        "fidelity.html": _page(result, picture.getvalue(), shown),
        "spectrograms.png": picture.getvalue(),
    }
    for name in FILES:
        write_whole(Path(out) / name, contents[name])


def _what(result: Mapping[str, Any]) -> str:
    truth = "pyclarity's MSBG" if result["teacher"] == "pyclarity" else "hlsim's exact MSBG"
    levels = ", ".join(f"{level:g}" for level in result["levels"])
    return (
        f"Against {truth}: {result['items']} items of {result['seconds']:g} s at {levels} dB SPL in turn, seed "
        f"{result['seed']}. RAW MSE is on waveforms scaled to unit power of the truth. STOI and PESQ are of what is "
        "heard against the clean speech, of the truth and of the simulator: correlations (LCC, SRCC) and mean squared "
        "difference. PESQ says little where both signals are nearly inaudible."
    )


def _page(result: Mapping[str, Any], spectrograms: bytes, shown: Item) -> str:
    sections = [
        Section("Side by side", [_what(result)], [side_by_side(result, given) for given in result["inputs"]])
    ]
    about = (
        f"{_INPUT_TITLES[shown.about['input']]}, {shown.about['condition']}, {shown.about['level']:g} dB SPL, "
        f"{shown.about['severity']} loss"
    )
    panel = Picture(spectrograms, "Log-magnitude spectrograms of the truth and each simulator", about)
    sections.append(Section("Spectrograms", pictures=[panel]))
    for name, entry in result["simulators"].items():
        given = result["inputs"][0]
        rows = [row for row in entry["items"] if row["input"] == given]
        tables = group_tables(entry["inputs"][given])
        sections.append(Section(f"{name}: {_INPUT_TITLES[given].lower()}", (), tables, _pictures(rows)))
    if (failures := failure_table(result)) is not None:
        sections.append(Section("Failures", tables=[failures]))
    return render_page("Fidelity to MSBG", sections, f"{', '.join(result['simulators'])}.")


def _pictures(rows: Sequence[Mapping[str, Any]]) -> list[Picture]:
    pictures = []
    for measure, title in (("stoi", "STOI"), ("pesq", "PESQ (wide band)")):
        data = draw_svg(_scatter(rows, measure, title))
        pictures.append(Picture(data, f"{title} of the simulated against that of the true, a point an item"))
    for key, title in (("snr", "Waveform SNR (dB)"), ("band_error", "Band level error (dB)")):
        data = draw_svg(_boxes(rows, key, title))
        pictures.append(
            Picture(data, f"{title} by degree of loss: quartiles, and the range within 1.5 of them")
        )
    return pictures


def _scatter(rows: Sequence[Mapping[str, Any]], measure: str, title: str) -> Callable[[Any], None]:
    def draw(axes: Any) -> None:
        for number, severity in enumerate(SEVERITIES):
            pairs = [
                (row[f"{measure}_true"], row[f"{measure}_sim"])
                for row in rows
                if row["severity"] == severity
                and None not in map(row.get, (f"{measure}_true", f"{measure}_sim"))
            ]
            if pairs:
                axes.scatter(*zip(*pairs, strict=True), s=12, alpha=0.7, color=f"C{number}", label=severity)
        axes.axline((1.0, 1.0), slope=1.0, color="0.5", linewidth=1.0, linestyle="--")
        axes.set(xlabel=f"{title}, true", ylabel=f"{title}, simulated")
        if axes.collections:
            axes.legend(fontsize="small")

    return draw


def _boxes(rows: Sequence[Mapping[str, Any]], key: str, title: str) -> Callable[[Any], None]:
    def draw(axes: Any) -> None:
        groups = {s: [row[key] for row in rows if row["severity"] == s and key in row] for s in SEVERITIES}
        there = {severity: values for severity, values in groups.items() if values}
        if there:
            axes.boxplot([*there.values()], tick_labels=[*there])
        axes.set(ylabel=title)

    return draw
