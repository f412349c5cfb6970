"""Players of what an ear perceives, with spectrograms on one scale of dB SPL."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from hlsim.audio import encode_flac
from hlsim.calibration import PASCAL_SPL, gain_to_pascals, level_spl
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.parallel import describe_error
from hlsim.evaluation.result import Evaluation
from hlsim.extras import MissingExtraError, require
from hlsim.report.page import Player, Section, Sound

LONGEST_SECONDS = 8.0
"""Length after which an item is cut on a page."""

SPECTROGRAM_LEVELS = (0.0, 90.0)
"""Lowest and highest level of all spectrograms in dB SPL, for a bin of 50 Hz."""

NORMAL_EAR = "normal ear (the goal)"
"""Label of clean speech as a normal ear perceives it."""

SPECTROGRAM_COLOURS = ("#000004", "#3b0f70", "#8c2981", "#de4968", "#fe9f6d", "#fcfdbf")
"""Colours from the lowest level of a spectrogram to the highest, those of matplotlib's magma."""

_PEAK = 0.9
_HIGHEST_HZ = 8000.0  # MSBG and HASPI end there
_EMPTY_SHARE = 0.03  # of the bins that are within the range of an almost empty spectrogram

_EXPLANATION = (
    "What the impaired ear perceives, by MSBG. The goal is what a normal ear perceives of the "
    "clean speech. Switch between the sounds while one plays: the position stays the same."
)


def listening_sections(
    evaluation: Evaluation, count: int, conditions: Sequence[str] = ()
) -> list[Section]:
    """Return players of some items, from the largest rise of the score to the largest fall.

    Args:
        evaluation: The study.
        count: Number of items.
        conditions: Names of the conditions to be played, by default all.

    Returns: One section, or none if there is nothing to play.
    """
    headline = evaluation.headline
    if headline is None or not count:
        return []
    scores = evaluation.wide(headline.measure)
    changes = (scores[headline.after] - scores[headline.before]).dropna()
    changes = changes.sort_values(ascending=False, kind="stable")
    places = np.linspace(0, len(changes) - 1, min(count, len(changes))).round().astype(int)
    rows = evaluation.table.drop_duplicates("item").set_index("item")
    sections = []
    for place in places.tolist():
        row, change = rows.loc[changes.index[place]], changes.iloc[place]
        rank = f"change {change:+.3f}, rank {place + 1} of {len(changes)}"
        title = f"{row['name']} ({headline.title}: {rank})"
        number = int(row.get("source", row.name))
        try:
            sections.append(
                _item_section(evaluation, number, title, conditions or evaluation.names)
            )
        except Exception as error:  # a page is not lost to a sound
            sections.append(Section(title, [f"It cannot be played: {describe_error(error)}"]))
    return [Section("Listen", [_EXPLANATION], sections=sections)]


def _item_section(
    evaluation: Evaluation, number: int, title: str, conditions: Sequence[str]
) -> Section:
    """Return a player of the signals that a normal ear and, by condition, the ear perceives."""
    item = evaluation.items[number].load()
    gain, end = gain_to_pascals(item.full_scale_spl), int(LONGEST_SECONDS * item.sample_rate)
    signals = {NORMAL_EAR: perceive(item.clean[:end].float() * gain, NORMAL, item.sample_rate)}
    for condition in evaluation.conditions:
        if condition.name in conditions:
            with torch.no_grad():
                output = condition.output(item)[:end].float() * gain
            signals[condition.name] = perceive(output, item.ear, item.sample_rate)
    thresholds = ", ".join(f"{level:g}" for level in item.ear.thresholds)
    about = f"{item.ear.severity.capitalize()} loss, thresholds {thresholds} dB HL."
    return Section(title, [about], player=make_player({"": signals}, item.sample_rate))


