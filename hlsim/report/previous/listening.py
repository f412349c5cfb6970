"""Chosen items of a report as they are heard: signals through MSBG, as pictures and players of a page."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from hlsim.audio import encode_flac
from hlsim.calibration import gain_to_pascals, level_spl
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.evaluation.previous.scoring import read_channel
from hlsim.msbg.model import MSBG
from hlsim.report.page import Player, Section
from hlsim.report.spectrograms import panels, pictures

LONGEST_SECONDS = 8.0
"""Of an item in a page: longer ones are cut there."""

_PEAK = 0.9


def choose_items(report: HaspiReport, count: int) -> list[tuple[str, ItemScore]]:
    """Items spread over the headline's change, from the largest rise to the largest fall, with the reason for each."""
    scores = report.scores(report.headline.measure, (report.headline.before, report.headline.after))
    changes = [
        (after - before, item)
        for (before, after), item in zip(scores.tolist(), report.items, strict=True)
        if item.clean is not None and before == before and after == after
    ]
    changes.sort(key=lambda pair: -pair[0])
    chosen = np.linspace(0, len(changes) - 1, max(0, min(count, len(changes)))).round().astype(int)
    return [
        (f"rank {place + 1} of {len(changes)}, change {changes[place][0]:+.3f}", changes[place][1])
        for place in chosen
    ]


def heard(item: ItemScore) -> tuple[dict[str, Tensor], int]:
    """The clean speech and what the ear hears of each condition, in pascals, and the rate in Hz. Shape: (time,) each.

    By the exact MSBG of the item's audiogram, aligned; at most the first 8 s. ValueError where a file cannot be read, or
    a threshold is above the 100 dB HL that MSBG takes.
    """
    if item.clean is None:
        raise ValueError(f"{item.file}: its files are not known")
    clean, rate = read_channel(item.clean, item.ear)
    to_pascals, end = gain_to_pascals(item.full_scale_spl), int(LONGEST_SECONDS * rate)
    ear = MSBG(item.audiogram, sample_rate=rate)
    signals = {"original": torch.from_numpy(clean[:end]).float() * to_pascals}
    for name in item.levels:
        if name in item.processed and item.levels[name] is not None:
            samples, _ = read_channel(item.processed[name], item.ear)
            with torch.no_grad():
                signals[f"{name}, as heard"] = ear(
                    torch.from_numpy(samples[:end]).float() * to_pascals
                )
    return signals, rate


def listening_section(report: HaspiReport, count: int) -> Section | None:
    """Spectrograms and players of chosen items; None where their files are not known or ``count`` is 0."""
    sections = []
    for reason, item in choose_items(report, count):
        title = f"{item.file} ({reason})"
        try:
            sections.append(_item_section(title, item))
        except ValueError as error:
            sections.append(Section(title, [f"Not to be heard here: {error}"]))
    text = (
        "What the impaired ear hears, by MSBG, beside the clean speech. Within an item all players have one gain, so "
        "that what is softer in that ear is softer here; set the volume by the original. "
        f"Items longer than {LONGEST_SECONDS:g} s are cut."
    )
    return Section("Listen", [text], sections=sections) if sections else None


def _item_section(title: str, item: ItemScore) -> Section:
    signals, rate = heard(item)
    if not any(
        bool(signal.any()) for signal in signals.values()
    ):  # speech that begins later is scored, but cut here
        raise ValueError(f"the first {LONGEST_SECONDS:g} s are silent")
    thresholds = ", ".join(f"{level:g}" for level in item.audiogram.levels)
    text = f"{item.severity} loss, thresholds {thresholds} dB HL."
    drawn = pictures(panels(signals, rate))
    return Section(title, [text], pictures=drawn, players=players(signals, rate))


def players(signals: Mapping[str, Tensor], rate: int) -> list[Player]:
    """All at one gain: what is softer in the ear is softer here. Shape: (time,) each, in pascals, not all silent."""
    gain = _PEAK / max(float(signal.abs().max()) for signal in signals.values())
    return [
        Player(encode_flac(signal * gain, rate), f"{name} ({float(level_spl(signal)):.0f} dB SPL)")
        for name, signal in signals.items()
    ]
