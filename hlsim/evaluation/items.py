"""Drawn items: speech in noise for the ears and levels of a study, all from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import count, product
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn

from compensators.nalr import NALR
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.checks import check_choice
from hlsim.evaluation.study import Item
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.augment import compress, mix
from hlsim.training.clips import Clips
from hlsim.training.ears import MILDER, draw_thresholds

SIMULATOR_LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels in dB SPL that items for simulators take in turn."""

INPUT_LEVELS = (50.0, 65.0, 80.0)
"""Levels of the clean speech in dB SPL that items for compensators take in turn."""

SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios in dB that noisy items take in turn, the paper's."""

STANDARD_EARS = ("N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")
"""Bisgaard's audiograms that are in every comparison of compensators."""

Treatment = Literal["as-is", "louder", "nal-r", "compressed", "compensated"]
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

    Half of the ears are those of the file, a quarter the milder standard ones (NH, N1, N2, S1) and a quarter
    random. With noise every second item is noisy. With four ratios and five levels, each kind of
    ear meets each of them together once in 160 items.
    """
    generator = torch.Generator().manual_seed(seed)
    measured = [ear for _, ear in read_audiograms(audiograms, simulated=True)]
    drawn = []
    for number, (clean, masker) in zip(
        range(items), _clips(speech, noise, seconds, generator), strict=False
    ):
        kind, turn = (number // 2) % 4, number // 8
        level, snr, shift = _level_and_snr(kind, turn, levels)
        if masker is None:
            snr = math.nan
        if kind < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif kind == 2:
            ear = Audiogram.standard(MILDER[(turn + turn // 4 + shift) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        signal = _mixed(clean, masker, snr)
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        facts = _facts(ear, level, noise_snr=snr)
        name = f"item {number}"
        clean, signal = (clean * gain).squeeze(0), (signal * gain).squeeze(0)
        drawn.append(Item(name, clean, signal, ear, facts=facts))
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
    """Draw items for compensators: random clips for the ears in turn, with noise every second one noisy.

    The clean speech has one of the levels, and the noise comes on top. Every ear meets every level and, in the
    noisy items, every ratio with it.
    """
    drawn = []
    clips = _clips(speech, noise, seconds, torch.Generator().manual_seed(seed))
    for number, (clip, masker) in zip(range(items), clips, strict=False):
        turn, place = divmod(number if noise is None else number // 2, len(ears))
        name, ear = ears[place]
        level, snr, _ = _level_and_snr(place, turn, levels)
        if masker is None:
            snr = math.nan
        clean = set_level(clip, level)
        signal = _mixed(clean, masker, snr).squeeze(0)
        drawn.append(
            Item(
                f"item {number}",
                clean.squeeze(0),
                signal,
                ear,
                seed=(seed + number) % 2**32,
                facts={"ear": name, **_facts(ear, level, snr=snr)},
            )
        )
    return drawn


def read_ears(audiograms: str | Path | None) -> list[tuple[str, Audiogram]]:
    """Return the standard ears and those of a CSV file, named by listener and ear or by row.

    No two ears have the same name. A standard ear that is in the file too is returned once.
    """
    ears = [(name, Audiogram.standard(name)) for name in STANDARD_EARS]
    rows = read_audiograms(audiograms, simulated=True) if audiograms is not None else []
    for number, (row, ear) in enumerate(rows, start=1):
        name = " ".join(filter(None, (row.get("listener"), row.get("ear"))))
        if (name, ear) in ears:
            continue
        if name in (known for known, _ in ears):
            name += f", row {number}"
        ears.append((name or f"row {number}", ear))
    return ears


def treat(
    items: Sequence[Item],
    treatments: Sequence[Treatment],
    compensator: nn.Module | None = None,
) -> list[Item]:
    """Return each item under each treatment in turn, named in its fact ``treatment``.

    Raises:
        ValueError: an unknown treatment, or ``compensated`` without a compensator.
    """
    functions: dict[str, Callable[[Tensor, Any], Tensor]] = {
        "as-is": lambda signal, ear: signal,
        "louder": lambda signal, ear: 10.0 * signal,
        "nal-r": NALR(sample_rate=NEURO_RATE),
        "compressed": _compressed,
    }
    if compensator is not None:
        functions["compensated"] = compensator
    elif "compensated" in treatments:
        raise ValueError("the treatment compensated needs a compensator")
    for treatment in treatments:
        check_choice("treatment", treatment, Treatment)
    treated = []
    for item, treatment in product(items, treatments):
        with torch.no_grad():
            signal = functions[treatment](item.signal, item.ear)
        facts = {**item.facts, "treatment": treatment}
        treated.append(Item(item.name, item.clean, signal, item.ear, facts=facts))
    return treated


TREATMENTS = get_args(Treatment)


def _compressed(signal: Tensor, ear: Audiogram) -> Tensor:
    return compress(signal[None], torch.tensor([3.0]), NEURO_RATE)[0]


def _level_and_snr(place: int, turn: int, levels: Sequence[float]) -> tuple[float, float, int]:
    """Return level and SNR of an ear's turn: each turn moves both on, so that no ear keeps to one.

    Returns also how often the ratios have moved on alone; with an even number of levels both would
    otherwise go round together.
    """
    shift = 0 if len(levels) % 2 else turn // len(levels)
    number = place + turn
    return levels[number % len(levels)], SNRS_DB[(number + shift) % len(SNRS_DB)], shift


def _clips(
    speech: str | Path, noise: str | Path | None, seconds: float, generator: torch.Generator
) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Yield speech and, every second time, a noise to mix in. Shape: (1, time)."""
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=seconds)
    noises = None
    if noise is not None:
        noises = Clips(noise, sample_rate=NEURO_RATE, seconds=seconds, repeat=True)
    for number in count():
        clean = clips.draw(1, generator)
        noisy = noises is not None and number % 2
        yield clean, noises.draw(1, generator) if noises is not None and noisy else None


def _mixed(clean: Tensor, noise: Tensor | None, snr: float) -> Tensor:
    return clean if noise is None else mix(clean, noise, torch.tensor([snr]))


def _facts(ear: Audiogram, level: float, **snr: float) -> dict[str, Any]:
    clean = all(math.isnan(value) for value in snr.values())
    return {
        "severity": ear.severity,
        "input_level": level,
        "speech": "clean" if clean else "noisy",
        **snr,
        "audiogram": list(ear.thresholds),
    }
