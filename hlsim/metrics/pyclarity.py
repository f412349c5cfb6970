"""HASPI and HASQI version 2 of one ear by pyclarity itself, but the same every time.

What to know of them is in ``hlsim.metrics.haspi``; what is pyclarity's own, in 0.9.0:

- It takes any sample rate and resamples to 24 kHz, from the rate rounded to whole kHz: 44.1 kHz is taken as 44, which
  moved scores by up to 0.005, 22.05 kHz as 22, by as much.
- It draws noise from numpy's global generator: a score needs a seed (four seeds spread over up to 0.003).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from hlsim.audiogram import Audiogram
from hlsim.extras import require
from hlsim.metrics.pair import Signal, check_pair, check_seed


def pyclarity_score(
    name: str,
    reference: Signal,
    processed: Signal,
    audiogram: Audiogram,
    sample_rate: int,
    full_scale_spl: float = 94.0,
    seed: int = 0,
) -> float:
    """pyclarity's ``haspi_v2`` or ``hasqi_v2`` of one ear with numpy's global seed set, and restored afterwards.

    Args:
        name: ``"haspi"`` or ``"hasqi"``, whose combined score it is.
        reference: clean speech, not amplified; HASQI itself adds NAL-R to it.
        processed: what the impaired ear is given.
        sample_rate: Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        seed: of the noise that it adds.

    Shape: (time,) and (time,), equally long, at least 0.7 s.

    Raises:
        ValueError: as ``check_pair``, ``processed`` is silent, the audiogram is none, or the seed out of range.
        MissingExtraError: pyclarity is not installed.
    """
    if not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; {name.upper()} takes one ear, an Audiogram"
        )
    clean, heard = check_pair(reference, processed, sample_rate, full_scale_spl)
    if not heard.any():  # it divides by the level; hlsim's scores silence
        raise ValueError("processed is silent, every sample is zero")
    model = getattr(require(f"clarity.evaluator.{name}", "pyclarity"), f"{name}_v2")
    # at the eight frequencies: the same ear to both, which would log a warning of grids that lack one of their six
    ear = Audiogram(audiogram.thresholds).to_clarity()
    with numpy_seed(seed):
        return float(model(clean, sample_rate, heard, sample_rate, ear, level1=full_scale_spl)[0])


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
