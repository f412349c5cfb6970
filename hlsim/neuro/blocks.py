"""Dual-path blocks: layers along time, followed by layers along frequency.

The layers are convolutions, or those of ``hlsim.neuro.family``. Feature maps have the shape (items,
time, frequency, channels), because layers across channels are then matrix products.
"""

from torch import Tensor, nn

from hlsim.neuro.config import NetworkConfig
from hlsim.neuro.family.sequences import build_sequence_path
from hlsim.neuro.pointwise import Pointwise


class ConvPath(nn.Module):
    """The convolutional layers of a block, along time or along frequency.

    The layers are a convolution of each channel, a linear expansion to more channels, a ReLU, and a
    transposed convolution of length 1 back to the number of channels. The output of the last layer
    is added to the input.

    Source: the Neuro-MSBG paper, Section II-A.

    Shape: (items, time, frequency, channels) -> (items, time, frequency, channels).

    Args:
        channels: Number of channels.
        axis: 0 for time, 1 for frequency.
        kernel: Length of the convolution, an odd number.
        expansion: Factor by which the linear expansion increases the number of channels.

    >>> import torch
    >>> ConvPath(8, axis=0, kernel=7, expansion=2)(torch.randn(1, 20, 5, 8)).shape
    torch.Size([1, 20, 5, 8])
    """

    def __init__(self, channels: int, axis: int, kernel: int, expansion: int) -> None:
        super().__init__()
        size = (kernel, 1) if axis == 0 else (1, kernel)
        padding = (size[0] // 2, size[1] // 2)
        self.local = nn.Conv2d(channels, channels, size, padding=padding, groups=channels)
        self.expand = nn.Linear(channels, channels * expansion)
        self.restore = Pointwise(channels * expansion, channels)

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.local(features.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        hidden = self.expand(hidden).relu_()
        return features + self.restore(hidden)


class DualPathBlock(nn.Sequential):
    """Layers along time, followed by layers along frequency.

    Shape: (items, time, frequency, channels) -> (items, time, frequency, channels).

    Args:
        config: Kind and sizes of the layers.
        time_alone: Leave out the layers along frequency, as the structure ``"monolithic"`` does, in
            which a frame is one vector without a frequency axis.

    >>> from hlsim.neuro.config import NeuroConfig
    >>> import torch
    >>> config = NeuroConfig(structure="dual-path", channels=8)
    >>> DualPathBlock(config)(torch.randn(1, 20, 5, 8)).shape
    torch.Size([1, 20, 5, 8])
    """

    def __init__(self, config: NetworkConfig, *, time_alone: bool = False) -> None:
        super().__init__()
        self.time = _build_path(config, 0)
        if not time_alone:
            self.frequency = _build_path(config, 1)


def _build_path(config: NetworkConfig, axis: int) -> nn.Module:
    """Build the layers that ``config.block`` names, along time (axis 0) or frequency (axis 1)."""
    if config.block == "cnn":
        return ConvPath(config.channels, axis, config.kernel[axis], config.expansion)
    return build_sequence_path(config, axis)