def make_player(
    groups: Mapping[str, Mapping[str, Tensor]], sample_rate: int, sentence: str = ""
) -> Player:
    """Return a player, with spectrograms if Pillow is installed.

    All signals of a group have one gain, so that their loudness can be compared. Groups may have
    different gains: the output of an aid is much louder than what the ear perceives of it.

    Args:
        groups: Signals in pascals by label, for each heading of a group.
        sample_rate: Sample rate in Hz.
        sentence: Words that are spoken.

    Shape: (time,) for each signal.

    Raises:
        ValueError: All signals of a group are silent.

    >>> tone = torch.sin(torch.arange(16000) * 0.2)
    >>> player = make_player({"": {"tone": tone, "soft tone": 0.1 * tone}}, 16000)
    >>> [f"{sound.label} {sound.level:.0f} dB SPL" for sound in player.sounds]
    ['tone 91 dB SPL', 'soft tone 71 dB SPL']
    """
    first_peak = _peak(next(iter(groups.values())))
    sounds = {}
    for heading, group in groups.items():
        peak = _peak(group)
        softer = 20.0 * math.log10(peak / first_peak)
        title = heading + (f", played {softer:.0f} dB softer" if softer > 0.5 else "")
        sounds[title] = [
            _make_sound(label, signal, sample_rate, peak) for label, signal in group.items()
        ]
    samples = max(len(signal) for group in groups.values() for signal in group.values())
    return Player(
        groups=sounds,
        seconds=samples / sample_rate,
        full_scale=_full_scale(first_peak),
        sentence=sentence,
        levels=SPECTROGRAM_LEVELS,
        colours=SPECTROGRAM_COLOURS,
    )


def _make_sound(label: str, signal: Tensor, sample_rate: int, peak: float) -> Sound:
    """Encode a signal of a group with a peak in pascals, and draw it."""
    level = float(level_spl(signal))
    levels = spectrogram_levels(signal, sample_rate)
    lowest = SPECTROGRAM_LEVELS[0]
    is_empty = float((levels > lowest).float().mean()) < _EMPTY_SHARE
    return Sound(
        label,
        level,
        encode_flac(signal * (_PEAK / peak), sample_rate),
        loudness=level - _full_scale(peak),
        spectrogram=_spectrogram_png(levels),
        note=f"almost nothing above {lowest:.0f} dB SPL" if is_empty else "",
    )


def _peak(group: Mapping[str, Tensor]) -> float:
    """Return the largest sample of all signals of a group."""
    peak = max(float(signal.abs().max()) for signal in group.values())
    if not peak:
        raise ValueError("all sounds are silent; pass a signal with samples other than zero")
    return peak


def _full_scale(peak: float) -> float:
    """Return the level in dB SPL of full scale if a peak in pascals is played at ``_PEAK``."""
    return PASCAL_SPL + 20.0 * math.log10(peak / _PEAK)


def spectrogram_levels(signal: Tensor, sample_rate: int) -> Tensor:
    """Return levels up to 8 kHz in windows of 20 ms, every 10 ms; silence has -46 dB SPL.

    Args:
        signal: Signal in pascals.
        sample_rate: Sample rate in Hz.

    Shape: (time,) -> (bins of 50 Hz, frames) in dB SPL.

    >>> spectrogram_levels(torch.zeros(16000), 16000).shape
    torch.Size([161, 101])
    """
    points = 2 * (sample_rate // 100)
    window = torch.hann_window(points)
    spectrum = torch.stft(
        signal.float().cpu(), points, points // 2, window=window, return_complex=True
    )
    levels = 20.0 * torch.log10(spectrum.abs() * 2.0**0.5 / window.sum() + 1e-7) + PASCAL_SPL
    return levels[: round(_HIGHEST_HZ * points / sample_rate) + 1]


def _spectrogram_png(levels: Tensor) -> bytes:
    """Return a picture with one pixel for each bin and frame; nothing without Pillow."""
    try:
        image = require("PIL.Image", "eval")
    except MissingExtraError:  # sounds can be played without it
        return b""
    lowest, highest = SPECTROGRAM_LEVELS
    shares = ((levels - lowest) / (highest - lowest)).clamp(0.0, 1.0)
    pixels = (255.0 * shares).round().to(torch.uint8).flip(0).numpy()
    picture = image.fromarray(pixels)
    picture.putpalette(_palette())
    data = io.BytesIO()
    picture.save(data, format="PNG", optimize=True)
    return data.getvalue()


def _palette() -> bytes:
    """Return 256 colours between those of ``SPECTROGRAM_COLOURS``, three bytes each."""
    anchors = np.array([list(bytes.fromhex(colour[1:])) for colour in SPECTROGRAM_COLOURS])
    shares, places = np.linspace(0.0, 1.0, 256), np.linspace(0.0, 1.0, len(anchors))
    channels = [np.interp(shares, places, channel) for channel in anchors.T]
    return np.stack(channels, 1).round().astype(np.uint8).tobytes()
