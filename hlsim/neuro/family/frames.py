"""Encoder of the monolithic networks, which have no frequency axis."""

from torch import Tensor, nn


class FrameEncoder(nn.Module):
    """Linear encoder of each frame to a vector, for the paper's baselines without a frequency axis.

    Shape: (items, inputs, time, frequency) -> (items, channels, time, 1).

    Args:
        inputs: Number of input channels.
        frequencies: Number of frequencies.
        channels: Length of the vectors.

    >>> import torch
    >>> FrameEncoder(3, 65, 8)(torch.randn(1, 3, 20, 65)).shape
    torch.Size([1, 8, 20, 1])
    """

    def __init__(self, inputs: int, frequencies: int, channels: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs * frequencies, channels)

    def forward(self, features: Tensor) -> Tensor:
        vectors: Tensor = self.enter(features.transpose(1, 2).flatten(2))
        return vectors.mT.unsqueeze(-1)
