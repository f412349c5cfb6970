"""Validation of pairs of signals that are scored, and of seeds."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from numbers import Integral
from typing import Any, Literal

import torch
from torch import Tensor

from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform, describe

SHORTEST_SECONDS = 0.7
"""Shortest signal in seconds for which a score can be trusted."""

LOWEST_REFERENCE_SPL = 20.0
"""Lowest level of the reference in dB SPL for which a score can be trusted."""

LARGEST_LENGTH_DIFFERENCE = 0.1
"""Largest difference in seconds between the lengths of two signals, of which the longer is cut."""

Noise = Literal["expected", "seeded", "none"]
"""Internal noise of the ear: its mean effect, the noise that pyclarity draws, or none."""


def common_length(lengths: tuple[int, int], sample_rate: int, names: tuple[str, str]) -> int:
    """Return the length of the shorter of two signals, and warn if their lengths differ.

    Args:
        lengths: Lengths of both signals in samples.
        sample_rate: Sample rate in Hz.
        names: Names of both signals in messages.

    Raises:
        ValueError: The lengths differ by more than 0.1 s.

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
        processed: Signal to score. Shape: (..., time).
        clean: Clean speech. Shape: (..., time).
        sample_rate: Sample rate in Hz.
        lengths: Number of samples of each item in a padded batch, which are limited to the common
            length.

    Raises:
        ValueError: The lengths differ by more than 0.1 s.

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
        processed: Signal to score. Shape: (..., time).
        clean: Clean speech. Shape: (..., time).
        sample_rate: Sample rate in Hz.
        lengths: Number of samples of each item in a padded batch.

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
        ValueError: The seed is not a whole number from 0 to 2 ** 32 - 1.

    >>> check_seed(3)
    3
    """
    if not isinstance(seed, Integral) or not 0 <= seed < 2**32:
        raise ValueError(
            f"expected seed to be a whole number from 0 to {2**32 - 1}, got {describe(seed)}"
        )
    return seed


def item_seeds(seed: int | Sequence[int], shape: torch.Size) -> list[int]:
    """Return one seed for each item.

    Args:
        seed: One seed, or one for each item.
        shape: Shape of the batch of items.

    Raises:
        ValueError: The number of seeds is another one, or a seed is out of range.

    >>> item_seeds(3, torch.Size([2]))
    [3, 3]
    """
    items = shape.numel()
    try:
        seeds: list[Any] = list(seed)  # type: ignore[arg-type]
    except TypeError:  # neither a sequence nor a tensor with elements
        seeds = [seed] * items
    if len(seeds) != items:
        raise ValueError(f"expected one seed or {items}, one for each item, got {len(seeds)}")
    return [check_seed(value) for value in seeds]
