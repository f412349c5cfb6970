"""Validation of the two signals that a score compares, and of random seeds."""

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
"""Lowest level of clean speech or music in dB SPL for which a score can be trusted."""

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
    processed: Tensor, clean: Tensor, sample_rate: int
) -> tuple[Tensor, Tensor]:
    """Validate that an output and a clean signal can be compared, and cut the longer one.

    Args:
        processed: Output of an aid. Shape: (..., time).
        clean: Clean signal. Shape: (..., time), where ``time`` may differ by 0.1 s.
        sample_rate: Sample rate of both in Hz.

    Returns:
        Output and clean signal of the same length.

    Raises:
        ValueError: A signal is not a waveform, the shapes or devices differ, the lengths differ by
            more than 0.1 s, or the rate is out of range.

    >>> output, clean = cut_to_common_length(torch.ones(9000), torch.ones(9000), 16000)
    >>> output.shape
    torch.Size([9000])
    """
    check_waveform(processed, "processed")
    check_waveform(clean, "clean")
    if processed.shape[:-1] != clean.shape[:-1]:
        raise ValueError(
            "expected processed and clean of the same shape, got "
            f"{tuple(processed.shape)} and {tuple(clean.shape)}; pass one clean signal for each "
            "processed one"
        )
    if processed.device != clean.device:
        raise ValueError(
            f"expected processed and clean on the same device, got {processed.device} and "
            f"{clean.device}; move both with .to(device)"
        )
    times = processed.shape[-1], clean.shape[-1]
    time = common_length(times, check_rate(sample_rate), ("processed", "clean"))
    return processed[..., :time], clean[..., :time]


def match_pair(
    processed: Tensor, clean: Tensor, sample_rate: int, lengths: Lengths | None
) -> tuple[Tensor, Tensor, Lengths | None]:
    """Cut an output and clean speech to one length, and raise the precision of clean speech.

    The precision of clean speech becomes that of the output if this is higher.

    Args:
        processed: Output of an aid. Shape: (..., time).
        clean: Clean speech. Shape: (..., time), where ``time`` may differ by 0.1 s.
        sample_rate: Sample rate in Hz.
        lengths: Number of samples of each item in a padded batch. Shape: (...).

    Returns:
        Output, clean speech, and lengths that are limited to the common length.

    Raises:
        ValueError: A signal is not a waveform, the shapes or devices differ, the lengths differ by
            more than 0.1 s, the rate is out of range, or ``lengths`` do not fit.

    >>> output, clean, _ = match_pair(torch.ones(8000).double(), torch.ones(8000), 16000, None)
    >>> clean.dtype
    torch.float64
    """
    cut_processed, cut_clean = cut_to_common_length(processed, clean, sample_rate)
    if lengths is not None:
        time = max(processed.shape[-1], clean.shape[-1])
        lengths = check_lengths(lengths, torch.Size((*clean.shape[:-1], time)))
        lengths = lengths.clamp_max(cut_clean.shape[-1])
    dtype = torch.promote_types(clean.dtype, processed.dtype)
    return cut_processed, cut_clean.to(dtype), lengths


def check_seed(seed: int) -> int:
    """Return a seed that NumPy accepts.

    Args:
        seed: Seed to validate.

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


def item_seeds(seed: int | Sequence[int], items: int) -> list[int]:
    """Return one seed for each item of a batch.

    Args:
        seed: One seed for all items, or a sequence with one for each item.
        items: Number of items.

    Raises:
        ValueError: The number of seeds is another one, or a seed is out of range.

    >>> item_seeds(3, 2)
    [3, 3]
    """
    try:
        seeds: list[Any] = list(seed)  # type: ignore[arg-type]
    except TypeError:  # neither a sequence nor a tensor with elements
        seeds = [seed] * items
    if len(seeds) != items:
        raise ValueError(
            f"expected one seed or one for each of the {items} items, got {len(seeds)} seeds"
        )
    return [check_seed(value) for value in seeds]
