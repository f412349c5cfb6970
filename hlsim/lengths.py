"""How long each item of a padded batch is."""

from collections.abc import Sequence

import torch
from torch import Tensor

Lengths = Tensor | Sequence[int]
"""Samples of each item, in the shape of the leading dimensions."""


def check_lengths(lengths: Lengths, shape: torch.Size) -> Tensor:
    """The lengths as a tensor on the CPU.

    Args:
        shape: of the batch, (..., time).

    Returns: (...), int64.

    Raises:
        ValueError: not whole numbers, of another shape, or outside 1 to time.
    """
    *items, time = shape
    allowed = f"allowed: whole numbers from 1 to {time} (samples) of shape {tuple(items)}, one an item"
    try:
        ends = torch.as_tensor(lengths, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"lengths is {type(lengths).__name__}; {allowed}") from None
    if ends.is_floating_point() or ends.is_complex() or ends.dtype == torch.bool:
        raise ValueError(f"lengths of {ends.dtype}; {allowed}")
    if ends.shape != shape[:-1]:
        raise ValueError(f"lengths of shape {tuple(ends.shape)}; {allowed}")
    if not bool(((ends >= 1) & (ends <= time)).all()):
        raise ValueError(f"lengths from {int(ends.min())} to {int(ends.max())}; {allowed}")
    return ends.long()


def silent_after(waveform: Tensor, ends: Tensor) -> Tensor:
    """Zeros in place of what follows each item's end. Shape: (..., time), (...) -> (..., time)."""
    places = torch.arange(waveform.shape[-1], device=waveform.device)
    return torch.where(places < ends.to(waveform.device).unsqueeze(-1), waveform, 0.0)
