"""Lengths of the items of a padded batch.

Items of a batch have different lengths, but share one tensor, so that all but the longest are
padded at their end. Computations of scores must not depend on the padding.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from hlsim.metrics.ear.recursions import BLOCK


def integers(values: tuple[int, ...], device: torch.device) -> Tensor:
    """Return integers as a tensor on a device, without synchronising with a GPU.

    Args:
        values: The integers.
        device: Device of the tensor.

    Returns:
        The integers, int64. Shape: (number of values,).

    >>> integers((3, 5), torch.device("cpu"))
    tensor([3, 5])
    """
    return torch.tensor(values).to(device, non_blocking=device.type != "cpu")


@dataclass(frozen=True)
class Extent:
    """Length of each item of a padded batch, in samples or in frames.

    All items of a batch are padded to the length of the longest one. The methods ignore the values
    of the padding.

    Args:
        ends: Length of each item before padding.

    >>> extent = Extent((100, 30))
    >>> extent.longest, extent.padded
    (100, 128)
    """

    ends: tuple[int, ...]

    @property
    def longest(self) -> int:
        """Length of the longest item."""
        return max(self.ends)

    @property
    def padded(self) -> int:
        """Length of the longest item, rounded up to a multiple of 64 samples.

        The filters of the ear process blocks of 64 samples (``recursions.BLOCK``).
        """
        return -(-self.longest // BLOCK) * BLOCK

    def cut(self, signal: Tensor) -> Tensor:
        """Cut a batch to its longest item, and set the samples after the end of each item to zero.

        Shape: (items, ..., time) -> (items, ..., longest), where ``time`` is ``longest`` or more.
        """
        signal = signal[..., : self.longest]
        if min(self.ends) == self.longest:
            return signal
        inside = self.inside(signal.device).view(-1, *[1] * (signal.ndim - 2), self.longest)
        return torch.where(inside, signal, 0.0)

    def mean(self, signal: Tensor) -> Tensor:
        """Compute the mean over the time of each item without its padding.

        Shape: (items, ..., time) -> (items, ...).
        """
        ends = integers(self.ends, signal.device).to(signal.dtype)
        return self.cut(signal).sum(-1) / ends.view(-1, *[1] * (signal.ndim - 2))

    def centred(self, signal: Tensor) -> Tensor:
        """Subtract the mean of each item (and channel), and set the samples after its end to zero.

        Shape: (items, ..., time) -> (items, ..., longest).
        """
        return self.cut(signal[..., : self.longest] - self.mean(signal).unsqueeze(-1))

    def inside(self, device: torch.device) -> Tensor:
        """Mark the samples before the end of each item by True, and the padding by False.

        Shape: -> bool (items, longest).
        """
        return torch.arange(self.longest, device=device) < integers(self.ends, device)[:, None]
