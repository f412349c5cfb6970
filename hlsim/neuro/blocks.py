"""Dual-path blocks: first along time, then along frequency, by convolution, Mamba, LSTM or Transformer.

Feature maps lie (items, time, frequency, channels): the pointwise layers are then plain matrix products.
"""

from typing import Any, Self, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.neuro.config import NetworkConfig
from hlsim.neuro.mamba import Mamba


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
        around = (size[0] // 2, size[1] // 2)
        self.local = nn.Conv2d(channels, channels, size, padding=around, groups=channels)
        self.expand = nn.Linear(channels, channels * expansion)
        self.restore = nn.ConvTranspose1d(channels * expansion, channels, 1)

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.local(features.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        hidden = self.expand(hidden).relu_()
        return features + _restore(self.restore, hidden)


class SequencePath(nn.Module):
    """A layer for sequences along one axis: normalise, run, back by ConvTranspose1d, residual.

    Shape: (items, time, frequency, channels) -> the same.

    Args:
        axis: 0 for time, 1 for frequency; each row along it is a sequence.
        core: (sequences, length, channels) -> (sequences, length, width).
    """

    def __init__(self, channels: int, axis: int, core: nn.Module, width: int) -> None:
        super().__init__()
        self.axis = axis
        # over channels, not time: the level of a sound stays visible in how they lie to each other
        self.norm = nn.LayerNorm(channels)
        self.core = core
        self.restore = nn.ConvTranspose1d(width, channels, 1)

    def forward(self, features: Tensor) -> Tensor:
        rows = features.transpose(1, 2) if self.axis == 0 else features
        hidden = self.core(self.norm(rows).flatten(0, 1)).unflatten(0, rows.shape[:2])
        hidden = hidden.transpose(1, 2) if self.axis == 0 else hidden
        return features + _restore(self.restore, hidden)


class BidirectionalMamba(nn.Module):
    """Two Mambas, one of them backwards. Shape: (sequences, length, channels) -> (..., 2 channels)."""

    def __init__(self, channels: int, states: int, expansion: int) -> None:
        super().__init__()
        self.onward = Mamba(channels, states, expand=expansion)
        self.reverse = Mamba(channels, states, expand=expansion)

    def forward(self, sequence: Tensor) -> Tensor:
        return torch.cat((self.onward(sequence), self.reverse(sequence.flip(1)).flip(1)), -1)


class BidirectionalLSTM(nn.Module):
    """An LSTM in both directions. Shape: (sequences, length, channels) -> (..., 2 hidden)."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(channels, hidden, batch_first=True, bidirectional=True)

    def train(self, mode: bool = True) -> Self:
        """The LSTM stays in training mode: cuDNN gives no gradient otherwise, and there is no dropout in it."""
        super().train(mode)
        self.lstm.train()
        return self

    def forward(self, sequence: Tensor) -> Tensor:
        # where the rest runs in bfloat16, cuDNN would run it in float16
        with torch.autocast(sequence.device.type, enabled=False):
            weight = cast(Tensor, self.lstm.weight_hh_l0)
            output: Tensor = self.lstm(sequence.to(weight.dtype))[0]
        return output


class EncoderLayer(nn.TransformerEncoderLayer):
    """Torch's, without dropout. Shape: (sequences, length, channels) -> the same.

    It stays in training mode: in evaluation torch's shortcut holds every pair of times, 64 GiB for a minute of signal.
    """

    def __init__(self, channels: int, heads: int, hidden: int) -> None:
        options: dict[str, Any] = {"activation": "gelu", "batch_first": True, "norm_first": True}
        super().__init__(channels, heads, hidden, dropout=0.0, **options)

    def train(self, mode: bool = True) -> Self:
        return super().train(True)

    def forward(self, src: Tensor, *args: Any, **options: Any) -> Tensor:
        # where the rest runs in bfloat16: on a CPU the attention's backward pass takes four times as long in it
        with torch.autocast("cpu", enabled=False):
            whole = src if src.is_cuda else src.to(self.linear1.weight.dtype)
            return super().forward(whole, *args, **options)


def _path(config: NetworkConfig, axis: int) -> nn.Module:
    """The path that ``config.block`` names, along time (0) or frequency (1)."""
    channels, expansion = config.channels, config.expansion
    core: nn.Module
    match config.block:
        case "cnn":
            return ConvPath(channels, axis, config.kernel[axis], expansion)
        case "mamba":
            core, width = BidirectionalMamba(channels, config.states, expansion), 2 * channels
        case "lstm":
            core, width = (
                BidirectionalLSTM(channels, expansion * channels),
                2 * expansion * channels,
            )
        case _:
            core, width = EncoderLayer(channels, config.heads, expansion * channels), channels
    return SequencePath(channels, axis, core, width)


class DualPathBlock(nn.Sequential):
    """A path over time, then one over frequency, or, for the monolithic baselines, over time alone.

    Shape: (items, time, frequency, channels) -> the same.
    """

    def __init__(self, config: NetworkConfig, *, time_alone: bool = False) -> None:
        super().__init__()
        self.time = _path(config, 0)
        if not time_alone:
            self.frequency = _path(config, 1)


def _restore(layer: nn.ConvTranspose1d, hidden: Tensor) -> Tensor:
    # a ConvTranspose1d of length 1 is a matrix product, and faster as one
    return functional.linear(hidden, layer.weight.squeeze(-1).T, layer.bias)
