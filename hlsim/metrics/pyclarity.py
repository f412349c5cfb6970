"""HASPI version 2 of one ear, as pyclarity computes it, but the same every time; and of many files over all cores.

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path

import numpy as np
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.calibration import check_full_scale
from hlsim.checks import check_rate
from hlsim.extras import require
from hlsim.parallel import check_parallel, run_parallel

SHORTEST_SECONDS = 0.7
"""Shortest signal, in seconds, that a score can be trusted of."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference, in dB SPL, that a score can be trusted of."""

Signal = np.ndarray | Tensor
Progress = Callable[[int, int], None]
"""Called with the number of scores made and the number of all."""


@dataclass(frozen=True)
class HaspiItem:
    """One score to compute.

    Args:
        reference, processed: clean and processed speech: (time,), or paths of one-channel audio files, which are
            read only when their turn comes.
        audiogram: the ear that hears ``processed``.
        sample_rate: Hz; needed for signals, left out for files, which bring their own.
        seed: of the noise that HASPI adds; by default that of ``haspi_many`` plus the place in the list.
    """

    reference: Signal | str | Path
    processed: Signal | str | Path
    audiogram: Audiogram
    sample_rate: int | None = None
    seed: int | None = None


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
        audiogram: of that ear.
        sample_rate: Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        seed: of the noise that HASPI adds (scores vary by up to 0.003).

    Shape: (time,) and (time,), equally long, at least 0.7 s.

    Raises:
        ValueError: a signal is not (time,), too short, silent, not finite or not as long as the other; the reference is
            below 20 dB SPL; the rate, level or seed is out of range.
        MissingExtraError: pyclarity is not installed.
    """
    signals = (reference, processed)
    return pyclarity_score("haspi", signals, audiogram, sample_rate, full_scale_spl, seed)


def pyclarity_score(
    name: str,
    signals: tuple[Signal, Signal],
    audiogram: Audiogram,
    sample_rate: int,
    full_scale_spl: float,
    seed: int,
) -> float:
    """Version 2 of pyclarity's ``haspi`` or ``hasqi``; arguments and errors as ``haspi``."""
    if not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; {name.upper()} takes one ear, an Audiogram"
        )
    clean, heard = check_pair(*signals, sample_rate, full_scale_spl)
    model = getattr(require(f"clarity.evaluator.{name}", "eval"), f"{name}_v2")
    # at the eight frequencies: the same ear to both, which would log a warning of grids that lack one of their six
    ear = Audiogram(audiogram.thresholds).to_clarity()
    with numpy_seed(seed):
        score = model(clean, sample_rate, heard, sample_rate, ear, level1=check_full_scale(full_scale_spl))[0]
    return float(score)


def haspi_many(
    items: Sequence[HaspiItem],
    *,
    full_scale_spl: float = 94.0,
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> list[float]:
    """HASPI of many items in parallel processes, the same whatever their number.

    Each item has a seed of its own, and each process one thread of linear algebra.

    Args:
        items: see ``HaspiItem``.
        full_scale_spl: level in dB SPL of RMS 1.0, of all signals.
        seed: item i, counted from 0, takes seed + i unless it brings its own.
        jobs: processes; None takes all cores.
        progress: called after each score.

    Raises:
        ValueError: as ``haspi``, beginning with the item's processed file or its place in the list; ``jobs`` is below
            1, or the seed is none that numpy takes.
        MissingExtraError: pyclarity or joblib is not installed.
    """
    check_parallel(jobs, "loky", None)
    check_seed(seed)
    seeds = [(seed + i) % 2**32 if item.seed is None else item.seed for i, item in enumerate(items)]
    tasks = [(i, item, full_scale_spl, seeds[i]) for i, item in enumerate(items)]
    scores = [math.nan] * len(items)
    made = run_parallel(_score, tasks, jobs=1 if len(items) < 2 else jobs)
    for done, (task, score) in enumerate(made, start=1):
        if score is None:
            raise ValueError(f"item {task[0]}: the process that scored it died")
        scores[task[0]] = score
        if progress is not None:
            progress(done, len(items))
    return scores


def check_seed(seed: int) -> int:
    """Return the seed, or raise ValueError unless numpy takes it (0 to 2 ** 32 - 1)."""
    if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise ValueError(f"seed is {seed!r}; allowed: whole numbers from 0 to {2**32 - 1}")
    return seed


def read_ear(path: str | Path) -> tuple[np.ndarray, int]:
    """Samples of a one-channel audio file, as they are: (time,) in float64, and the rate in Hz.

    Raises:
        ValueError: as ``read_audio``, or the file has several channels.
    """
    waveform, rate = read_audio(path)
    if waveform.shape[0] != 1:
        raise ValueError(
            f"{path}: {waveform.shape[0]} channels; allowed: 1, for one file is what one ear is given"
        )
    return waveform[0].double().numpy(), rate


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


def _score(task: tuple[int, HaspiItem, float, int]) -> float:
    index, item, full_scale_spl, seed = task
    name = str(item.processed) if isinstance(item.processed, str | Path) else f"item {index}"
    try:
        reference, reference_rate = _load(item.reference, item.sample_rate)
        processed, rate = _load(item.processed, item.sample_rate)
        if rate != reference_rate:
            raise ValueError(f"rate {rate} Hz, its reference has {reference_rate}; allowed: equal rates")
        return haspi(reference, processed, item.audiogram, rate, full_scale_spl=full_scale_spl, seed=seed)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _load(signal: Signal | str | Path, sample_rate: int | None) -> tuple[Signal, int]:
    if isinstance(signal, str | Path):
        return read_ear(signal)
    if sample_rate is None:
        raise ValueError("no sample_rate; signals that are not files need one")
    return signal, sample_rate


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


def hasqi(
    reference: Signal,
    processed: Signal,
    audiogram: Audiogram,
    sample_rate: int,
    *,
    full_scale_spl: float = 94.0,
    seed: int = 0,
) -> float:
    """HASQI v2 of one ear, 0 to 1: pyclarity's ``hasqi_v2``, whose combined score it is, with numpy's seed set.

    Args:
        reference: clean speech, not amplified; HASQI itself adds NAL-R to it.
        processed: what the impaired ear is given.
        audiogram: of that ear.
        sample_rate: Hz, 16000 to 48000.
        full_scale_spl: level in dB SPL of a signal with RMS 1.0 (pyclarity's ``level1``).
        seed: of the noise that HASQI adds.

    Shape: (time,) and (time,), equally long, at least 0.7 s.

    Raises:
        ValueError: as ``haspi``.
        MissingExtraError: pyclarity is not installed.
    """
    signals = (reference, processed)
    return pyclarity_score("hasqi", signals, audiogram, sample_rate, full_scale_spl, seed)
