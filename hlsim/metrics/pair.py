"""Validation of the pairs of signals that are scored, and of seeds."""

from __future__ import annotations

import math
import warnings
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from hlsim.calibration import check_full_scale
from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform

SHORTEST_SECONDS = 0.7
"""Shortest signal in seconds for which a score can be trusted."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference in dB SPL for which a score can be trusted."""

LARGEST_LENGTH_DIFFERENCE = 0.1
"""Largest difference in seconds between the lengths of two signals, which are then cut to the shorter one."""

Signal = np.ndarray | Tensor


def common_length(lengths: tuple[int, int], sample_rate: int, names: tuple[str, str]) -> int:
    """Return the length of the shorter one of two signals, and warn if they differ.

    Raises:
        ValueError: they differ by more than 0.1 s.
    """
    difference = abs(lengths[0] - lengths[1])
    if difference == 0:
        return lengths[0]
    text = f"{names[0]} has {lengths[0]} samples and {names[1]} {lengths[1]}"
    if difference > LARGEST_LENGTH_DIFFERENCE * sample_rate:
        raise ValueError(
            f"{text}, a difference of {difference / sample_rate:.2g} s; signals may differ by "
            f"{LARGEST_LENGTH_DIFFERENCE:g} s at most, align and cut them first"
        )
    warnings.warn(f"{text}; both are cut to the shorter length", stacklevel=3)
    return min(lengths)


def cut_to_common_length(
    processed: Tensor, clean: Tensor, sample_rate: int, lengths: Lengths | None
) -> tuple[Tensor, Tensor, Lengths | None]:
    """Cut signals whose lengths differ by 0.1 s at most, with a warning; longer lengths of items are cut, too.

    Shape: (..., time) twice. Signals of other shapes are returned as they are, for they are rejected later.

    Raises:
        ValueError: the lengths differ by more.
    """
    tensors = isinstance(processed, Tensor) and isinstance(clean, Tensor)
    if not tensors or processed.ndim == 0 or processed.shape[:-1] != clean.shape[:-1]:
        return processed, clean, lengths
    both = processed.shape[-1], clean.shape[-1]
    if both[0] == both[1] or 0 in both:
        return processed, clean, lengths
    time = common_length(both, check_rate(sample_rate), ("processed", "clean"))
    if lengths is not None:
        lengths = check_lengths(lengths, torch.Size((*clean.shape[:-1], max(both)))).clamp_max(time)
    return processed[..., :time], clean[..., :time], lengths


def match_pair(
    processed: Tensor, clean: Tensor, sample_rate: int, lengths: Lengths | None
) -> tuple[Tensor, Tensor, Lengths | None]:
    """Cut signals to their common length, and convert the clean one to the wider of both dtypes.

    Args:
        processed, clean: signals to score. Lengths may differ by 0.1 s at most.
        sample_rate: sample rate in Hz.
        lengths: number of samples of each item in a padded batch.

    Shape: (..., time) twice.

    Raises:
        ValueError: ``processed`` is no waveform, or the lengths differ by more than 0.1 s.

    >>> output, clean, _ = match_pair(torch.ones(8000).double(), torch.ones(8000), 16000, None)
    >>> clean.dtype
    torch.float64
    """
    check_waveform(processed, "processed")
    processed, clean, lengths = cut_to_common_length(processed, clean, sample_rate, lengths)
    if isinstance(clean, Tensor):
        clean = clean.to(torch.promote_types(clean.dtype, processed.dtype))
    return processed, clean, lengths


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
    """Validate the signals of one ear and return them in float64, cut to their common length.

    A silent processed signal is valid, because an aid that mutes gets the score of silence.

    Args:
        names: names of the signals in messages.

    Shape: (time,) twice.

    Raises:
        ValueError: signals of another shape, too short, not finite, or of lengths that differ by more than 0.1 s; a
            reference that is silent or below 20 dB SPL; a rate or level out of range.
    """
    rate = check_rate(sample_rate)
    full_scale = check_full_scale(full_scale_spl)
    clean, heard = _samples(reference, names[0]), _samples(processed, names[1])
    common = common_length((len(clean), len(heard)), rate, names)
    clean, heard = clean[:common], heard[:common]
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
