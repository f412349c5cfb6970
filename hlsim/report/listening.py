"""Chosen items of a study as an ear perceives them: players with spectrograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from hlsim.audio import encode_flac
from hlsim.calibration import gain_to_pascals, level_spl
from hlsim.evaluation.measures import perceive
from hlsim.evaluation.parallel import describe_error
from hlsim.evaluation.result import Evaluation
from hlsim.extras import MissingExtraError
from hlsim.report import spectrograms
from hlsim.report.page import Picture, Player, Section

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
    """Return players of some items, from the largest rise of the headline's score to the largest fall.

    Args:
        count: number of items; with 0 there is no section.
        shown: names of the conditions to be played, by default all.
    """
    headline, sections = evaluation.headline, []
    if headline is None:
        return None
    scores = evaluation.wide(headline.measure)
    changes = (scores[headline.after] - scores[headline.before]).dropna()
    changes = changes.sort_values(ascending=False, kind="stable")
    places = np.linspace(0, len(changes) - 1, max(0, min(count, len(changes))))
    rows = evaluation.table.drop_duplicates("item").set_index("item")
    for place in places.round().astype(int).tolist():
        row, change = rows.loc[changes.index[place]], changes.iloc[place]
        rank = f"change {change:+.3f}, rank {place + 1} of {len(changes)}"
        title = f"{row['name']} ({headline.title}: {rank})"
        try:
            number = int(row.get("source", row.name))
            sections.append(_item_section(evaluation, number, title, shown or evaluation.names))
        except Exception as error:  # a page is not lost to a sound
            sections.append(Section(title, [f"It cannot be played: {describe_error(error)}"]))
    return Section("Listen", [_EXPLANATION], sections=sections) if sections else None


def _item_section(evaluation: Evaluation, number: int, title: str, shown: Sequence[str]) -> Section:
    """Play clean speech and what the ear perceives of each condition."""
    item = evaluation.items[number].load()
    gain, end = gain_to_pascals(item.full_scale_spl), int(LONGEST_SECONDS * item.sample_rate)
    signals = {"clean speech": item.clean[:end].float() * gain}
    for condition in evaluation.conditions:
        if condition.name in shown:
            with torch.no_grad():
                output = condition.output(item)[:end].float() * gain
            perceived = perceive(output, item.ear, item.sample_rate)
            signals[f"{condition.name}, perceived"] = perceived
    thresholds = ", ".join(f"{level:g}" for level in item.ear.thresholds)
    about = f"{item.ear.severity.capitalize()} loss, thresholds {thresholds} dB HL."
    return Section(title, [about], players=players(signals, item.sample_rate))


def players(signals: Mapping[str, Tensor], sample_rate: int) -> list[Player]:
    """Return players with one gain and their levels, with spectrograms if matplotlib is installed.

    Shape: (time,) each, in pascals. Raises ValueError if all are silent.
    """
    peak = max(float(signal.abs().max()) for signal in signals.values())
    if not peak:
        raise ValueError("all sounds are silent")
    drawn: Sequence[Picture | None]
    try:
        drawn = spectrograms.pictures(spectrograms.panels(signals, sample_rate))
    except MissingExtraError:  # sounds can be played without matplotlib
        drawn = [None] * len(signals)
    found = []
    for (name, signal), picture in zip(signals.items(), drawn, strict=True):
        label = f"{name}, {float(level_spl(signal)):.0f} dB SPL"
        found.append(Player(encode_flac(signal * (_PEAK / peak), sample_rate), label, picture))
    return found
