"""Players for pages and notebooks: sounds to switch between, with spectrograms in dB SPL."""

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
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.parallel import describe_error
from hlsim.extras import require
from hlsim.report.page import (
    SPECTROGRAM_COLOURS,
    SPECTROGRAM_LEVELS,
    Player,
    Section,
    Sound,
)

_LONGEST_SECONDS = 8.0
"""Length in seconds after which an item is cut on a page."""

NORMAL_EAR = "normal ear (the goal)"
"""Label of clean speech as a normal ear perceives it."""

_PEAK = 0.9  # largest sample of the sounds of a group
_HIGHEST_HZ = 8000.0  # at which MSBG and HASPI end

_EXPLANATION = (
    "What the impaired ear perceives, by MSBG. The goal is what a normal ear perceives of the "
    "clean speech. Switch between the sounds while one plays: the position stays the same."
)


def listening_sections(
    evaluation: Evaluation, count: int, conditions: Sequence[str] = ()
) -> list[Section]:
    """Return the section "Listen" of a page, with one player per item.

    Items are ranked by how much their score changes between the two conditions of the evaluation's
    headline comparison, largest gain first. The items of the section are evenly spaced in this
    ranking. A player has what a normal ear perceives of the clean speech, and what the impaired ear
    perceives under each condition.

    Args:
        evaluation: The evaluation of the page.
        count: Number of items in the section.
        conditions: Names of the conditions to be played; all of them if empty.

    Returns: The section, or an empty list if there is no comparison or ``count`` is 0.

    >>> import pandas
    >>> from hlsim import Audiogram
    >>> from hlsim.evaluation import Condition, Item, compare
    >>> speech = torch.randn(8000, generator=torch.Generator().manual_seed(0))
    >>> item = Item("s01", speech, speech, Audiogram.standard("N3"))
    >>> conditions = [Condition(name, lambda signal, ear: signal) for name in "ab"]
    >>> rows = [(0, "s01", "a", 0.2), (0, "s01", "b", 0.4)]
    >>> table = pandas.DataFrame(rows, columns=["item", "name", "condition", "haspi"])
    >>> evaluation = Evaluation([item], conditions, [], table, compare(table, ["haspi"]))
    >>> (section,) = listening_sections(evaluation, count=1)
    >>> [sound.label for sound in section.sections[0].player.sounds]
    ['normal ear (the goal)', 'a', 'b']
    """
    headline = evaluation.headline
    if headline is None or not count:
        return []
    scores = evaluation.wide(headline.measure)
    changes = (scores[headline.after] - scores[headline.before]).dropna()
    changes = changes.sort_values(ascending=False, kind="stable")
    places = np.linspace(0, len(changes) - 1, min(count, len(changes))).round().astype(int)
    rows = evaluation.table.drop_duplicates("item").set_index("item")
    names = conditions or evaluation.names
    sections = []
    for place in places.tolist():
        row, change = rows.loc[changes.index[place]], changes.iloc[place]
        rank = f"change {change:+.3f}, rank {place + 1} of {len(changes)}"
        title = f"{row['name']} ({headline.title}: {rank})"
        try:
            number = int(row.get("source", row.name))
            sections.append(_item_section(evaluation, number, title, names))
        except Exception as error:  # A sound that cannot be played must not cost the page.
            sections.append(Section(title, [f"It cannot be played: {describe_error(error)}"]))
    return [Section("Listen", [_EXPLANATION], sections=sections)]


def _item_section(
    evaluation: Evaluation, number: int, title: str, conditions: Sequence[str]
) -> Section:
    """Return the player of an item, see ``listening_sections``.

    Args:
        evaluation: The evaluation of the page.
        number: Number of the item.
        title: Heading of the section.
        conditions: Names of the conditions to be played.
    """
    item = evaluation.items[number].load()
    gain, end = gain_to_pascals(item.full_scale_spl), int(_LONGEST_SECONDS * item.sample_rate)
    signals = {NORMAL_EAR: perceive(item.clean[:end].float() * gain, NORMAL, item.sample_rate)}
    for condition in evaluation.conditions:
        if condition.name in conditions:
            with torch.no_grad():
                output = condition.output(item)[:end].float() * gain
            signals[condition.name] = perceive(output, item.ear, item.sample_rate)
    thresholds = ", ".join(f"{level:g}" for level in item.ear.thresholds)
    about = f"{item.ear.severity.capitalize()} loss, thresholds {thresholds} dB HL."
    return Section(title, [about], player=make_player({"": signals}, item.sample_rate))


