"""How close a simulator comes to the truth: errors of waveforms and bands, and scores of both that ought to agree."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from hlsim.dsp.resample import resample
from hlsim.extras import require

Signal = np.ndarray | Tensor

_PESQ_RATE = 16000
_BANDS = 1000.0 * 2.0 ** (
    np.arange(-9, 9) / 3.0
)  # centres in Hz, 125 to 6350: the last band ends at 7127
_BAND_RANGE_DB = 50.0
_FLOOR = 1e-20  # of the truth's power: keeps an exact estimate at 200 dB SNR, which JSON can hold


class Score(NamedTuple):
    """A score, or None and the reason why there is none."""

    value: float | None
    reason: str | None = None


def snr_db(truth: Signal, estimate: Signal) -> float:
    """Power of the truth over that of the error, in dB; at most 200.

    Shape: (time,) and (time,); ValueError for others, a sample that is not finite, or a silent truth.
    """
    return -10.0 * math.log10(max(raw_mse(truth, estimate), _FLOOR))


def raw_mse(truth: Signal, estimate: Signal) -> float:
    """Mean squared error of the waveforms, both scaled so that the truth has unit power: 10 ** (-snr_db / 10).

    Without that scale the figure would grow with the level, and quiet items would not count. The paper's RAW MSE says
    nothing about its scale.

    Shape: (time,) and (time,). Raises ValueError as ``snr_db``.
    """
    true, found = _pair(truth, estimate)
    return float(np.mean((true - found) ** 2) / np.mean(true**2))


def third_octave_error_db(truth: Signal, estimate: Signal, sample_rate: int) -> float:
    """Median absolute difference of the levels in one-third-octave bands, 125 Hz to 7 kHz, in dB.

    Of the whole signal's spectrum. Bands more than 50 dB below the truth's loudest are left out; a band that the
    estimate lacks counts as 120 dB below that loudest one.

    Shape: (time,) and (time,). Raises ValueError as ``snr_db``, and for a rate below 16000 Hz.
    """
    true, found = _pair(truth, estimate)
    if sample_rate < 2 * 8000:
        raise ValueError(f"sample rate {sample_rate} Hz; bands up to 7 kHz need 16000 or more")
    points = max(len(true), sample_rate // 4)  # 4 Hz apart or less: the lowest band is 29 Hz wide
    frequencies = np.fft.rfftfreq(points, 1.0 / sample_rate)
    edges = np.searchsorted(
        frequencies, np.append(_BANDS * 2.0 ** (-1 / 6), _BANDS[-1] * 2.0 ** (1 / 6))
    )
    powers = []
    for signal in (true, found):
        total = np.append(0.0, np.cumsum(np.abs(np.fft.rfft(signal, points)) ** 2))
        powers.append(np.diff(total[edges]))
    loudest = powers[0].max()
    if loudest <= 0.0:
        raise ValueError("truth holds nothing between 125 Hz and 7 kHz")
    levels = [10.0 * np.log10(np.maximum(power / loudest, 1e-12)) for power in powers]
    used = levels[0] >= -_BAND_RANGE_DB
    return float(np.median(np.abs(levels[0] - levels[1])[used]))


def stoi(clean: Signal, heard: Signal, sample_rate: int) -> Score:
    """STOI (Taal 2011) by pystoi, or the reason why there is none: silence, or less than 0.4 s of speech.

    Shape: (time,) and (time,); ValueError for others. MissingExtraError without pystoi.
    """
    run = require("pystoi", "eval").stoi
    return _score(lambda a, b: run(a, b, sample_rate), clean, heard)


def pesq_wb(clean: Signal, heard: Signal, sample_rate: int) -> Score:
    """Wide-band PESQ (ITU-T P.862.2) by pesq, at 16 kHz, to which other rates are resampled; or why there is none.

    The library (pesq 0.0.4) crashed on 90 s of noise in 90 bursts: score minutes of speech with two processes or more,
    which outlive it.

    Shape: (time,) and (time,). Raises as ``stoi``, for pesq.
    """
    run = require("pesq", "pesq").pesq

    def at_16k(*signals: np.ndarray) -> float:
        pair = [resample(torch.from_numpy(x), sample_rate, _PESQ_RATE).numpy() for x in signals]
        return float(run(_PESQ_RATE, *pair, "wb"))

    return _score(at_16k, clean, heard)


def _correlation(
    measure: Callable[..., Any], true: Iterable[float], simulated: Iterable[float]
) -> float | None:
    a, b = _values(true, simulated)
    if len(a) < 2 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return None
    return float(measure(a, b)[0])


linear_correlation = partial(_correlation, stats.pearsonr)
"""Pearson's correlation (LCC); None for fewer than two pairs or where either side does not vary."""

rank_correlation = partial(_correlation, stats.spearmanr)
"""Spearman's correlation (SRCC), ties at their mean rank; None as ``linear_correlation``."""


def mean_squared_error(true: Iterable[float], simulated: Iterable[float]) -> float | None:
    """Mean squared difference of the scores; None without pairs."""
    a, b = _values(true, simulated)
    return float(np.mean((a - b) ** 2)) if len(a) else None


def _values(true: Iterable[float], simulated: Iterable[float]) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.array(list(true), dtype=np.float64), np.array(list(simulated), dtype=np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise ValueError(f"{a.size} true scores and {b.size} simulated; allowed: equal counts")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("scores hold NaN or infinity; allowed: finite numbers")
    return a, b


def _score(run: Callable[[np.ndarray, np.ndarray], float], clean: Signal, heard: Signal) -> Score:
    pair = _equal(clean, heard)
    for name, signal in zip(("clean", "heard"), pair, strict=True):
        if not np.isfinite(signal).all():
            return Score(None, f"{name} holds samples that are NaN or infinite")
        if not signal.any():
            return Score(None, f"{name} is silent")
    try:
        with warnings.catch_warnings():
            # pystoi's word, and its score is 1e-5
            warnings.filterwarnings("error", message="Not enough STFT frames")
            value = float(run(*pair))
    except (
        Exception
    ) as error:  # whatever a third party's measure raises is that item's reason, no more
        text = error.args[0] if error.args else error
        return Score(None, text.decode() if isinstance(text, bytes) else str(text))
    return Score(value) if math.isfinite(value) else Score(None, f"the score is {value}")


def _equal(*signals: Signal) -> tuple[np.ndarray, ...]:
    arrays = (x.detach().cpu().numpy() if isinstance(x, Tensor) else np.asarray(x) for x in signals)
    a, b = (x.astype(np.float64) for x in arrays)
    if a.ndim != 1 or a.shape != b.shape or not len(a):
        raise ValueError(
            f"signals have shapes {a.shape} and {b.shape}; allowed: (time,) twice, equally long"
        )
    return a, b


def _pair(truth: Signal, estimate: Signal) -> tuple[np.ndarray, ...]:
    pair = _equal(truth, estimate)
    if not np.isfinite(pair).all():
        raise ValueError("truth or estimate holds samples that are NaN or infinite")
    if not pair[0].any():
        raise ValueError("truth is silent; an error relative to it is not defined")
    return pair
