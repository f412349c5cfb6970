"""Properties of an aid that speech scores do not show: gain, tones, quiet noise, look-ahead, cost.

An aid is a function ``(waveform, ear) -> waveform`` for one signal at 16 kHz in pascals, (time,).
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import NEURO_RATE, Loudness, level_spl, loudness_at, set_level
from hlsim.evaluation.digits.psychometric import Estimate, subtract
from hlsim.evaluation.digits.speech_reception import DigitTest
from hlsim.evaluation.measures import NORMAL, perceive
from hlsim.evaluation.running.parallel import describe_error
from hlsim.evaluation.study import cut_output
from hlsim.metrics.band_levels import band_centres, band_levels, threshold_in_quiet
from hlsim.progress import track
from hlsim.torchtools import one_thread

TONES = (250, 500, 1000, 2000, 3001, 4000)
"""Frequencies of steady tones in Hz. All but 3001 Hz have the same phase in frames that are
multiples of 4 ms apart."""

QUIET_LEVELS = (25.0, 40.0)
"""Levels in dB SPL of the noise in a room where nobody speaks."""

CHANGE_POSITIONS = range(8000, 40000, 2003)
"""Samples at which the input becomes another sound, to measure the look-ahead.

An aid that processes frames may change its output earlier for some positions within a frame.
"""

_CHANGE_THRESHOLD = 1e-4
"""Share of the output's peak that counts as a change. Rounding of Fourier transforms is less."""

_SIDEBAND_DISTANCE_HZ = 20.0
"""Distance from a tone in Hz beyond which power counts as sidebands."""

