"""The signals on which simulators are compared: speech, ears and levels, as they are and as hearing aids change them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators.nalr import NALR
from hlsim.audiogram import MILDER, Audiogram, draw_thresholds, read_audiograms
from hlsim.calibration import level_spl
from hlsim.data.augment import compress, mix
from hlsim.data.clips import Clips
from hlsim.evaluation.store import samples_hash
from hlsim.neuro.config import NEURO_RATE

LEVELS = (50.0, 60.0, 65.0, 70.0, 80.0)
"""Levels in dB SPL that the items take in turn."""

SNRS_DB = (2.5, 7.5, 12.5, 17.5)
"""Signal-to-noise ratios of the noisy items, the paper's test set."""

INPUTS = ("as-is", "louder", "nal-r", "compressed")
"""What may be done to a signal before the ear gets it: nothing, 20 dB more, NAL-R for the ear, compression 3:1. A
compensator adds ``compensated``."""


@dataclass(frozen=True)
class Item:
    """A signal for an ear, in pascals at 16 kHz.

    Attributes:
        clean, signal: (time,); ``signal`` is what the ear gets, ``clean`` the speech in it, before treatment.
        about: severity, level (dB SPL before treatment), condition (clean or noisy), noise_snr (dB; None where clean),
            input, audiogram.
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
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=seconds)
    noises = Clips(noise, sample_rate=NEURO_RATE, seconds=seconds, repeat=True) if noise is not None else None
    measured = [ear for _, ear in read_audiograms(audiograms, simulated=True)]
    chosen = []
    for i in range(items):
        clean = clips.draw(1, generator)
        condition = "noisy" if noises is not None and i % 2 else "clean"
        kind, around = (i // 2) % 4, i // 8
        # moved on, or ratios and levels of an even number would go round together
        slip = 0 if len(levels) % 2 else around // len(levels)
        level = levels[(kind + around) % len(levels)]
        snr = SNRS_DB[(kind + around + slip) % len(SNRS_DB)]
        signal = clean
        if noises is not None and condition == "noisy":
            signal = mix(clean, noises.draw(1, generator), torch.tensor([snr]))
        if kind < 2:
            ear = measured[int(torch.randint(len(measured), (), generator=generator))]
        elif kind == 2:
            ear = Audiogram.standard(MILDER[(around + around // 4 + slip) % len(MILDER)])
        else:
            ear = Audiogram(tuple(draw_thresholds(1, generator).squeeze(0).tolist()))
        gain = 10.0 ** ((level - float(level_spl(signal))) / 20.0)
        about = {
            "severity": ear.severity,
            "level": level,
            "condition": condition,
            "noise_snr": snr if condition == "noisy" else None,
            "input": "as-is",
            "audiogram": list(ear.thresholds),
        }
        chosen.append(Item((clean * gain).squeeze(0), (signal * gain).squeeze(0), ear, about))
    return chosen


def treat(
    items: Sequence[Item], inputs: Sequence[str], compensator: nn.Module | None = None
) -> Iterator[Item]:
    """Each item under each input in turn.

    Args:
        inputs: of ``INPUTS``, and ``compensated`` where there is a compensator.

    Raises:
        ValueError: an input that is none of these.
    """
    treatments: dict[str, Callable[[Item], Tensor]] = {
        "as-is": lambda item: item.signal,
        "louder": lambda item: 10.0 * item.signal,
        "nal-r": _nalr,
        "compressed": lambda item: compress(
            item.signal.unsqueeze(0), torch.tensor([3.0]), NEURO_RATE
        ).squeeze(0),
    }
    if compensator is not None:
        treatments["compensated"] = lambda item: compensator(item.signal, item.ear)
    if unknown := [name for name in inputs if name not in treatments]:
        raise ValueError(
            f"input {unknown[0]!r}; allowed: {', '.join(treatments)}, and compensated with a compensator"
        )
    for item in items:
        for name in inputs:
            with torch.no_grad():
                signal = treatments[name](item)
            yield Item(item.clean, signal, item.ear, {**item.about, "input": name})


def _nalr(item: Item) -> Tensor:
    aided: Tensor = NALR(item.ear, sample_rate=NEURO_RATE)(item.signal)
    return aided
