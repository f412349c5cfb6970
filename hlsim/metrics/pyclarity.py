"""HASPI and HASQI version 2 of one ear, as pyclarity computes them, but the same every time.

HASPI (Kates and Arehart 2021, Speech Communication 131) compares the processed speech in the impaired ear with the
clean speech in a normal one. What to know of pyclarity 0.9.0, measured on read speech at 65 dB SPL for audiogram N3:

- It takes any sample rate and resamples to 24 kHz, from the rate rounded to whole kHz: 44.1 kHz is taken as 44, which
  moved scores by up to 0.005, 22.05 kHz as 22, by as much. Its ear spans 80 to 8000 Hz: against 48 kHz, 16 kHz moved
  scores by up to 0.008 and 8 kHz by up to 0.2. Rates from 16 to 48 kHz are allowed here; compare within one rate.
- It draws noise from numpy's global generator: a score needs a seed (four seeds spread over up to 0.003).
- White noise in place of the processed speech should score 0. It does, to 0.05, on utterances of 3 s and more, but gets
  up to 0.3 on 1.2 s, 0.45 on 0.7 s and 0.99 on 0.2 s. Shorter signals than 0.7 s are refused.
- With the reference under the threshold of hearing it gives any signal the same score, up to 0.99: references under
  20 dB SPL are refused; a DC offset, which nobody hears, does not count.
- It rewards gain: 20 dB of it took one utterance from 0.53 to 0.99. Always give the level beside the score.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Integral
from typing import Any

import numpy as np
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.calibration import check_full_scale
from hlsim.checks import check_rate
from hlsim.extras import require

SHORTEST_SECONDS = 0.7
"""Shortest signal, in seconds, that a score can be trusted of."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference, in dB SPL, that a score can be trusted of."""

Signal = np.ndarray | Tensor


def haspi(
    reference: Signal,
    processed: Signal,
    audiogram: Audiogram,
    sample_rate: int,
    *,
    full_scale_spl: float = 94.0,
    seed: int = 0,
) -> float:
    """HASPI v2 of one ear, 0 to 1: pyclarity's ``haspi_v2`` with numpy's global seed set, and restored afterwards.

    HASPI allows for a delay of ``processed`` by itself. It rewards any gain: give the level of ``processed`` beside it.

    Args:
        reference: clean speech, not amplified, as a normal ear would hear it.
        processed: what the impaired ear is given.
        sample_rate: Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        seed: of the noise that HASPI adds (scores vary by up to 0.003).

    Shape: (time,) and (time,), equally long, at least 0.7 s.

    Raises:
        ValueError: a signal is not (time,), too short, silent, not finite or not as long as the other; the reference is
            below 20 dB SPL; the rate, level or seed is out of range.
        MissingExtraError: pyclarity is not installed.
    """
    return pyclarity_score("haspi", reference, processed, audiogram, sample_rate, full_scale_spl, seed)


def hasqi(
    reference: Signal, processed: Signal, audiogram: Audiogram, sample_rate: int, **options: Any
) -> float:
    """HASQI v2 of one ear, 0 to 1: pyclarity's ``hasqi_v2``, whose combined score it is; all else as ``haspi``.

    HASQI itself adds NAL-R to ``reference``.
    """
    return pyclarity_score("hasqi", reference, processed, audiogram, sample_rate, **options)


def pyclarity_score(
    name: str,
    reference: Signal,
    processed: Signal,
    audiogram: Audiogram,
    sample_rate: int,
    full_scale_spl: float = 94.0,
    seed: int = 0,
) -> float:
    """Version 2 of pyclarity's ``haspi`` or ``hasqi``; arguments and errors as ``haspi``."""
    if not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; {name.upper()} takes one ear, an Audiogram"
        )
    clean, heard = check_pair(reference, processed, sample_rate, full_scale_spl)
    model = getattr(require(f"clarity.evaluator.{name}", "eval"), f"{name}_v2")
    # at the eight frequencies: the same ear to both, which would log a warning of grids that lack one of their six
    ear = Audiogram(audiogram.thresholds).to_clarity()
    with numpy_seed(seed):
        return float(model(clean, sample_rate, heard, sample_rate, ear, level1=full_scale_spl)[0])


def check_seed(seed: int) -> int:
    """Return the seed, or raise ValueError unless numpy takes it (0 to 2 ** 32 - 1)."""
    if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise ValueError(f"seed is {seed!r}; allowed: whole numbers from 0 to {2**32 - 1}")
    return seed


def check_pair(
    reference: Signal,
    processed: Signal,
    sample_rate: int,
    full_scale_spl: float = 94.0,
    names: tuple[str, str] = ("reference", "processed"),
) -> tuple[np.ndarray, np.ndarray]:
    """Both signals in float64, or the ValueError that ``haspi`` would raise. ``names`` go into its message."""
    rate = check_rate(sample_rate)
    full_scale = check_full_scale(full_scale_spl)
    clean, heard = _samples(reference, names[0]), _samples(processed, names[1])
    if len(clean) != len(heard):
        raise ValueError(
            f"{names[0]} has {len(clean)} samples and {names[1]} {len(heard)}; allowed: equal lengths"
        )
    if len(clean) < SHORTEST_SECONDS * rate:
        raise ValueError(
            f"{names[0]} lasts {len(clean) / rate:.2g} s; HASPI needs {SHORTEST_SECONDS} s or more to mean anything"
        )
    level = 10.0 * math.log10(max(float(np.var(clean)), 1e-30)) + full_scale
    if level < LOWEST_REFERENCE_SPL:
        raise ValueError(
            f"{names[0]} is at {level:.1f} dB SPL with full_scale_spl {full_scale:g}; HASPI needs "
            f"{LOWEST_REFERENCE_SPL:g} or more to mean anything"
        )
    return clean, heard


def _samples(signal: Signal, name: str) -> np.ndarray:
    values = signal.detach().cpu().numpy() if isinstance(signal, Tensor) else np.asarray(signal)
    if values.ndim != 1 or not len(values) or values.dtype.kind != "f":
        raise ValueError(
            f"{name} has shape {values.shape} of {values.dtype}; allowed: (time,), floating point, of one ear"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds samples that are NaN or infinite")
    if not values.any():
        raise ValueError(f"{name} is silent, every sample is zero")
    return values.astype(np.float64)


_GLOBAL_GENERATOR = threading.Lock()


@contextmanager
def numpy_seed(seed: int) -> Iterator[None]:
    """Numpy's global generator with this seed, and afterwards as it was; one thread at a time, others wait."""
    with _GLOBAL_GENERATOR:
        state = np.random.get_state()
        np.random.seed(check_seed(seed))
        try:
            yield
        finally:
            np.random.set_state(state)
