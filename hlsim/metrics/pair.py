"""Validation of pairs of signals that are scored, and of seeds."""

from __future__ import annotations

import math
import warnings
from numbers import Integral

import numpy as np
import torch
from torch import Tensor

from hlsim.calibration import check_full_scale
from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform, describe

SHORTEST_SECONDS = 0.7
"""Shortest signal in seconds for which a score can be trusted."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference in dB SPL for which a score can be trusted."""

LARGEST_LENGTH_DIFFERENCE = 0.1
"""Largest difference in seconds between the lengths of two signals, of which the longer is cut."""

Signal = np.ndarray | Tensor
"""Samples of one channel. Shape: (time,)."""


def common_length(lengths: tuple[int, int], sample_rate: int, names: tuple[str, str]) -> int:
    """Return the length of the shorter of two signals, and warn if their lengths differ.

    Args:
        lengths: lengths of both signals in samples.
        sample_rate: sample rate in Hz.
        names: names of both signals in messages.

    Raises:
        ValueError: the lengths differ by more than 0.1 s.

    >>> common_length((16000, 16000), 16000, ("output", "clean"))
    16000
    """
    difference = abs(lengths[0] - lengths[1])
    if difference == 0:
        return lengths[0]
    description = f"{names[0]} has {lengths[0]} samples and {names[1]} {lengths[1]}"
    if difference > LARGEST_LENGTH_DIFFERENCE * sample_rate:
        raise ValueError(
            f"{description}, a difference of {difference / sample_rate:.2g} s; signals may differ "
            f"by {LARGEST_LENGTH_DIFFERENCE:g} s at most, align and cut them first"
        )
    warnings.warn(f"{description}; both are cut to the shorter length", stacklevel=3)
    return min(lengths)


def cut_to_common_length(
    processed: Tensor, clean: Tensor, sample_rate: int, lengths: Lengths | None
) -> tuple[Tensor, Tensor, Lengths | None]:
    """Cut two signals to their common length, with a warning if their lengths differ.

    Arguments that do not fit together for other reasons are returned unchanged, because later
    checks reject them.

    Args:
        processed: signal to score. Shape: (..., time).
        clean: clean speech. Shape: (..., time).
        sample_rate: sample rate in Hz.
        lengths: number of samples of each item in a padded batch, which are limited to the common
            length.

    Raises:
        ValueError: the lengths differ by more than 0.1 s.

    >>> output, clean, _ = cut_to_common_length(torch.ones(9000), torch.ones(9000), 16000, None)
    >>> output.shape
    torch.Size([9000])
    """
    are_tensors = isinstance(processed, Tensor) and isinstance(clean, Tensor)
    if not are_tensors or processed.ndim == 0 or processed.shape[:-1] != clean.shape[:-1]:
        return processed, clean, lengths
    times = processed.shape[-1], clean.shape[-1]
    if times[0] == times[1] or 0 in times:
        return processed, clean, lengths
    time = common_length(times, check_rate(sample_rate), ("processed", "clean"))
    if lengths is not None:
        padded_shape = torch.Size((*clean.shape[:-1], max(times)))
        lengths = check_lengths(lengths, padded_shape).clamp_max(time)
    return processed[..., :time], clean[..., :time], lengths


def match_pair(
    processed: Tensor, clean: Tensor, sample_rate: int, lengths: Lengths | None
) -> tuple[Tensor, Tensor, Lengths | None]:
    """Cut two signals to their common length, and convert clean speech to the wider precision.

    Args:
        processed: signal to score. Shape: (..., time).
        clean: clean speech. Shape: (..., time).
        sample_rate: sample rate in Hz.
        lengths: number of samples of each item in a padded batch.

    Raises:
        ValueError: ``processed`` is not a waveform, or the lengths differ by more than 0.1 s.

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
    """Return a seed that NumPy accepts.

    Raises:
        ValueError: the seed is not a whole number from 0 to 2 ** 32 - 1.

    >>> check_seed(3)
    3
    """
    if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise ValueError(
            f"expected seed to be a whole number from 0 to {2**32 - 1}, got {describe(seed)}"
        )
    return seed


def check_pair(
    reference: Signal,
    processed: Signal,
    sample_rate: int,
    full_scale_spl: float = 94.0,
    names: tuple[str, str] = ("reference", "processed"),
) -> tuple[np.ndarray, np.ndarray]:
    """Validate the signals of one ear, and return them in float64, cut to their common length.

    A silent processed signal is valid, because an aid that mutes gets the score of silence.

    Args:
        reference: clean speech. Shape: (time,).
        processed: signal to score. Shape: (time,).
        sample_rate: sample rate in Hz.
        full_scale_spl: level in dB SPL of samples whose RMS is 1.0.
        names: names of the signals in messages.

    Raises:
        ValueError: a signal has another shape, is too short or is not finite, or the lengths differ
            by more than 0.1 s. The reference is silent or below 20 dB SPL. The rate or the level is
            out of range.

    >>> reference, processed = check_pair(np.ones(16000) * np.arange(16000), np.ones(16000), 16000)
    >>> reference.dtype
    dtype('float64')
    """
    rate = check_rate(sample_rate)
    full_scale = check_full_scale(full_scale_spl)
    clean = _as_float64(reference, names[0])
    output = _as_float64(processed, names[1])
    common = common_length((len(clean), len(output)), rate, names)
    clean = clean[:common]
    output = output[:common]
    if len(clean) < SHORTEST_SECONDS * rate:
        raise ValueError(
            f"expected {names[0]} to last {SHORTEST_SECONDS} s or more for a meaningful score, "
            f"got {len(clean) / rate:.2g} s"
        )
    if not clean.any():
        raise ValueError(f"expected {names[0]} to be a sound, got silence")
    level = 10.0 * math.log10(max(float(np.var(clean)), 1e-30)) + full_scale
    if level < LOWEST_REFERENCE_SPL:
        raise ValueError(
            f"expected {names[0]} at {LOWEST_REFERENCE_SPL:g} dB SPL or more for a meaningful "
            f"score, got {level:.1f} dB SPL; check full_scale_spl={full_scale:g}"
        )
    return clean, output


def _as_float64(signal: Signal, name: str) -> np.ndarray:
    """Convert a signal to an array of float64. Shape: (time,).

    Raises:
        ValueError: the signal has another shape, no floating-point samples, or samples that are NaN
            or infinite.
    """
    if isinstance(signal, Tensor):
        # NumPy has no bfloat16.
        samples = signal.double() if signal.is_floating_point() else signal
        signal = samples.detach().cpu().numpy()
    values = np.asarray(signal)
    if values.ndim != 1 or not len(values) or values.dtype.kind != "f":
        raise ValueError(
            f"expected {name} to be floating-point samples of one ear, of shape (time,), "
            f"got {values.dtype} of shape {values.shape}"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"expected finite samples of {name}, got NaN or infinity")
    return values.astype(np.float64)
