"""Properties of an aid that scores of speech do not show.

These are gain curves, steady tones, quiet noise, look-ahead and cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.parallel import describe_error, one_thread
from hlsim.losses.band_levels import band_centres, band_levels
from hlsim.metrics.pair import common_length
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.clips import Clips

UTTERANCES = 6
"""Number of clips of 3 s of speech on which gains are measured."""

TONES = (250, 500, 1000, 2000, 3001, 4000)
"""Frequencies of steady tones in Hz. All but 3001 Hz have the same phase in frames that are
multiples of 4 ms apart."""

QUIET_LEVELS = (25.0, 40.0)
"""Levels in dB SPL of the noise in a room where nobody speaks."""

CHANGE_POSITIONS = range(8000, 40000, 2003)
"""Samples from which on the input becomes another sound, at many positions within any hop."""

CHANGE_THRESHOLD = 1e-4
"""Share of the output's peak that counts as a change. Rounding of Fourier transforms is less."""

SIDEBAND_DISTANCE_HZ = 20.0
"""Distance from a tone in Hz from which on power counts as sidebands."""

MIDDLE = slice(NEURO_RATE // 2, -NEURO_RATE // 2)
"""Middle second of 2 s, which holds whole periods of each tone."""

POWER_FLOOR = 1e-30
"""Lowest power of a tone, which keeps ratios finite for JSON."""

RATIO_FLOOR = 1e-20
"""Lowest ratio of powers."""

Aid = Callable[[Tensor, Audiogram], Tensor]
Aids = Mapping[str, Aid]
Ears = Mapping[str, Audiogram]
Results = list[dict[str, Any]]
"""One dictionary per ear and aid, with the keys ``ear`` and ``aid``."""


def measure_aids(
    aids: Aids, ears: Ears, measure: Callable[..., dict[str, Any]], *arguments: Any
) -> Results:
    """Measure a property of each aid for each ear.

    Args:
        aids: Aids by name.
        ears: Ears by name.
        measure: One of the functions below, ``(aid, ear, *arguments) -> results``.
        arguments: Further arguments of the measure.

    Raises:
        ValueError: An aid fails; the message names aid and ear.

    >>> aids = {"unaided": lambda signal, ear: signal}
    >>> measure_aids(aids, {"N3": Audiogram.standard("N3")}, lambda aid, ear: {"cost": 0})
    [{'aid': 'unaided', 'ear': 'N3', 'cost': 0}]
    """
    results = []
    for (ear_name, ear), (name, aid) in product(ears.items(), aids.items()):
        try:
            values = measure(aid, ear, *arguments)
        except ValueError as error:
            raise ValueError(f"{name}, ear {ear_name}: {error}") from error
        results.append({"aid": name, "ear": ear_name, **values})
    return results


def insertion_gain(
    aid: Aid, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> list[list[float]]:
    """Measure output power over input power in dB, in 24 bands and over all of the speech.

    The signal is speech with its pauses, because an aid may treat a steady noise as noise.

    Args:
        aid: The aid.
        ear: The ear.
        speech: Utterances at 16 kHz.
        levels: Levels of each utterance in dB SPL.

    Shape: (utterances, time) -> (levels, 24).

    Raises:
        ValueError: The aid fails, see ``outputs``.

    >>> gains = insertion_gain(lambda x, _: 10.0 * x, NORMAL, torch.randn(1, 16000), [65.0])
    >>> round(gains[0][0])
    20
    """
    curves = []
    for level in levels:
        signals = set_level(speech, level)
        aided = outputs(aid, signals, ear)
        curves.append((10.0 * (_band_powers(aided) / _band_powers(signals)).log10()).tolist())
    return curves


def draw_utterances(speech: str | Path, seed: int) -> Tensor:
    """Draw six clips of 3 s from a folder.

    Shape: -> (6, 48000) at 16 kHz.

    >>> from hlsim.shortcuts import EXAMPLE_FILE
    >>> draw_utterances(EXAMPLE_FILE.parent, seed=0).shape
    torch.Size([6, 48000])
    """
    clips = Clips(speech, sample_rate=NEURO_RATE, seconds=3.0)
    return clips.draw(UTTERANCES, torch.Generator().manual_seed(seed))


def gain_curves(aids: Aids, ears: Ears, utterances: Tensor, levels: Sequence[float]) -> Results:
    """Measure the insertion gain ``gain_db`` of each aid for each ear.

    Args:
        aids: Aids by name.
        ears: Ears by name.
        utterances: Speech at 16 kHz. Shape: (utterances, time).
        levels: Levels in dB SPL.

    Returns:
        Gains of shape (levels, 24), with ``levels`` and ``frequencies``.

    Raises:
        ValueError: An aid fails.

    >>> aids, ears = {"unaided": lambda x, _: x}, {"NH": NORMAL}
    >>> gain_curves(aids, ears, torch.randn(1, 16000), [65.0])[0]["gain_db"][0][:2]
    [0.0, 0.0]
    """
    axes = {"levels": list(levels), "frequencies": band_centres().tolist()}

    def measure(aid: Aid, ear: Audiogram) -> dict[str, Any]:
        return {**axes, "gain_db": insertion_gain(aid, ear, utterances, levels)}

    return measure_aids(aids, ears, measure)


def tones(hertz: Sequence[int], levels: Sequence[float]) -> Tensor:
    """Compute sines of 2 s at 16 kHz in pascals, each at each level in dB SPL.

    Shape: -> (tones * levels, 32000).

    >>> tones([250, 1000], [50.0, 65.0, 80.0]).shape
    torch.Size([6, 32000])
    """
    samples = torch.arange(2 * NEURO_RATE)
    turns = torch.tensor(hertz).unsqueeze(-1) * samples % NEURO_RATE / NEURO_RATE
    sines = (2.0 * torch.pi * turns).sin().repeat_interleave(len(levels), 0)
    return set_level(sines, torch.tensor(levels, dtype=torch.float32).repeat(len(hertz)))


def sidebands_db(waveform: Tensor, hertz: Tensor) -> Tensor:
    """Compute the power at more than 20 Hz from a tone, relative to the power near it, in dB.

    Args:
        waveform: Tones, of which the middle second counts. Shape: (items, 32000).
        hertz: Frequency of each tone. Shape: (items,).

    Returns:
        Ratios of -200 dB or more. Shape: (items,).

    >>> bool(sidebands_db(tones([1000], [65.0]), torch.tensor([1000])) < -100.0)
    True
    """
    middle = waveform[:, MIDDLE].double()
    window = torch.hann_window(middle.shape[-1], dtype=middle.dtype)
    power = torch.fft.fft(middle * window).abs().square()
    bins = torch.fft.fftfreq(middle.shape[-1], 1.0 / NEURO_RATE).abs()
    near = (bins - hertz.unsqueeze(-1)).abs() <= SIDEBAND_DISTANCE_HZ
    tone, sidebands = (power * near).sum(-1), (power * ~near).sum(-1)
    ratio = (sidebands / tone.clamp_min(POWER_FLOOR)).clamp_min(RATIO_FLOOR)
    return 10.0 * ratio.log10()


def steady_tones(aid: Aid, ear: Audiogram, levels: Sequence[float]) -> dict[str, Any]:
    """Measure how loud an ear perceives tones after an aid, and which sidebands the aid adds.

    Args:
        aid: The aid.
        ear: The ear.
        levels: Levels of the tones in dB SPL.

    Returns:
        ``loudness_error_db``, the level of the output after the exact MSBG minus that of the tone
        for a normal ear, and ``sidebands_db`` of the output, both of shape (levels, frequencies),
        with ``levels`` and ``frequencies``.

    Raises:
        ValueError: The aid fails.

    >>> steady_tones(lambda x, _: x, NORMAL, [65.0])["loudness_error_db"][0][0]
    0.0
    """
    sounds = tones(TONES, levels)
    hertz = torch.tensor(TONES).repeat_interleave(len(levels))
    aided = outputs(aid, sounds, ear)
    errors = _perceived_level(aided, ear) - _perceived_level(sounds, NORMAL)
    values = {"loudness_error_db": errors, "sidebands_db": sidebands_db(aided, hertz)}
    by_level = {name: v.reshape(len(TONES), -1).T.tolist() for name, v in values.items()}
    return {"levels": list(levels), "frequencies": list(TONES), **by_level}


def wearing(aid: Aid, ear: Audiogram, speech: Tensor) -> dict[str, Any]:
    """Measure whether an aid can be worn: its look-ahead, its gain in quiet rooms, and its cost.

    Args:
        aid: The aid.
        ear: The ear.
        speech: 3 s at 16 kHz. Shape: (time,).

    Returns:
        ``look_ahead_ms``, see ``look_ahead``; ``quiet_gain_db``, the gain for white noise at
        ``QUIET_LEVELS``; and ``cpu_ms``, the processor time per second of sound on one thread.

    Raises:
        ValueError: The aid fails.

    >>> wearing(lambda x, _: x, NORMAL, torch.randn(48000))["look_ahead_ms"]
    0.0
    """
    speech = set_level(speech, 65.0)
    noise = torch.randn(len(speech), generator=torch.Generator().manual_seed(0))
    other, *quiet = (set_level(noise, level) for level in (65.0, *QUIET_LEVELS))
    signals = [*changed_signals(speech, other, CHANGE_POSITIONS), *quiet]
    with one_thread():
        start = time.process_time()
        aided = outputs(aid, signals, ear)
        seconds = time.process_time() - start
    samples = look_ahead(aided[: -len(quiet)], CHANGE_POSITIONS)
    gains = [
        float(level_spl(after[MIDDLE]) - level_spl(before[MIDDLE]))
        for after, before in zip(aided[-len(quiet) :], quiet, strict=True)
    ]
    return {
        "look_ahead_ms": 1000.0 * samples / NEURO_RATE,
        "quiet_gain_db": gains,
        "cpu_ms": 1000.0 * seconds * NEURO_RATE / (len(signals) * len(speech)),
    }


def changed_signals(signal: Tensor, other: Tensor, positions: Iterable[int]) -> list[Tensor]:
    """Return a signal, and versions of it that become another sound at each position.

    Shape: (..., time) twice -> (..., time) each.

    >>> [signal.tolist() for signal in changed_signals(torch.zeros(3), torch.ones(3), [2])]
    [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    changed = [torch.cat((signal[..., :p], other[..., p:]), -1) for p in positions]
    return [signal, *changed]


def look_ahead(outputs: Iterable[Tensor], positions: Iterable[int]) -> int:
    """Return by how many samples an output changes before its input becomes another sound.

    Differences of more than 1e-4 of the output's peak count.

    Args:
        outputs: Outputs for the signals of ``changed_signals``, in the same order: that for the
            unchanged signal, and one for each position. Shape: (..., time) each.
        positions: Samples from which on the input becomes another sound.

    Returns:
        The largest number at any position, at least 0.

    >>> look_ahead(changed_signals(torch.ones(9), torch.zeros(9), [3]), [5])
    2
    """
    unchanged, *changed = outputs
    threshold, largest = CHANGE_THRESHOLD * float(unchanged.abs().max()), 0
    for output, position in zip(changed, positions, strict=True):
        difference = (output - unchanged).abs().reshape(-1, unchanged.shape[-1]).amax(0)
        differs = difference > threshold
        if differs.any():
            largest = max(largest, position - int(differs.int().argmax()))
    return largest


def outputs(aid: Aid, signals: Iterable[Tensor], ear: Audiogram) -> Tensor:
    """Return the outputs of an aid for several signals, which are processed one at a time.

    Shape: signals of (time,) -> (signals, time).

    Raises:
        ValueError: The aid fails, or its output is not a finite tensor of the input's shape.

    >>> outputs(lambda signal, ear: signal, torch.ones(2, 10), Audiogram.standard("N3")).shape
    torch.Size([2, 10])
    """
    results: list[Tensor] = []
    for signal in signals:
        try:
            with torch.no_grad():
                output = aid(signal, ear)
        except Exception as error:  # The aid may be code of a user.
            raise ValueError(describe_error(error)) from error
        if not isinstance(output, Tensor) or output.ndim != 1:
            shape = getattr(output, "shape", type(output).__name__)
            raise ValueError(f"expected an output of shape {tuple(signal.shape)}, got {shape}")
        lengths = len(signal), len(output)
        output = output[: common_length(lengths, NEURO_RATE, ("the input", "the output"))]
        if not output.isfinite().all():
            raise ValueError("the output has samples that are NaN or infinite")
        results.append(output)
    return torch.stack(results)


def _band_powers(signal: Tensor) -> Tensor:
    """Return the mean power of each band. Shape: (utterances, time) -> (24,)."""
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))


def _perceived_level(sounds: Tensor, ear: Audiogram) -> Tensor:
    """Return the level of the middle second in dB SPL. Shape: (items, time) -> (items,)."""
    return level_spl(perceive(sounds, ear, NEURO_RATE)[:, MIDDLE])