def make_player(groups: Mapping[str, Mapping[str, Tensor]], sample_rate: int) -> Player:
    """Return a player that switches between sounds, with their spectrograms.

    All sounds of a group have one gain, so that their loudness can be compared. Groups may have
    different gains, because the output of an aid is much louder than what the ear perceives of it.

    Args:
        groups: For each group, under its heading, which may be empty, the signals in pascals, each
            under the label of its button. Shape of each signal: (time,) or (channels, time).
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: All signals of a group are silent.
        MissingExtraError: matplotlib is not installed.

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
        title = heading + (
            f", played {softer:.0f} dB softer than the first row" if softer > 0.5 else ""
        )
        sounds[title] = [
            _make_sound(label, signal, sample_rate, peak) for label, signal in group.items()
        ]
    samples = max(signal.shape[-1] for group in groups.values() for signal in group.values())
    return Player(sounds, samples / sample_rate, _full_scale(first_peak))


def _make_sound(label: str, signal: Tensor, sample_rate: int, peak: float) -> Sound:
    """Encode a signal in pascals, and draw its spectrogram.

    Args:
        label: Name on the button.
        signal: The signal. Shape: (time,) or (channels, time).
        sample_rate: Sample rate in Hz.
        peak: Largest sample of all signals of the group, which is played as 0.9.
    """
    level = float(level_spl(signal.flatten()))
    return Sound(
        label,
        level,
        encode_flac(signal * (_PEAK / peak), sample_rate),
        loudness=level - _full_scale(peak),
        spectrogram=_spectrogram_png(spectrogram_levels(signal, sample_rate)),
    )


def _peak(group: Mapping[str, Tensor]) -> float:
    """Return the largest magnitude of a sample in a group of signals."""
    peak = max(float(signal.abs().max()) for signal in group.values())
    if not peak:
        raise ValueError(
            f"all sounds are silent ({', '.join(group)}); pass a signal with samples other than "
            "zero"
        )
    return peak


def _full_scale(peak: float) -> float:
    """Return the level in dB SPL of full scale if a peak in pascals is played as 0.9."""
    return PASCAL_SPL + 20.0 * math.log10(peak / _PEAK)


def spectrogram_levels(signal: Tensor, sample_rate: int) -> Tensor:
    """Compute the spectrogram of a signal up to 8 kHz, in windows of 20 ms every 10 ms.

    The powers of several channels are averaged.

    Args:
        signal: Signal in pascals. Shape: (time,) or (channels, time).
        sample_rate: Sample rate in Hz.

    Returns: Levels in dB SPL in bins of 50 Hz, at least -46. Shape: (bins, frames).

    >>> spectrogram_levels(torch.zeros(16000), 16000).shape
    torch.Size([161, 101])
    """
    points = 2 * (sample_rate // 100)
    window = torch.hann_window(points)
    spectrum = torch.stft(
        signal.float().cpu(), points, points // 2, window=window, return_complex=True
    )
    magnitude = spectrum.abs().reshape(-1, *spectrum.shape[-2:]).square().mean(0).sqrt()
    levels = 20.0 * torch.log10(magnitude * 2.0**0.5 / window.sum() + 1e-7) + PASCAL_SPL
    return levels[: round(_HIGHEST_HZ * points / sample_rate) + 1]


def _spectrogram_png(levels: Tensor) -> bytes:
    """Return a PNG file with one pixel per bin and frame, of levels in dB SPL (bins, frames)."""
    image = require("PIL.Image", "eval")
    colours = require("matplotlib.colors", "eval").LinearSegmentedColormap
    lowest, highest = SPECTROGRAM_LEVELS
    shares = ((levels - lowest) / (highest - lowest)).clamp(0.0, 1.0)
    pixels = (255.0 * shares).round().to(torch.uint8).flip(0).numpy()
    picture = image.fromarray(pixels)
    palette = colours.from_list("", SPECTROGRAM_COLOURS)(range(256), bytes=True)
    picture.putpalette(palette[:, :3].tobytes())
    data = io.BytesIO()
    picture.save(data, format="PNG", optimize=True)
    return data.getvalue()
