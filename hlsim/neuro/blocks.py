"""Dual-path blocks: first along time, then along frequency.

Feature maps lie (items, time, frequency, channels): the pointwise layers are then plain matrix products.
"""

from torch import Tensor, nn
from torch.nn import functional


class ConvPath(nn.Module):
    """The paper's CNN block along one axis: local convolution, expansion, activation, back by ConvTranspose1d, residual.

    Shape: (items, time, frequency, channels) -> the same.

    Args:
        axis: 0 for time, 1 for frequency.
        kernel: length of the local convolution, odd.
        expansion: channels between the two pointwise layers over ``channels``.
    """

    def __init__(self, channels: int, axis: int, kernel: int, expansion: int) -> None:
        super().__init__()
        size = (kernel, 1) if axis == 0 else (1, kernel)
        self.local = nn.Conv2d(
            channels, channels, size, padding=(size[0] // 2, size[1] // 2), groups=channels
        )
        self.expand = nn.Linear(channels, channels * expansion)
        self.restore = nn.ConvTranspose1d(channels * expansion, channels, 1)

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.local(features.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        hidden = functional.relu(self.expand(hidden))
        # a ConvTranspose1d of length 1 is a matrix product, and faster as one
        return features + functional.linear(hidden, self.restore.weight.squeeze(-1).T, self.restore.bias)


class DualPathBlock(nn.Module):
    """A path over time, then one over frequency. Shape: (items, time, frequency, channels) -> the same."""

    def __init__(self, channels: int, kernel: tuple[int, int], expansion: int) -> None:
        super().__init__()
        self.time = ConvPath(channels, 0, kernel[0], expansion)
        self.frequency = ConvPath(channels, 1, kernel[1], expansion)

    def forward(self, features: Tensor) -> Tensor:
        output: Tensor = self.frequency(self.time(features))
        return output
