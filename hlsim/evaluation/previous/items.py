"""The signals on which simulators and compensators are compared: speech in noise, ears and levels, all from a seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, product
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from compensators.nalr import NALR
from hlsim.audiogram import Audiogram
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.previous.keys import samples_hash
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.augment import compress, mix
from hlsim.training.clips import Clips
from hlsim.training.ears import MILDER, draw_thresholds

TEST_SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios in dB of VoiceBank-DEMAND's test set."""

LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels in dB SPL that the items for simulators take in turn."""

INPUT_LEVELS = (50.0, 65.0, 80.0)
"""Levels of the clean speech in dB SPL that the items for compensators take in turn."""

STANDARD_EARS = ("N2", "N3", "N4", "N5", "N6", "S1", "S2", "S3")
"""Bisgaard's audiograms that are in every comparison of compensators."""

Input = Literal["as-is", "louder", "nal-r", "compressed", "compensated"]
"""What may be done to a signal before the ear gets it: nothing, 20 dB more, NAL-R for the ear, compression 3:1. A
compensator adds ``compensated``."""


@dataclass(frozen=True)
class Item:
    """A signal for an ear, in pascals at 16 kHz.

    ``signal`` (time,) is what the ear gets, ``clean`` (time,) the speech in it, before treatment. ``about`` has severity,
    level (dB SPL before treatment), condition (clean or noisy), noise_snr (dB; None where clean), input, audiogram.
    """

    clean: Tensor
    signal: Tensor
    ear: Audiogram
    about: Mapping[str, Any]

    def settings(self) -> dict[str, Any]:
        """What its scores are stored under, beside what scores it."""
        return {"signal": samples_hash(self.clean, self.signal), "ear": list(self.ear.thresholds)}


def draw_items(
    speech: str | Path,
    noise: str | Path | None,
    audiograms: str | Path,
    *,
    items: int,
    seconds: float,
    seed: int,
    levels: Sequence[float] = LEVELS,
) -> list[Item]:
    """Items of input ``as-is``. All is drawn from the seed.

    Half of the ears are those of the file, a quarter the milder standard ones (NH, N1, N2, S1), a quarter drawn; with
    noise every second item is noisy. With four ratios and five levels, each kind of ear meets each of them together
    once in 160 items.
    """
    generator = torch.Generator().manual_seed(seed)
    measured = [ear for _, ear in read_audiograms(audiograms, simulated=True)]
    chosen = []
    for i, (clean, masker) in zip(
        range(items), _clips(speech, noise, seconds, generator), strict=False
    ):
        kind, around = (i // 2) % 4, i // 8
        level, ratio, slip = _turn(kind, around, levels)
        snr = None if masker is None else ratio
        signal = _mixed(clean, masker, snr)
        if kind < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif kind == 2:
            ear = Audiogram.standard(MILDER[(around + around // 4 + slip) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        about = _about(ear, level, snr, "noise_snr") | {
            "input": "as-is",
            "audiogram": list(ear.thresholds),
        }
        chosen.append(Item((clean * gain).squeeze(0), (signal * gain).squeeze(0), ear, about))
    return chosen


def _turn(number: int, around: int, levels: Sequence[float]) -> tuple[float, float, int]:
    """Level and SNR of an ear's turn: each round moves both on, so that no ear keeps to one.

    Returns also how often the ratios moved on alone, or with levels of an even number both would go round together.
    """
    slip = 0 if len(levels) % 2 else around // len(levels)
    turn = number + around
    return levels[turn % len(levels)], TEST_SNRS_DB[(turn + slip) % len(TEST_SNRS_DB)], slip


def read_ears(audiograms: str | Path | None) -> list[tuple[str, Audiogram]]:
    """The standard ears and those of a CSV file; the latter named by listener and ear, or row, and no two alike."""
    ears = [(name, Audiogram.standard(name)) for name in STANDARD_EARS]
    rows = read_audiograms(audiograms, simulated=True) if audiograms is not None else []
    for number, (row, ear) in enumerate(rows, start=1):
        named = " ".join(filter(None, (row.get("listener"), row.get("ear"))))
        if named in (name for name, _ in ears):
            named += f", row {number}"  # items of one name would count as one ear's
        ears.append((named or f"row {number}", ear))
    return ears


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
    """Random clips for the ears in turn, with noise every second one noisy; all is drawn from the seed.

    An item's speech has one of ``levels``, and its noise comes on top. Every ear meets every level and, of the noisy
    items, every ratio of 2.5 to 17.5 dB with it.

    Returns: items whose ``about`` has name (of the ear), severity, level, condition, snr (None without noise).
    """
    chosen = []
    clips = _clips(speech, noise, seconds, torch.Generator().manual_seed(seed))
    for i, (drawn, masker) in zip(range(items), clips, strict=False):
        around, number = divmod(i if noise is None else i // 2, len(ears))
        name, ear = ears[number]
        level, ratio, _ = _turn(number, around, levels)
        snr = None if masker is None else ratio
        clean = set_level(drawn, level)
        signal = _mixed(clean, masker, snr).squeeze(0)
        chosen.append(
            Item(clean.squeeze(0), signal, ear, {"name": name, **_about(ear, level, snr, "snr")})
        )
    return chosen


def _clips(
    speech: str | Path, noise: str | Path | None, seconds: float, generator: torch.Generator
) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Speech, every second time with a noise to mix in, where there are any. Shape: (1, time)."""
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=seconds)
    noises = (
        Clips(noise, sample_rate=NEURO_RATE, seconds=seconds, repeat=True)
        if noise is not None
        else None
    )
    for i in count():
        clean = clips.draw(1, generator)
        yield clean, noises.draw(1, generator) if noises is not None and i % 2 else None


def _mixed(clean: Tensor, noise: Tensor | None, snr: float | None) -> Tensor:
    return clean if noise is None or snr is None else mix(clean, noise, torch.tensor([snr]))


def _about(ear: Audiogram, level: float, snr: float | None, name: str) -> dict[str, Any]:
    condition = "clean" if snr is None else "noisy"
    return {"severity": ear.severity, "level": level, "condition": condition, name: snr}


def treat(
    items: Sequence[Item], inputs: Sequence[Input], compensator: nn.Module | None = None
) -> Iterator[Item]:
    """Each item under each input in turn: ValueError for ``compensated`` without a compensator."""
    treatments: dict[str, Callable[[Tensor, Audiogram], Tensor]] = {
        "as-is": lambda signal, ear: signal,
        "louder": lambda signal, ear: 10.0 * signal,
        "nal-r": NALR(sample_rate=NEURO_RATE),
        "compressed": lambda signal, ear: compress(signal[None], torch.tensor([3.0]), NEURO_RATE)[
            0
        ],
    }
    if compensator is not None:
        treatments["compensated"] = compensator
    if unknown := [name for name in inputs if name not in treatments]:
        raise ValueError(
            f"input {unknown[0]!r}; allowed: {', '.join(treatments)}, and compensated with a compensator"
        )
    for item, name in product(items, inputs):
        with torch.no_grad():
            signal = treatments[name](item.signal, item.ear)
        yield Item(item.clean, signal, item.ear, {**item.about, "input": name})
