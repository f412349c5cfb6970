"""Errors and scores of one signal against another.

SNR and errors show how closely a network reproduces the simulator from which it learned. STOI and
PESQ score the output of an aid, or what a simulator makes of it, against clean speech.
"""

import math
import warnings
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from hlsim.dsp.resample import resample
from hlsim.extras import require

Signal = np.ndarray | Tensor
"""Samples of one channel. Shape: (time,)."""

_PESQ_RATE = 16000
"""Sample rate of wide-band PESQ in Hz."""

_BAND_CENTRES_HZ = 1000.0 * 2.0 ** (np.arange(-9, 9) / 3.0)
"""Centres of one-third-octave bands from 125 to 6350 Hz. The last band ends at 7127 Hz."""

_BAND_RANGE_DB = 50.0
"""Difference in dB from the loudest band beyond which a softer band is ignored."""

_MIN_BAND_RATIO = 1e-12
"""Smallest power of a band relative to that of the loudest band, -120 dB."""

_MIN_ERROR_POWER = 1e-20
"""Smallest power of an error relative to that of the reference.

It keeps the SNR of equal signals finite, because JSON has no infinity.
"""


def snr_db(reference: Signal, estimate: Signal) -> float:
    """Compute the signal-to-noise ratio: the power of the reference over that of the error, in dB.

    Args:
        reference: Expected samples. Shape: (time,).
        estimate: Samples to compare. Shape: (time,).

    Returns:
        Ratio in dB, at most 200.

    Raises:
        ValueError: The signals are empty, not one-dimensional or of different lengths, a sample is
            not finite, or the reference is silent.

    >>> round(snr_db(np.array([1.0, -1.0]), np.array([1.1, -1.1])))
    20
    """
    return -10.0 * math.log10(max(raw_mse(reference, estimate), _MIN_ERROR_POWER))


def raw_mse(reference: Signal, estimate: Signal) -> float:
    """Compute the mean squared error of a waveform, divided by the mean square of the reference.

    Without the division, soft items would hardly count in a mean over items. The Neuro-MSBG paper
    does not state how it scales this measure, which it calls RAW MSE.

    Args:
        reference: Expected samples. Shape: (time,).
        estimate: Samples to compare. Shape: (time,).

    Raises:
        ValueError: The signals are empty, not one-dimensional or of different lengths, a sample is
            not finite, or the reference is silent.

    >>> round(raw_mse(np.array([1.0, -1.0]), np.array([1.1, -1.1])), 6)
    0.01
    """
    x, y = _check_signals(reference, estimate)
    return float(np.mean((x - y) ** 2) / np.mean(x**2))


