"""Drawn items: speech in noise for the ears and levels of a study, all from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators.nalr import NALR
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.study import Item
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.augment import compress, mix
from hlsim.training.clips import Clips
from hlsim.training.ears import MILDER, draw_thresholds

SIMULATOR_LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels of the input in dB SPL that items for simulators have in turn."""

INPUT_LEVELS = (50.0, 65.0, 80.0)
"""Levels of the clean speech in dB SPL that items for compensators have in turn."""

SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios in dB that noisy items have in turn, as in the paper."""

STANDARD_EARS = ("N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")
"""Bisgaard's audiograms that are part of every comparison of compensators."""

TREATMENTS = ("as-is", "louder", "nal-r", "compressed", "compensated")
"""Processing of the input of a simulator: none, 20 dB of gain, NAL-R for the ear, compression of
3:1, or a compensator."""


def draw_items(
    speech: str | Path,
    noise: str | Path | None,
    audiograms: str | Path,
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = SIMULATOR_LEVELS,
) -> list[Item]:
    """Draw items for simulators.

    Half of the ears are from ``audiograms``, a quarter are mild standard ears (NH, N1, N2, S1) and
    a quarter are random. With noise, every second item is noisy, with one of four signal-to-noise
    ratios in turn. With five levels, 160 items contain each combination of ratio, level and kind of
    ear once.

    Args:
        speech, noise: Folders of recordings.
        audiograms: CSV file of ears, or ``"standard"``.
        items: Number of items.
        seconds: Length of an item.
        seed: Seed of all random draws.
        levels: Levels of the signal in dB SPL, in turn.

    >>> from hlsim.shortcuts import EXAMPLE_FILE
    >>> settings = {"items": 2, "seconds": 1.0, "seed": 0}
    >>> [item.name for item in draw_items(EXAMPLE_FILE.parent, None, "standard", **settings)]
    ['item 0', 'item 1']
    """
    generator = torch.Generator().manual_seed(seed)
    measured = [ear for _, ear in read_audiograms(audiograms, simulated=True)]
    drawn = []
    for number, clean, masker in _draw_clips(speech, noise, items, seconds, generator):
        kind, turn = (number // 2) % 4, number // 8
        level, snr, shift = _level_and_snr(kind, turn, levels)
        if kind < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif kind == 2:
            ear = Audiogram.standard(MILDER[(turn + turn // 4 + shift) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        signal, snr = _add_noise(clean, masker, snr)
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        facts = _facts(ear, level, "noise_snr", snr)
        drawn.append(Item(f"item {number}", clean * gain, signal * gain, ear, facts=facts))
    return drawn


def draw_judged_items(
    speech: str | Path,
    noise: str | Path | None,
    ears: Sequence[tuple[str, Audiogram]],
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = INPUT_LEVELS,
) -> list[Item]:
    """Draw items for compensators: random clips for the ears in turn.

    The level is that of the clean speech. With noise, every second item is noisy. Every ear meets
    every combination of level and ratio.

    Args:
        speech, noise: Folders of recordings.
        ears: Ears with their names.
        items: Number of items.
        seconds: Length of an item.
        seed: Seed of all random draws.
        levels: Levels of the clean speech in dB SPL, in turn.

    >>> from hlsim.shortcuts import EXAMPLE_FILE
    >>> settings = {"items": 1, "seconds": 1.0, "seed": 0}
    >>> (item,) = draw_judged_items(EXAMPLE_FILE.parent, None, read_ears(None), **settings)
    >>> item.facts["ear"], item.facts["input_level"]
    ('N2', 50.0)
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for number, clip, masker in _draw_clips(speech, noise, items, seconds, generator):
        turn, place = divmod(number if noise is None else number // 2, len(ears))
        ear_name, ear = ears[place]
        level, snr, _ = _level_and_snr(place, turn, levels)
        clean = set_level(clip, level)
        signal, snr = _add_noise(clean, masker, snr)
        facts = {"ear": ear_name, **_facts(ear, level, "snr", snr)}
        item_seed = (seed + number) % 2**32
        drawn.append(Item(f"item {number}", clean, signal, ear, seed=item_seed, facts=facts))
    return drawn


def read_ears(audiograms: str | Path | None) -> list[tuple[str, Audiogram]]:
    """Return the standard ears and those of a CSV file, named by listener and ear or by row.

    No two ears have the same name. A standard ear that is also in the file is returned once.

    >>> [name for name, _ in read_ears(None)]
    ['N2', 'N3', 'N4', 'N5', 'N6', 'S1', 'S2', 'S3']
    """
    ears = [(name, Audiogram.standard(name)) for name in STANDARD_EARS]
    rows = read_audiograms(audiograms, simulated=True) if audiograms is not None else []
    for number, (row, ear) in enumerate(rows, start=1):
        name = " ".join(filter(None, (row.get("listener"), row.get("ear"))))
        if (name, ear) in ears:
            continue
        if name in dict(ears):
            name += f", row {number}"
        ears.append((name or f"row {number}", ear))
    return ears


def treat(
    items: Sequence[Item], treatments: Sequence[str], compensator: nn.Module | None = None
) -> list[Item]:
    """Return each item under each treatment in turn, named in its fact ``treatment``.

    Args:
        items: Items.
        treatments: Names in ``TREATMENTS``.
        compensator: The compensator of the treatment ``compensated``.

    Raises:
        ValueError: A treatment is unknown, or ``compensated`` lacks a compensator.

    >>> clean = torch.ones(1600)
    >>> item = Item("item 1", clean, clean, Audiogram.standard("N3"))
    >>> [float(item.signal[0]) for item in treat([item], ["as-is", "louder"])]
    [1.0, 10.0]
    """
    functions: dict[str, Callable[[Tensor, Any], Tensor]] = {
        "as-is": lambda signal, ear: signal,
        "louder": lambda signal, ear: 10.0 * signal,
        "nal-r": NALR(sample_rate=NEURO_RATE),
        "compressed": lambda signal, ear: compress(signal[None], torch.tensor([3.0]), NEURO_RATE)[
            0
        ],
    }
    if compensator is not None:
        functions["compensated"] = compensator
    treated = []
    for item, treatment in product(items, treatments):
        if treatment not in functions:
            raise ValueError(
                f"expected the inputs {', '.join(functions)}, got {treatment!r}; the input "
                "compensated needs a compensator"
            )
        with torch.no_grad():
            signal = functions[treatment](item.signal, item.ear)
        facts = {**item.facts, "treatment": treatment}
        treated.append(Item(item.name, item.clean, signal, item.ear, facts=facts))
    return treated


def _draw_clips(
    speech: str | Path,
    noise: str | Path | None,
    items: int,
    seconds: float,
    generator: torch.Generator,
) -> Iterator[tuple[int, Tensor, Tensor | None]]:
    """Yield the number of each item, its speech, and for every second item a noise to add.

    Shape: (time,).
    """
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=seconds)
    noises = None
    if noise is not None:
        noises = Clips(noise, sample_rate=NEURO_RATE, seconds=seconds, repeat=True)
    for number in range(items):
        clean = clips.draw(1, generator)[0]
        is_noisy = noises is not None and number % 2 == 1
        yield number, clean, noises.draw(1, generator)[0] if noises and is_noisy else None


def _level_and_snr(place: int, turn: int, levels: Sequence[float]) -> tuple[float, float, int]:
    """Return level and SNR of an ear's turn. Each turn shifts both, so that all combinations occur.

    Returns also how often the ratios were shifted once more: with an even number of levels, both
    would otherwise repeat together.
    """
    shift = 0 if len(levels) % 2 else turn // len(levels)
    number = place + turn
    return levels[number % len(levels)], SNRS_DB[(number + shift) % len(SNRS_DB)], shift


def _add_noise(clean: Tensor, noise: Tensor | None, snr: float) -> tuple[Tensor, float]:
    """Return the noisy signal and its SNR in dB, which is NaN without noise."""
    if noise is None:
        return clean, math.nan
    return mix(clean[None], noise[None], torch.tensor([snr]))[0], snr


def _facts(ear: Audiogram, level: float, snr_column: str, snr: float) -> dict[str, Any]:
    return {
        "severity": ear.severity,
        "input_level": level,
        "speech": "clean" if math.isnan(snr) else "noisy",
        snr_column: snr,
        "audiogram": list(ear.thresholds),
    }
