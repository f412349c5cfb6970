"""Properties of an aid that scores of speech do not show.

These are gain curves, steady tones, quiet noise, look-ahead and cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.losses.band_levels import band_centres, band_levels
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread, reason_of
from hlsim.training.clips import Clips

UTTERANCES = 6
"""Number of clips of 3 s of speech that gains are measured on."""

TONES = (250, 500, 1000, 2000, 3001, 4000)
"""Frequencies of steady tones in Hz. Frames that are multiples of 4 ms apart find all of them in one
phase, except 3001 Hz."""

QUIET_LEVELS = (25.0, 40.0)
"""Levels in dB SPL of the noise in a room where nobody speaks."""

_CHANGES = range(8000, 40000, 2003)
"""Samples from which on the input becomes another sound, at many places of any hop."""

_CHANGED = 1e-4
"""Part of the output's peak that counts as a change: Fourier transforms round by less."""

_NEAR_HZ = 20.0
_MIDDLE = slice(
    NEURO_RATE // 2, -NEURO_RATE // 2
)  # in 2 s one second, with whole periods of each tone
_SMALLEST_RATIO, _SMALLEST_POWER = 1e-20, 1e-30  # JSON holds no infinity

Aid = Callable[[Tensor, Audiogram], Tensor]
Aids = Mapping[str, Aid]
Ears = Mapping[str, Audiogram]
Results = list[dict[str, Any]]
"""One dictionary per ear and aid, with the keys ``ear`` and ``aid``."""


def insertion_gain(
    aid: Aid, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> list[list[float]]:
    """Return output power over input power in dB, in 24 bands and over all of the speech.

    The spectrum of speech is what a fitter's speech-shaped noise stands for. Its pauses belong to it, for an
    aid may take noise for noise.

    Args:
        levels: levels of each utterance in dB SPL.

    Shape: (utterances, time) at 16 kHz -> (levels, 24). Raises ValueError as ``outputs``.
    """
    curves = []
    for level in levels:
        signals = set_level(speech, level)
        aided = outputs(aid, signals, ear, f"the output for speech at {level:g} dB SPL")
        curves.append((10.0 * (_band_powers(aided) / _band_powers(signals)).log10()).tolist())
    return curves


def draw_utterances(speech: str | Path, seed: int) -> Tensor:
    """Draw six clips of 3 s from a folder. Shape: -> (6, 48000) at 16 kHz."""
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=3.0)
    return clips.draw(UTTERANCES, torch.Generator().manual_seed(seed))


def gain_curves(aids: Aids, ears: Ears, utterances: Tensor, levels: Sequence[float]) -> Results:
    """Return ``levels``, ``frequencies`` and the insertion gain ``gain_db``, (levels, 24).

    Shape: (utterances, time) at 16 kHz. Raises ValueError as ``outputs``.
    """
    curves = []
    for about, aid, ear in _each(aids, ears):
        try:
            gains = insertion_gain(aid, ear, utterances, levels)
        except ValueError as error:
            raise ValueError(f"{about['aid']}, ear {about['ear']}: {error}") from error
        axes = {"levels": list(levels), "frequencies": band_centres().tolist()}
        curves.append({**about, **axes, "gain_db": gains})
    return curves


def tones(hertz: Sequence[int], levels: Sequence[float]) -> Tensor:
    """Return sines of 2 s at 16 kHz in pascals, each at each level in dB SPL.

    Shape: -> (tones * levels, 32000).
    """
    samples = torch.arange(2 * NEURO_RATE)
    turns = torch.tensor(hertz).unsqueeze(-1) * samples % NEURO_RATE / NEURO_RATE
    sines = (2.0 * torch.pi * turns).sin().repeat_interleave(len(levels), 0)
    return set_level(sines, torch.tensor(levels, dtype=torch.float32).repeat(len(hertz)))


def sidebands_db(waveform: Tensor, hertz: Tensor) -> Tensor:
    """Return the power further than 20 Hz from a tone relative to what is nearer, in dB, at least -200.

    Shape: (items, 32000) and (items,) in Hz -> (items,); the middle second counts.
    """
    middle = waveform[:, _MIDDLE].double()
    window = torch.hann_window(middle.shape[-1], dtype=middle.dtype)
    power = torch.fft.fft(middle * window).abs().square()
    bins = torch.fft.fftfreq(middle.shape[-1], 1.0 / NEURO_RATE).abs()
    near = (bins - hertz.unsqueeze(-1)).abs() <= _NEAR_HZ
    tone, others = (power * near).sum(-1), (power * ~near).sum(-1)
    ratio = (others / tone.clamp_min(_SMALLEST_POWER)).clamp_min(_SMALLEST_RATIO)
    return 10.0 * ratio.log10()