_MIDDLE = slice(NEURO_RATE // 2, -NEURO_RATE // 2)
"""Samples without the first and the last half second.

Of tones of 2 s, they are the middle second, which has whole periods of each tone.
"""

_TONE_POWER_FLOOR = 1e-30
"""Lowest power of a tone, which keeps ratios finite for JSON."""

_RATIO_FLOOR = 1e-20
"""Lowest ratio of powers."""

Aid = Callable[[Tensor, Audiogram], Tensor]
Aids = Mapping[str, Aid]
Ears = Mapping[str, Audiogram]
Results = list[dict[str, Any]]
"""One dict per ear and aid, with the names ``ear`` and ``aid`` and the measured values."""


def measure_aids(
    aids: Aids, ears: Ears, measure: Callable[..., dict[str, Any]], *arguments: Any
) -> Results:
    """Measure a property of several hearing aids, each for several ears.

    Args:
        aids: Hearing aids, each under its name. One with a method ``is_measured`` is left out for
            ears for which the method returns False.
        ears: Audiograms, each under its name.
        measure: Function ``(aid, ear, *arguments) -> dict``, such as ``measure_steady_tones``.
        arguments: Arguments of ``measure`` after aid and ear.

    Returns:
        One dict per ear and aid: the names ``aid`` and ``ear``, and the values of ``measure``. The
        order is that of ``ears`` and, for each ear, that of ``aids``.

    Raises:
        ValueError: An aid fails; the message names aid and ear.

    >>> aids = {"unaided": lambda signal, ear: signal}
    >>> measure_aids(aids, {"N3": Audiogram.standard("N3")}, lambda aid, ear: {"cost": 0})
    [{'aid': 'unaided', 'ear': 'N3', 'cost': 0}]
    """
    results = []
    pairs = [
        (ear, aid)
        for ear, aid in product(ears.items(), aids.items())
        if not hasattr(aid[1], "is_measured") or aid[1].is_measured(ear[1])
    ]
    for (ear_name, ear), (name, aid) in track(pairs, "measurements of aids", len(pairs)):
        try:
            values = measure(aid, ear, *arguments)
        except Exception as error:  # The aid may be code of a user.
            raise ValueError(f"{name}, ear {ear_name}: {describe_error(error)}") from error
        results.append({"aid": name, "ear": ear_name, **values})
    return results


def measure_gain_curve(
    aid: Aid, ear: Audiogram, speech: Tensor, levels: Sequence[float]
) -> dict[str, Any]:
    """Measure the gain of a hearing aid for speech over frequency, at each of several levels.

    The gain of a band is the mean power of the outputs over that of the inputs, in dB. The inputs
    are speech with its pauses, because an aid may treat a steady sound as noise.

    Args:
        aid: The hearing aid.
        ear: The audiogram.
        speech: Utterances at 16 kHz. Shape: (utterances, time).
        levels: Levels in dB SPL, see ``set_level``. All utterances are processed at each of them.

    Returns:
        ``gain_db``, nested lists of gains in dB, (levels, 24), and its axes ``levels`` (dB SPL) and
        ``frequencies`` (centres of 24 bands of equal width on the ERB scale, in Hz).

    Raises:
        ValueError: A level is out of range, or an output of the aid is not valid, see
            ``cut_output``.

    >>> curve = measure_gain_curve(lambda x, _: 10.0 * x, NORMAL, torch.randn(1, 16000), [65.0])
    >>> round(curve["gain_db"][0][0])
    20
    """
    gains = []
    for level in levels:
        signals = set_level(speech, level)
        aided = _aid_outputs(aid, signals, ear)
        gains.append((10.0 * (_band_powers(aided) / _band_powers(signals)).log10()).tolist())
    return {"levels": list(levels), "frequencies": band_centres().tolist(), "gain_db": gains}


def mean_band_levels(signals: Sequence[Tensor], *, hearing_level: bool = False) -> list[float]:
    """Compute the mean level of several signals in each of 24 bands of equal width in ERBs.

    The mean is that of powers, over time and over the signals.

    Args:
        signals: Signals at 16 kHz in pascals. Shape of each: (time,).
        hearing_level: Return levels in dB HL, relative to the threshold of a normal ear, instead
            of dB SPL.

    Returns: One level per band, for the 24 ``frequencies`` that ``measure_gain_curve`` returns.

    >>> len(mean_band_levels([torch.ones(16000)]))
    24
    """
    frames = torch.cat([band_levels(signal, NEURO_RATE) for signal in signals])
    levels = 10.0 * np.log10((10.0 ** (frames / 10.0)).mean(0).numpy())
    return (levels - threshold_in_quiet() if hearing_level else levels).tolist()


def make_tones(hertz: Sequence[int], levels: Sequence[float]) -> Tensor:
    """Compute sines of 2 s at 16 kHz in pascals, for each frequency at each level.

    Args:
        hertz: Frequencies in Hz.
        levels: Levels in dB SPL.

    Returns: The sines, first those of the first frequency. Shape: (frequencies * levels, 32000).

    >>> make_tones([250, 1000], [50.0, 65.0, 80.0]).shape
    torch.Size([6, 32000])
    """
    samples = torch.arange(2 * NEURO_RATE)
    turns = torch.tensor(hertz).unsqueeze(-1) * samples % NEURO_RATE / NEURO_RATE
    sines = (2.0 * torch.pi * turns).sin().repeat_interleave(len(levels), 0)
    return set_level(sines, torch.tensor(levels, dtype=torch.float32).repeat(len(hertz)))


def _sidebands_db(waveform: Tensor, hertz: Tensor) -> Tensor:
    """Compute the power at more than 20 Hz from a tone, relative to the power near it, in dB.

    Args:
        waveform: Outputs at 16 kHz for tones; the middle second counts. Shape: (items, 32000).
        hertz: Frequency of each tone in Hz. Shape: (items,).

    Returns:
        Ratios, at least -200 dB. Shape: (items,).
    """
    middle = waveform[:, _MIDDLE].double()
    window = torch.hann_window(middle.shape[-1], dtype=middle.dtype)
    power = torch.fft.fft(middle * window).abs().square()
    bins = torch.fft.fftfreq(middle.shape[-1], 1.0 / NEURO_RATE).abs()
    near = (bins - hertz.unsqueeze(-1)).abs() <= _SIDEBAND_DISTANCE_HZ
    tone, sidebands = (power * near).sum(-1), (power * ~near).sum(-1)
    ratio = (sidebands / tone.clamp_min(_TONE_POWER_FLOOR)).clamp_min(_RATIO_FLOOR)
    return 10.0 * ratio.log10()


def measure_steady_tones(
    aid: Aid, ear: Audiogram, levels: Sequence[float], loudness: Loudness = 0.0
) -> dict[str, Any]:
    """Measure loudness errors and distortion of a hearing aid for steady tones.

    The frequencies of the tones are the six ``TONES``. Measurements with speech do not reveal an
    aid that removes steady sounds.

    Args:
        aid: The hearing aid.
        ear: The audiogram.
        levels: Levels of the tones in dB SPL.
        loudness: Loudness at which an output has no loudness error, in dB relative to a normal ear:
            a number, or numbers by the level of the tone.

    Returns:
        ``loudness_error_db``, the level that the ear perceives of the output minus the level that a
        normal ear perceives of the tone, by the exact MSBG, and minus ``loudness``;
        ``sidebands_db``, the power of the output at more than 20 Hz from the tone relative to that
        near it, in dB; both are nested lists of shape (levels, frequencies). ``levels`` (dB SPL)
        and ``frequencies`` (Hz) are the axes.

    Raises:
        ValueError: An output of the aid is not valid, see ``cut_output``.

    >>> measure_steady_tones(lambda x, _: x, NORMAL, [65.0])["loudness_error_db"][0][0]
    0.0
    """
    sounds = make_tones(TONES, levels)
    hertz = torch.tensor(TONES).repeat_interleave(len(levels))
    aided = _aid_outputs(aid, sounds, ear)
    errors = _perceived_level(aided, ear) - _perceived_level(sounds, NORMAL)
    targets = loudness_at(loudness, torch.tensor(levels, dtype=torch.float64))
    return {
        "levels": list(levels),
        "frequencies": list(TONES),
        "loudness_error_db": (errors.reshape(len(TONES), -1) - targets).T.tolist(),
        "sidebands_db": _sidebands_db(aided, hertz).reshape(len(TONES), -1).T.tolist(),
    }


def measure_wearability(aid: Aid, ear: Audiogram, speech: Tensor) -> dict[str, Any]:
    """Measure whether a hearing aid can be worn: its look-ahead, gain for quiet noise, and cost.

    Args:
        aid: The hearing aid.
        ear: The audiogram.
        speech: Utterance of 3 s at 16 kHz, which is set to 65 dB SPL. Shape: (48000,).

    Returns:
        ``look_ahead_ms``, how much later input a sample of the output needs, see
        ``measure_look_ahead``; ``quiet_gain_db``, the gains in dB for white noise at 25 and at 40
        dB SPL (``QUIET_LEVELS``); and ``cpu_ms``, the processor time in ms for one second of sound
        on one thread.

    Raises:
        ValueError: An output of the aid is not valid, see ``cut_output``.

    >>> measure_wearability(lambda x, _: x, NORMAL, torch.randn(48000))["look_ahead_ms"]
    0.0
    """
    speech = set_level(speech, 65.0)
    noise = torch.randn(len(speech), generator=torch.Generator().manual_seed(0))
    quiet = torch.stack([set_level(noise, level) for level in QUIET_LEVELS])
    with one_thread():
        start = time.process_time()
        samples = measure_look_ahead(
            lambda signal, ear: _aid_outputs(aid, [signal], ear)[0],
            ear,
            speech,
            set_level(noise, 65.0),
            CHANGE_POSITIONS,
        )
        aided = _aid_outputs(aid, quiet, ear)
        seconds = time.process_time() - start
    processed_seconds = (1 + len(CHANGE_POSITIONS) + len(quiet)) * len(speech) / NEURO_RATE
    gains = level_spl(aided[:, _MIDDLE]) - level_spl(quiet[:, _MIDDLE])
    return {
        "look_ahead_ms": 1000.0 * samples / NEURO_RATE,
        "quiet_gain_db": gains.tolist(),
        "cpu_ms": 1000.0 * seconds / processed_seconds,
    }


def measure_look_ahead(
    aid: Callable[[Tensor, Any], Tensor],
    ear: Any,
    signal: Tensor,
    other: Tensor,
    positions: Iterable[int],
) -> int:
    """Measure the look-ahead of an aid: how many samples of later input its output depends on.

    From a position on, a second sound replaces the input. The look-ahead is the number of samples
    before this position from which the output differs by more than 1e-4 of its peak.

    Args:
        aid: Function ``(signal, ear) -> output``: a hearing aid for one ear, or for both.
        ear: The audiogram, or for both ears a ``Listener``.
        signal: First sound. Shape: (..., time).
        other: Second sound. Shape: (..., time).
        positions: Indices of the samples from which the second sound replaces the first one. Each
            is tried.

    Returns:
        The largest number of samples over all positions, 0 for an aid without look-ahead.

    >>> advance = lambda signal, ear: signal.roll(-2)  # by two samples
    >>> measure_look_ahead(advance, NORMAL, torch.ones(9), -torch.ones(9), [5])
    2
    """
    unchanged = aid(signal, ear)
    threshold, largest = _CHANGE_THRESHOLD * float(unchanged.abs().max()), 0
    for position in positions:
        changed = torch.cat((signal[..., :position], other[..., position:]), -1)
        difference = (aid(changed, ear) - unchanged).abs()
        differs = difference.reshape(-1, unchanged.shape[-1]).amax(0) > threshold
        if differs.any():
            largest = max(largest, position - int(differs.int().argmax()))
    return largest


def measure_reception_thresholds(
    aids: Aids, ears: Ears, reference: str, test: DigitTest
) -> Results:
    """Measure speech reception thresholds of ears with hearing aids, by digits in noise.

    Args:
        aids: Hearing aids, each under its name.
        ears: Audiograms, each under its name.
        reference: Name of one of ``aids``, such as ``"unaided"``, to which benefits are relative.
            If it has a method ``is_measured``, this must return True for each ear for which another
            aid is measured.
        test: Test with the same digits and noises for all ears and aids.

    Returns:
        One dict per ear and aid, as ``measure_aids`` returns it, with ``threshold_db``, the
        signal-to-noise ratio in dB at which half of the triplets of digits are understood, and
        ``benefit_db``, the threshold with the reference minus that with the aid. Both are an
        ``Estimate`` with its 95 % interval. A threshold above 32 dB is infinite; the benefit is
        then infinite, or NaN if both are.

    Raises:
        ValueError: An aid fails; the message names aid and ear.
        KeyError: The reference was not measured for an ear.

    >>> test = DigitTest.draw(30, simulator="attenuation")
    >>> aids, ears = {"unaided": lambda signal, ear: signal}, {"N3": Audiogram.standard("N3")}
    >>> measure_reception_thresholds(aids, ears, "unaided", test)[0]["benefit_db"].value
    0.0
    """
    results = measure_aids(aids, ears, _measure_reception_threshold, test)
    unaided = {row["ear"]: row["threshold_db"] for row in results if row["aid"] == reference}
    for row in results:
        row["benefit_db"] = subtract(unaided[row["ear"]], row["threshold_db"])
    return results


def _measure_reception_threshold(aid: Aid, ear: Audiogram, test: DigitTest) -> dict[str, Estimate]:
    """Return ``{"threshold_db": threshold}``, the speech reception threshold of an ear with an aid.

    This is a ``measure`` of ``measure_aids``.
    """
    thresholds = torch.tensor(ear.thresholds)
    return {
        "threshold_db": test.measure(thresholds, lambda inputs, _: _aid_outputs(aid, inputs, ear))
    }


@torch.no_grad()
def _aid_outputs(aid: Aid, signals: Iterable[Tensor], ear: Audiogram) -> Tensor:
    """Return the outputs of an aid for several signals, which are processed one at a time.

    Args:
        aid: The hearing aid.
        signals: Signals of equal length. Shape of each: (time,).
        ear: Audiogram of the ear.

    Returns:
        Outputs, cut to the length of the signals if they are longer. Shape: (signals, time).

    Raises:
        ValueError: An output is not valid, see ``cut_output``.
    """
    outputs = [cut_output(aid(signal.clone(), ear), signal, NEURO_RATE) for signal in signals]
    return torch.stack(outputs)


def _band_powers(signal: Tensor) -> Tensor:
    """Return the mean power of speech in each of 24 bands, where 1.0 is 0 dB SPL.

    Shape: (utterances, time) in pascals at 16 kHz -> (24,).
    """
    return (10.0 ** (band_levels(signal.double(), NEURO_RATE) / 10.0)).mean((0, 1))


def _perceived_level(sounds: Tensor, ear: Audiogram) -> Tensor:
    """Return the level in dB SPL of what an ear perceives of sounds of 2 s, by the exact MSBG.

    The level is that of the middle second.

    Shape: (items, 32000) in pascals at 16 kHz -> (items,).
    """
    return level_spl(perceive(sounds, ear, NEURO_RATE)[:, _MIDDLE])
