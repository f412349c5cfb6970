"""What HASPI and HASQI of one ear are asked for: the pair of signals and the seed, and what is refused of them."""

from __future__ import annotations

import math
from numbers import Integral

import numpy as np
from torch import Tensor

from hlsim.calibration import check_full_scale
from hlsim.checks import check_rate

SHORTEST_SECONDS = 0.7
"""Shortest signal, in seconds, that a score can be trusted of."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference, in dB SPL, that a score can be trusted of."""

Signal = np.ndarray | Tensor


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
    """Both signals, (time,), in float64.

    ValueError where there is no score of them, with these ``names`` in its message: not (time,), too short, not finite,
    or not equally long; the reference silent or below 20 dB SPL; the rate or the level out of range. A silent processed
    one passes: an aid that mutes is to be scored for it.
    """
    rate = check_rate(sample_rate)
    full_scale = check_full_scale(full_scale_spl)
    clean, heard = _samples(reference, names[0]), _samples(processed, names[1])
    if len(clean) != len(heard):
        raise ValueError(
            f"{names[0]} has {len(clean)} samples and {names[1]} {len(heard)}; allowed: equal lengths"
        )
    if len(clean) < SHORTEST_SECONDS * rate:
        raise ValueError(
            f"{names[0]} lasts {len(clean) / rate:.2g} s; a score needs {SHORTEST_SECONDS} s or more to mean anything"
        )
    if not clean.any():
        raise ValueError(f"{names[0]} is silent, every sample is zero")
    level = 10.0 * math.log10(max(float(np.var(clean)), 1e-30)) + full_scale
    if level < LOWEST_REFERENCE_SPL:
        raise ValueError(
            f"{names[0]} is at {level:.1f} dB SPL with full_scale_spl {full_scale:g}; a score needs "
            f"{LOWEST_REFERENCE_SPL:g} or more to mean anything"
        )
    return clean, heard


def _samples(signal: Signal, name: str) -> np.ndarray:
    if isinstance(signal, Tensor):  # numpy has no bfloat16
        signal = (signal.double() if signal.is_floating_point() else signal).detach().cpu().numpy()
    values = np.asarray(signal)
    if values.ndim != 1 or not len(values) or values.dtype.kind != "f":
        raise ValueError(
            f"{name} has shape {values.shape} of {values.dtype}; allowed: (time,), floating point, of one ear"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds samples that are NaN or infinite")
    return values.astype(np.float64)