def steady_tones(aids: Aids, ears: Ears, levels: Sequence[float]) -> Results:
    """Return how loud an ear perceives tones after an aid, and what else the aid adds to them.

    ``loudness_error_db`` is the level after the exact MSBG minus that of the tone itself for a normal ear, in
    the middle second; ``sidebands_db`` is that of the output. Both are (levels, frequencies), with ``levels``
    and ``frequencies`` beside them. Raises ValueError as ``outputs``.
    """
    sounds, hertz = tones(TONES, levels), torch.tensor(TONES).repeat_interleave(len(levels))
    normal = _perceived_level(sounds, NORMAL)
    results = []
    for about, aid, ear in _each(aids, ears):
        output = f"{about['aid']}, ear {about['ear']}, steady tones: the output"
        aided = outputs(aid, sounds, ear, output)
        values = {
            "loudness_error_db": _perceived_level(aided, ear) - normal,
            "sidebands_db": sidebands_db(aided, hertz),
        }
        axes = {"levels": list(levels), "frequencies": list(TONES)}
        shaped = {name: v.reshape(len(TONES), -1).T.tolist() for name, v in values.items()}
        results.append({**about, **axes, **shaped})
    return results


def wearing(aids: Aids, ears: Ears, speech: Tensor) -> Results:
    """Return whether an aid can be worn: its look-ahead, its gain for quiet rooms, its cost.

    ``look_ahead_ms`` is how long before the input becomes another sound the output changes by more than 1e-4
    of its peak, the longest of 16 places; ``quiet_gain_db`` the gain in level for white noise at
    ``QUIET_LEVELS``, in the middle two seconds; ``cpu_ms`` the processor's time for one second of sound, on one
    thread. Raises ValueError as ``outputs``.

    Shape: (time,) of 3 s at 16 kHz.
    """
    speech = set_level(speech, 65.0)
    noise = torch.randn(len(speech), generator=torch.Generator().manual_seed(0))
    other, *quiet = (set_level(noise, level) for level in (65.0, *QUIET_LEVELS))
    changed = [torch.cat((speech[:place], other[place:])) for place in _CHANGES]
    signals = [speech, *changed, *quiet]
    results = []
    for about, aid, ear in _each(aids, ears):
        output = f"{about['aid']}, ear {about['ear']}, changed speech: the output"
        with one_thread():
            start = time.process_time()
            aided = outputs(aid, signals, ear, output)
            seconds = time.process_time() - start
        ahead = samples_ahead(aided[0], aided[1 : -len(quiet)], _CHANGES)
        gains = [
            float(level_spl(after[_MIDDLE]) - level_spl(before[_MIDDLE]))
            for after, before in zip(aided[-len(quiet) :], quiet, strict=True)
        ]
        cost = 1000.0 * seconds * NEURO_RATE / (len(signals) * len(speech))
        values = {"look_ahead_ms": 1000.0 * ahead / NEURO_RATE, "quiet_gain_db": gains}
        results.append({**about, **values, "cpu_ms": cost})
    return results


def samples_ahead(unchanged: Tensor, changed: Iterable[Tensor], places: Iterable[int]) -> int:
    """Return how long before the input becomes another sound an output changes by 1e-4 of its peak.

    Args:
        unchanged: output for the input without a change.
        changed: output for the input that changes at each of the places.

    Shape: (..., time), and one such output per place. Returns samples: the most of all places, 0 if no
    output changes early.
    """
    threshold, most = _CHANGED * float(unchanged.abs().max()), 0
    for output, place in zip(changed, places, strict=True):
        difference = (output - unchanged).abs().reshape(-1, unchanged.shape[-1]).amax(0)
        differs = difference > threshold
        if differs.any():
            most = max(most, place - int(differs.int().argmax()))
    return most


def outputs(aid: Aid, signals: Iterable[Tensor], ear: Audiogram, what: str) -> Tensor:
    """Return the outputs of an aid for several signals, processed one at a time.

    Shape: signals of (time,) -> (signals, time).

    Raises:
        ValueError: the aid fails, or its output is not a finite tensor of the input's shape; the message
            begins with ``what``.
    """
    aided: list[Tensor] = []
    for signal in signals:
        try:
            with torch.no_grad():
                output = aid(signal, ear)
        except Exception as error:  # the module may be anyone's
            raise ValueError(f"{what}: {reason_of(error)}") from error
        if not isinstance(output, Tensor) or output.shape != signal.shape:
            shape = getattr(output, "shape", type(output).__name__)
            raise ValueError(f"{what} is {shape}, expected a tensor of shape {tuple(signal.shape)}")
        if not output.isfinite().all():
            raise ValueError(f"{what} has samples that are NaN or infinite")
        aided.append(output)
    return torch.stack(aided)


def _each(aids: Aids, ears: Ears) -> Iterator[tuple[dict[str, Any], Aid, Audiogram]]:
    for (ear_name, ear), (name, aid) in product(ears.items(), aids.items()):
        yield {"aid": name, "ear": ear_name}, aid, ear


def _band_powers(signal: Tensor) -> Tensor:
    """Return the mean power of each band. Shape: (utterances, time) -> (24,)."""
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))


def _perceived_level(sounds: Tensor, ear: Audiogram) -> Tensor:
    """Return the level of the middle second in dB SPL. Shape: (items, time) -> (items,)."""
    return level_spl(perceive(sounds, ear, NEURO_RATE)[:, _MIDDLE])
