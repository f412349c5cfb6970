"""Chosen items of a study as an ear perceives them: players with spectrograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.audio import encode_flac
from hlsim.audiogram import Audiogram
from hlsim.audiogram.listener import EARS
from hlsim.calibration import gain_to_pascals, level_spl
from hlsim.evaluation.measures import perceive
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Item
from hlsim.parallel import reason_of
from hlsim.report import spectrograms
from hlsim.report.page import Player, Section

LONGEST_SECONDS = 8.0
"""Length after which an item is cut on a page."""

_PEAK = 0.9

_EXPLANATION = (
    "What the impaired ear perceives, by MSBG, beside the clean speech. All players of an item have the "
    "same gain, so that what is soft for that ear is soft here. Begin with a low volume: some sounds "
    "are much louder than others, as the levels beside them say."
)


def listening_section(
    evaluation: Evaluation, count: int, shown: Sequence[str] = ()
) -> Section | None:
    """Return players and spectrograms of some items, from the largest rise of the headline to the largest fall.

    Args:
        count: number of items; with 0 there is no section.
        shown: names of the conditions to be played, by default all.
    """
    sections = []
    for title, row in _choose_items(evaluation, count):
        try:
            signals, ear, rate = _perceived(evaluation, row, shown or evaluation.names)
            sections.append(Section(title, [_about(ear)], players=players(signals, rate)))
        except Exception as error:  # a page is not lost to a sound
            sections.append(Section(title, [f"It cannot be played: {reason_of(error)}"]))
    if not sections:
        return None
    return Section("Listen", [_EXPLANATION], sections=sections)


def players(signals: Mapping[str, Tensor], sample_rate: int) -> list[Player]:
    """Return players with one gain, each with its spectrogram and its level.

    Shape: (time,) each, in pascals.
    """
    peak = max(float(signal.abs().max()) for signal in signals.values())
    if not peak:
        raise ValueError("all sounds are silent")
    levels = {name: float(level_spl(signal)) for name, signal in signals.items()}
    pictures = spectrograms.pictures(spectrograms.panels(signals, sample_rate))
    return [
        Player(
            encode_flac(signal * (_PEAK / peak), sample_rate),
            f"{name}, {levels[name]:.0f} dB SPL",
            picture,
        )
        for (name, signal), picture in zip(signals.items(), pictures, strict=True)
    ]


def _choose_items(evaluation: Evaluation, count: int) -> list[tuple[str, Any]]:
    """Return titles and rows of items that are spread over the change of the headline's score."""
    headline = evaluation.headline
    if headline is None:
        return []
    wide = evaluation.wide(headline.measure)
    changes = (wide[headline.after] - wide[headline.before]).dropna()
    changes = changes.sort_values(ascending=False, kind="stable")
    places = np.linspace(0, len(changes) - 1, max(0, min(count, len(changes))))
    rows = evaluation.table[evaluation.table["condition"] == headline.after].set_index("item")
    chosen = []
    for place in places.round().astype(int).tolist():
        row = rows.loc[changes.index[place]]
        kind = {0: "largest rise", len(changes) - 1: "smallest rise or largest fall"}
        which = kind.get(place, f"rank {place + 1} of {len(changes)}")
        title = f"{row['name']} ({which}: {headline.title} {changes.iloc[place]:+.3f})"
        chosen.append((title, row))
    return chosen


def _perceived(
    evaluation: Evaluation, row: Any, shown: Sequence[str]
) -> tuple[dict[str, Tensor], Audiogram, int]:
    """Return clean speech and what one ear perceives of each condition, in pascals, the ear and the rate."""
    item = evaluation.items[int(row.get("source", row.name))].load()
    rate = item.sample_rate
    ear, channel = _ear_to_play(item, row)
    gain, end = gain_to_pascals(item.full_scale_spl), int(LONGEST_SECONDS * rate)
    signals = {"clean speech": item.clean[channel][..., :end].float() * gain}
    for condition in evaluation.conditions:
        if condition.name in shown:
            with torch.no_grad():
                output = condition.output(item)[channel][..., :end].float() * gain
            signals[f"{condition.name}, perceived"] = perceive(output, ear, rate)
    return signals, ear, rate


def _ear_to_play(item: Item, row: Any) -> tuple[Audiogram, Any]:
    """Return the ear of an item, the better one of a listener's two, and the index of its channel."""
    if isinstance(item.ear, Audiogram):
        return item.ear, ...
    name = row["better_ear"]
    ear: Audiogram = getattr(item.ear, name)
    return ear, EARS.index(name)


def _about(ear: Audiogram) -> str:
    thresholds = ", ".join(f"{level:g}" for level in ear.thresholds)
    return f"{ear.severity.capitalize()} loss, thresholds {thresholds} dB HL."
