"""What scores of speech do not show: gain by frequency, tones, quiet noise, latency and cost."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.previous.judging import NORMAL
from hlsim.losses.band_levels import band_centres, band_levels
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread, reason_of
from hlsim.training.clips import Clips

UTTERANCES = 6
"""Clips of 3 s of speech that gains are measured on."""

TONES = (250, 500, 1000, 2000, 3001, 4000)
"""In Hz. Frames that are multiples of 4 ms apart all find the others in one phase, but not 3001 Hz."""

QUIET = (25.0, 40.0)
"""Levels in dB SPL of the noise of a room where nobody speaks."""

_CHANGES = range(
    8000, 40000, 2003
)  # samples from which on the input is another, at many places of any hop
_CHANGED = 1e-4  # of the output's peak: Fourier transforms round by less
_NEAR_HZ = 20.0
_MIDDLE = slice(NEURO_RATE // 2, -NEURO_RATE // 2)  # one second: every tone has whole periods in it
_LEAST, _SILENCE = 1e-20, 1e-30  # smallest ratio of powers, and power: JSON holds no infinity


def insertion_gain(
    compensator: nn.Module, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> list[list[float]]:
    """Power out over power in, in dB, in 24 ERB-wide bands (``hlsim.losses.band_levels``), over all of the speech.

    Its spectrum is what a fitter's speech-shaped noise stands for; its pauses are in it, for a compensator may take noise
    for noise. ``levels`` are of each utterance in dB SPL. ValueError as ``outputs``.

    Shape: (utterances, time) at 16 kHz -> (levels, 24).
    """
    curves = []
    for level in levels:
        given = set_level(speech, level)
        aided = outputs(compensator, given, ear, f"the output for speech at {level:g} dB SPL")
        curves.append((10.0 * (_powers(aided) / _powers(given)).log10()).tolist())
    return curves


def draw_utterances(speech: str | Path, seed: int) -> Tensor:
    """Six clips of 3 s from a folder, drawn from the seed. Shape: -> (6, 48000) at 16 kHz."""
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=3.0)
    return clips.draw(UTTERANCES, torch.Generator().manual_seed(seed))


def gain_curves(
    compensators: Mapping[str, nn.Module],
    ears: Mapping[str, Audiogram],
    utterances: Tensor,
    levels: Sequence[float],
) -> list[dict[str, Any]]:
    """The curves of every compensator for every ear. Shape: (utterances, time) at 16 kHz. ValueError as ``outputs``.

    Returns: for each ``{"compensator", "ear", "levels", "frequencies", "gain_db": (levels, 24)}``.
    """
    curves = []
    for (ear_name, ear), (name, compensator) in product(ears.items(), compensators.items()):
        try:
            gains = insertion_gain(compensator, ear, utterances, levels)
        except ValueError as error:
            raise ValueError(f"{name}, ear {ear_name}: {error}") from error
        about = {"compensator": name, "ear": ear_name, "levels": [*levels]}
        curves.append({**about, "frequencies": band_centres().tolist(), "gain_db": gains})
    return curves


def _powers(signal: Tensor) -> Tensor:
    """Mean power of each band. Shape: (utterances, time) -> (24,)."""
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))


def tones(hertz: Sequence[int], levels: Sequence[float]) -> Tensor:
    """Sines of 2 s at 16 kHz in pascals, each at each level in dB SPL. Shape: -> (tones * levels, 32000)."""
    turns = (
        torch.tensor(hertz).unsqueeze(-1) * torch.arange(2 * NEURO_RATE) % NEURO_RATE / NEURO_RATE
    )
    sines = (2.0 * torch.pi * turns).sin().repeat_interleave(len(levels), 0)
    return set_level(sines, torch.tensor(levels, dtype=torch.float32).repeat(len(hertz)))


def sidebands_db(waveform: Tensor, hertz: Tensor) -> Tensor:
    """Power further than 20 Hz from a tone relative to what is nearer, in dB, at least -200; of one second, Hann window.

    Shape: (items, 32000) and (items,) in Hz -> (items,).
    """
    middle = waveform[:, _MIDDLE].double()
    window = torch.hann_window(middle.shape[-1], dtype=middle.dtype)
    power = torch.fft.fft(middle * window).abs().square()
    bins = torch.fft.fftfreq(middle.shape[-1], 1.0 / NEURO_RATE).abs()
    near = (bins - hertz.unsqueeze(-1)).abs() <= _NEAR_HZ
    return _ratio_db((power * ~near).sum(-1), (power * near).sum(-1))


def steady_tones(
    compensators: Mapping[str, nn.Module], ears: Mapping[str, Audiogram], levels: Sequence[float]
) -> list[dict[str, Any]]:
    """How loud the ear hears tones after each compensator, and what else the compensator adds to them.

    ``heard_off_db`` is the level after the exact MSBG less what a normal ear hears there of the tone itself, in the
    middle second; ``sidebands_db`` is of the compensator's output. ValueError as ``outputs``.

    Returns: for each ``{"compensator", "ear", "levels", "frequencies", "heard_off_db", "sidebands_db"}``, the last two
    (levels, frequencies).
    """
    sounds, hertz = tones(TONES, levels), torch.tensor(TONES).repeat_interleave(len(levels))
    normal = _heard(sounds, NORMAL)
    found = []
    for (ear_name, ear), (name, compensator) in product(ears.items(), compensators.items()):
        aided = outputs(
            compensator, sounds, ear, f"{name}, ear {ear_name}, steady tones: the output"
        )
        figures = {
            "heard_off_db": _heard(aided, ear) - normal,
            "sidebands_db": sidebands_db(aided, hertz),
        }
        about = {"compensator": name, "ear": ear_name, "levels": [*levels], "frequencies": [*TONES]}
        shaped = {key: values.reshape(len(TONES), -1).T.tolist() for key, values in figures.items()}
        found.append({**about, **shaped})
    return found


def wearing(
    compensators: Mapping[str, nn.Module], ears: Mapping[str, Audiogram], speech: Tensor
) -> list[dict[str, Any]]:
    """Whether a compensator could be worn: how far it looks ahead, how loud it makes quiet rooms, what it costs.

    ``latency_ms`` is how long before the input becomes another sound the output changes by more than 1e-4 of its peak,
    the longest of 16 places; ``quiet_gain_db`` the level gained by white noise at ``QUIET``, in the middle two seconds;
    ``cpu_ms`` the processor's time for a second of sound, on one thread. ValueError as ``outputs``.

    Shape: (time,) of 3 s at 16 kHz.
    """
    speech = set_level(speech, 65.0)
    noise = torch.randn(len(speech), generator=torch.Generator().manual_seed(0))
    other, *quiet = (set_level(noise, level) for level in (65.0, *QUIET))
    given = [speech, *(torch.cat((speech[:at], other[at:])) for at in _CHANGES), *quiet]
    found = []
    for (ear_name, ear), (name, compensator) in product(ears.items(), compensators.items()):
        with one_thread():
            start = time.process_time()
            aided = outputs(
                compensator, given, ear, f"{name}, ear {ear_name}, changed speech: the output"
            )
            seconds = time.process_time() - start
        ahead = samples_ahead(aided[0], aided[1 : -len(quiet)], _CHANGES)
        gains = [
            float(level_spl(own[_MIDDLE]) - level_spl(sound[_MIDDLE]))
            for own, sound in zip(aided[-len(quiet) :], quiet, strict=True)
        ]
        figures = {"latency_ms": 1000.0 * ahead / NEURO_RATE, "quiet_gain_db": gains}
        cost = {"cpu_ms": 1000.0 * seconds * NEURO_RATE / (len(given) * len(speech))}
        found.append({"compensator": name, "ear": ear_name, **figures, **cost})
    return found


def samples_ahead(unchanged: Tensor, changed: Iterable[Tensor], places: Iterable[int]) -> int:
    """How long before the input becomes another sound, at one of ``places``, an output changes by 1e-4 of its peak.

    Shape: (..., time), and one such output a place -> the most samples of all places, 0 where none is early.
    """
    least, most = _CHANGED * float(unchanged.abs().max()), 0
    for other, place in zip(changed, places, strict=True):
        apart = (other - unchanged).abs().reshape(-1, unchanged.shape[-1]).amax(0) > least
        if apart.any():
            most = max(most, place - int(apart.int().argmax()))
    return most


def outputs(compensator: nn.Module, signals: Iterable[Tensor], ear: Audiogram, what: str) -> Tensor:
    """What a compensator gives, one signal at a time.

    Shape: signals of (time,) -> (signals, time). ValueError, which says of ``what``, where it fails, or gives anything
    but as many finite samples.
    """
    made: list[Tensor] = []
    for signal in signals:
        try:
            with torch.no_grad():
                aided = compensator(signal, ear)
        except Exception as error:  # whatever somebody's module raises, and where
            raise ValueError(f"{what}: {reason_of(error)}") from error
        if not isinstance(aided, Tensor) or aided.shape != signal.shape:
            found = tuple(aided.shape) if isinstance(aided, Tensor) else type(aided).__name__
            raise ValueError(
                f"{what} is {found}; allowed: a tensor of the input's shape, {tuple(signal.shape)}"
            )
        if not aided.isfinite().all():
            raise ValueError(f"{what} holds samples that are NaN or infinite")
        made.append(aided)
    return torch.stack(made)


def _heard(sounds: Tensor, ear: Audiogram) -> Tensor:
    """Level in dB SPL of the middle second. Shape: (items, time) -> (items,)."""
    with torch.no_grad():
        return level_spl(MSBG(ear, sample_rate=NEURO_RATE)(sounds)[:, _MIDDLE])


def _ratio_db(part: Tensor, whole: Tensor) -> Tensor:
    return 10.0 * (part / whole.clamp_min(_SILENCE)).clamp_min(_LEAST).log10()
