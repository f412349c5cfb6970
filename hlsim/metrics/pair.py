"""The two signals that a score compares: validated, cut, and scored item by item."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from hlsim.checks import Lengths, check_lengths, check_rate, check_waveform
from hlsim.torchtools import Samples, as_samples

SHORTEST_SECONDS = 0.7
"""Shortest duration in seconds of a signal that HASPI, HASQI and HAAQI score."""

LARGEST_LENGTH_DIFFERENCE = 0.1
"""Largest difference in seconds for which the longer of two signals is cut instead of rejected."""

Equalisation = Literal[1, 2]
"""Mode of HASQI and HAAQI: 1 amplifies the clean signal by NAL-R, 2 takes an amplified one."""

Noise = Literal["expected", "seeded", "none"]
"""Internal noise of the ear: the same every time, the noise that pyclarity draws, or none."""


def common_length(lengths: tuple[int, int], sample_rate: int, names: tuple[str, str]) -> int:
    """Return the length of the shorter of two signals in samples, and warn if the lengths differ.

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


def check_pair(output: Tensor, clean: Tensor) -> None:
    """Raise ValueError unless two signals have the same shape and are on the same device.

    Args:
        output: Output of an aid.
        clean: Clean signal.

    >>> check_pair(torch.ones(2, 9000), torch.ones(2, 9000))
    """
    if output.device != clean.device:
        raise ValueError(
            "expected output and clean on the same device, got "
            f"{output.device} and {clean.device}; write clean.to(output.device)"
        )
    if output.shape != clean.shape:
        raise ValueError(
            f"expected output and clean of the same shape, got {tuple(output.shape)} and "
            f"{tuple(clean.shape)}; pass one clean signal for each output, and cut both to one "
            "length"
        )


def match_pair(
    output: Samples, clean: Samples, sample_rate: int, lengths: Lengths | None = None
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Cut an output and a clean signal to one length, and validate that they can be compared.

    Arrays are converted to tensors. If the output is float64, the clean signal becomes float64.

    Args:
        output: Output of an aid. Shape: (..., time).
        clean: Clean signal. Shape: (..., time), where ``time`` may differ by up to 0.1 s.
        sample_rate: Sample rate in Hz.
        lengths: Number of samples of each item in a padded batch. Shape: (...).

    Returns:
        Output and clean signal of the common length, and ``lengths`` (None if there are none) with
        the common length as their maximum.

    Raises:
        ValueError: A signal is not a waveform, the shapes or devices differ, the lengths differ by
            more than 0.1 s, the rate is out of range, or ``lengths`` do not fit.

    >>> output, clean, _ = match_pair(torch.ones(8000).double(), torch.ones(8000), 16000)
    >>> clean.dtype
    torch.float64
    """
    output = check_waveform(as_samples(output), "output")
    clean = check_waveform(as_samples(clean), "clean")
    times = output.shape[-1], clean.shape[-1]
    time = common_length(times, check_rate(sample_rate), ("output", "clean"))
    output, clean = output[..., :time], clean[..., :time]
    check_pair(output, clean)
    if lengths is not None:
        longest = torch.Size((*clean.shape[:-1], max(times)))
        lengths = check_lengths(lengths, longest).clamp_max(time)
    return output, clean.to(torch.promote_types(clean.dtype, output.dtype)), lengths


def scores_or_errors(
    score: Callable[..., Tensor],
    output: Tensor,
    clean: Tensor,
    ears: Tensor,
    ends: Sequence[int],
    **settings: Any,
) -> list[Tensor | ValueError]:
    """Compute the score of each item of a batch, or the error if an item cannot be scored.

    ``score`` raises an error for the whole batch if one item cannot be scored. In that case, each
    item is scored on its own.

    Args:
        score: Function that computes the score, such as ``haspi``.
        output: Outputs of an aid. Shape: (items, time) or (items, ears, time).
        clean: Clean signals of the same shape.
        ears: Thresholds in dB HL. Shape: (items, 8) or (items, ears, 8).
        ends: Number of samples of each item before padding.
        settings: Further keyword arguments of ``score``.

    Returns:
        For each item, its result of ``score``, or its ValueError. A wrong setting causes the same
        error for every item.

    >>> from hlsim.metrics import haspi
    >>> silence = torch.zeros(1, 16000)
    >>> errors = scores_or_errors(haspi, silence, silence, torch.zeros(1, 8), [16000])
    >>> type(errors[0]).__name__
    'UnscorableError'
    """
    try:
        return list(score(output, clean, ears, lengths=ends, **settings))
    except ValueError as error:
        if len(clean) == 1:
            return [error]
    results = []
    for item in zip(
        output.split(1), clean.split(1), ears.split(1), [[end] for end in ends], strict=True
    ):
        results += scores_or_errors(score, *item, **settings)
    return results