def third_octave_error_db(reference: Signal, estimate: Signal, sample_rate: int) -> float:
    """Compute the median over bands of the absolute difference in dB of two signals' levels.

    The 18 bands are one-third octaves around 125 to 6350 Hz; their levels are those of the whole
    signal. Bands more than 50 dB below the loudest band of the reference are ignored. A level of
    the estimate that is more than 120 dB below this loudest band is replaced by this limit.

    Args:
        reference: Expected samples. Shape: (time,).
        estimate: Samples to compare. Shape: (time,).
        sample_rate: Sample rate in Hz, at least 16000.

    Raises:
        ValueError: The signals are empty, not one-dimensional or of different lengths, a sample is
            not finite, the reference is silent or has no power in the bands, or the sample rate is
            below 16000.

    >>> noise = np.random.default_rng(0).standard_normal(16000)
    >>> round(third_octave_error_db(noise, 10.0 * noise, 16000))
    20
    """
    x, y = _check_signals(reference, estimate)
    if sample_rate < 2 * 8000:
        raise ValueError(
            f"expected a sample rate of 16000 Hz or more for bands up to 7 kHz, got {sample_rate}"
        )
    # The frequencies are at most about 4 Hz apart, because the lowest band is 29 Hz wide.
    points = max(len(x), sample_rate // 4)
    powers = np.stack([_third_octave_powers(signal, points, sample_rate) for signal in (x, y)])
    loudest = powers[0].max()
    if loudest <= 0.0:
        raise ValueError("expected a reference with power from 111 Hz to 7.1 kHz, got none")
    reference_levels, levels = 10.0 * np.log10(np.maximum(powers / loudest, _MIN_BAND_RATIO))
    is_loud = reference_levels >= -_BAND_RANGE_DB
    return float(np.median(np.abs(reference_levels - levels)[is_loud]))


def _third_octave_powers(signal: np.ndarray, points: int, sample_rate: int) -> np.ndarray:
    """Compute the power in each one-third-octave band, up to a common factor.

    Shape: (time,) -> (18,).

    Args:
        signal: Samples.
        points: Length of the Fourier transform.
        sample_rate: Sample rate in Hz.
    """
    frequencies = np.fft.rfftfreq(points, 1.0 / sample_rate)
    lower_edges = _BAND_CENTRES_HZ * 2.0 ** (-1 / 6)
    last_edge = _BAND_CENTRES_HZ[-1] * 2.0 ** (1 / 6)
    edges = np.searchsorted(frequencies, np.append(lower_edges, last_edge))
    powers = np.abs(np.fft.rfft(signal, points)) ** 2
    cumulative_power = np.append(0.0, np.cumsum(powers))
    return np.diff(cumulative_power[edges])


def stoi(output: Signal, clean: Signal, sample_rate: int) -> float:
    """Compute the short-time objective intelligibility (STOI), about 0 to 1, with pystoi.

    Source: Taal, Hendriks, Heusdens and Jensen (2011).

    Args:
        output: Speech to score. Shape: (time,).
        clean: Clean speech. Shape: (time,).
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: The signals are empty, not one-dimensional or of different lengths, or STOI is
            not defined: a signal is silent, has a sample that is not finite, or has less than 0.4 s
            of speech.
        MissingExtraError: pystoi is not installed.

    >>> noise = np.random.default_rng(0).standard_normal(16000)
    >>> round(stoi(noise, noise, 16000))
    1
    """
    pystoi = require("pystoi", "eval")
    return _score("STOI", lambda x, y: pystoi.stoi(x, y, sample_rate), clean, output)


def pesq_wb(output: Signal, clean: Signal, sample_rate: int) -> float:
    """Compute wide-band PESQ, the quality of speech from about 1 to 4.6, with the package pesq.

    Signals are resampled to 16 kHz. Version 0.0.4 of pesq crashed on 90 s of noise in 90 bursts;
    such a crash ends the Python process. If you score minutes of speech, use ``run_study`` or an
    evaluation command with ``jobs`` of 2 or more: then only the scores of the crashing item are
    missing.

    Source: ITU-T P.862.2.

    Args:
        output: Speech to score. Shape: (time,).
        clean: Clean speech. Shape: (time,).
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: The signals are empty, not one-dimensional or of different lengths, or PESQ is
            not defined: a signal is silent, is shorter than 0.25 s, has a sample that is not
            finite, or has no speech that pesq detects.
        MissingExtraError: pesq is not installed.

    >>> noise = np.random.default_rng(0).standard_normal(16000)
    >>> pesq_wb(noise, noise, 16000) > 4.0
    True
    """
    pesq = require("pesq", "pesq")

    def score_at_16_khz(x: np.ndarray, y: np.ndarray) -> float:
        signals = resample(torch.from_numpy(np.stack((x, y))), sample_rate, _PESQ_RATE)
        return float(pesq.pesq(_PESQ_RATE, *signals.numpy(), "wb"))

    return _score("PESQ", score_at_16_khz, clean, output)


def _score(
    name: str,
    compute: Callable[[np.ndarray, np.ndarray], float],
    clean: Signal,
    output: Signal,
) -> float:
    """Compute a score by an outside package, and convert its errors to ValueError.

    Args:
        name: Name of the score, for messages.
        compute: Function of the clean signal and the output, float64 arrays of shape (time,).
        clean: Clean speech. Shape: (time,).
        output: Speech to score. Shape: (time,).

    Raises:
        ValueError: The signals are not what ``_check_signals`` accepts, the output is silent, or
            the package raises an error, returns a value that is not finite, or (pystoi) finds too
            little speech.
    """
    x, y = _check_signals(clean, output)
    if not y.any():
        raise ValueError(f"{name} is not defined: the output is silent")
    try:
        with warnings.catch_warnings():
            # pystoi warns about too little speech, and returns 1e-5.
            warnings.filterwarnings("error", message="Not enough STFT frames")
            value = float(compute(x, y))
    except Exception as error:  # because an external measure may raise anything
        message = error.args[0] if error.args else error
        reason = message.decode() if isinstance(message, bytes) else message
        raise ValueError(f"{name} is not defined: {reason}") from error
    if not math.isfinite(value):
        raise ValueError(f"{name} is not defined: its value is {value}")
    return value


def _check_signals(reference: Signal, estimate: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Validate two signals to compare, and convert them to float64 arrays of shape (time,).

    Raises:
        ValueError: A signal is empty or not one-dimensional, the lengths differ, a sample is not
            finite, or the reference is silent.
    """
    x, y = (
        np.asarray(
            signal.detach().cpu().double() if isinstance(signal, Tensor) else signal, np.float64
        )
        for signal in (reference, estimate)
    )
    if x.ndim != 1 or x.shape != y.shape or not len(x):
        raise ValueError(
            "expected two one-dimensional signals of equal length, not empty, got shapes "
            f"{x.shape} and {y.shape}"
        )
    for name, samples in (("reference", x), ("estimate", y)):
        if not np.isfinite(samples).all():
            raise ValueError(
                f"expected finite samples of the {name}, got NaN or infinity; remove them"
            )
    if not x.any():
        raise ValueError("expected a reference, such as clean speech, that is not silent")
    return x, y
