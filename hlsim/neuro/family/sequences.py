"""Layers of dual-path blocks that see a whole sequence: Mamba, LSTM and Transformer."""

from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from hlsim.neuro.config import NetworkConfig
from hlsim.neuro.family.mamba import Mamba
from hlsim.neuro.pointwise import Pointwise


class SequencePath(nn.Module):
    """A Mamba, LSTM or Transformer layer of a block, along time or along frequency.

    Layer normalisation, the layer and a transposed convolution of length 1 follow each other, and
    their output is added to the input.

    Shape: (items, time, frequency, channels) -> (items, time, frequency, channels).

    Args:
        channels: Number of channels.
        axis: 0 for time, 1 for frequency. Each row along this axis is a sequence.
        core: The layer, (sequences, length, channels) -> (sequences, length, width).
        width: Number of channels of the layer's output.

    >>> path = SequencePath(8, axis=0, core=BidirectionalLSTM(8, hidden=4), width=8)
    >>> path(torch.randn(1, 20, 5, 8)).shape
    torch.Size([1, 20, 5, 8])
    """

    def __init__(self, channels: int, axis: int, core: nn.Module, width: int) -> None:
        super().__init__()
        self.axis = axis
        # The normalisation is across channels, not time, so that the ratios between the channels
        # still depend on the level of a sound.
        self.norm = nn.LayerNorm(channels)
        self.core = core
        self.restore = Pointwise(width, channels)

    def train(self, mode: bool = True) -> Self:
        """Set the mode of this module, but leave the layer in training mode.

        The mode has no effect on results, because there is no dropout. In evaluation mode, cuDNN
        would compute no gradient of an LSTM, and a Transformer layer would keep the attention of
        all pairs of times in memory, about 20 GiB for one minute with ``neuro-msbg-transformer``.
        """
        super().train(mode)
        self.core.train()
        return self

    def forward(self, features: Tensor) -> Tensor:
        rows = features.transpose(1, 2) if self.axis == 0 else features
        hidden = self.core(self.norm(rows).flatten(0, 1)).unflatten(0, rows.shape[:2])
        hidden = hidden.transpose(1, 2) if self.axis == 0 else hidden
        return features + self.restore(hidden)


class BidirectionalMamba(nn.Module):
    """Two Mamba layers, one for each direction of a sequence, with concatenated outputs.

    Shape: (sequences, length, channels) -> (sequences, length, 2 * channels).

    Args:
        channels: Number of channels of the input.
        states: Number of states per inner channel, see ``Mamba``.
        expansion: Number of inner channels relative to ``channels``.

    >>> BidirectionalMamba(8, states=4, expansion=2)(torch.randn(3, 20, 8)).shape
    torch.Size([3, 20, 16])
    """

    def __init__(self, channels: int, states: int, expansion: int) -> None:
        super().__init__()
        self.onward = Mamba(channels, states, expand=expansion)
        self.reverse = Mamba(channels, states, expand=expansion)

    def forward(self, sequence: Tensor) -> Tensor:
        return torch.cat((self.onward(sequence), self.reverse(sequence.flip(1)).flip(1)), -1)


class BidirectionalLSTM(nn.Module):
    """An LSTM that runs forwards and backwards, with concatenated outputs.

    Shape: (sequences, length, channels) -> (sequences, length, 2 * hidden).

    Args:
        channels: Number of channels of the input.
        hidden: Size of the state in each direction.

    >>> BidirectionalLSTM(8, hidden=4)(torch.randn(3, 20, 8)).shape
    torch.Size([3, 20, 8])
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(channels, hidden, batch_first=True, bidirectional=True)

    def forward(self, sequence: Tensor) -> Tensor:
        # Where other layers run in bfloat16, cuDNN would run the LSTM in float16.
        with torch.autocast(sequence.device.type, enabled=False):
            weight = cast(Tensor, self.lstm.weight_hh_l0)
            output: Tensor = self.lstm(sequence.to(weight.dtype))[0]
        return output


class EncoderLayer(nn.TransformerEncoderLayer):
    """Transformer layer whose memory grows in proportion to the length of the sequence.

    The layer consists of self-attention and a feed-forward layer, with normalisation before each.
    In evaluation mode, its memory grows with the square of the length, so that ``SequencePath``
    leaves it in training mode.

    Shape: (sequences, length, channels) -> (sequences, length, channels).

    Args:
        channels: Number of channels.
        heads: Number of attention heads, a divisor of ``channels``.
        hidden: Width of the feed-forward layer.

    >>> EncoderLayer(8, heads=2, hidden=16)(torch.randn(3, 20, 8)).shape
    torch.Size([3, 20, 8])
    """

    def __init__(self, channels: int, heads: int, hidden: int) -> None:
        super().__init__(channels, heads, hidden, 0.0, "gelu", batch_first=True, norm_first=True)

    def forward(self, src: Tensor, *args: Any, **options: Any) -> Tensor:
        # Where other layers run in bfloat16, the backward pass of attention would take four times
        # as long on a CPU as in float32.
        with torch.autocast("cpu", enabled=False):
            sequence = src if src.is_cuda else src.to(self.linear1.weight.dtype)
            return super().forward(sequence, *args, **options)


def build_sequence_path(config: NetworkConfig, axis: int) -> SequencePath:
    """Build the layer that ``config.block`` names: ``mamba``, ``lstm`` or ``transformer``.

    Args:
        config: Kind and sizes of the layer.
        axis: 0 for a layer along time, 1 for one along frequency.

    >>> from hlsim.neuro.config import NeuroConfig
    >>> build_sequence_path(NeuroConfig(structure="dual-path", block="lstm"), axis=0).core
    BidirectionalLSTM(
      (lstm): LSTM(48, 96, batch_first=True, bidirectional=True)
    )
    """
    channels = config.channels
    inner = config.expansion * channels
    core: nn.Module
    if config.block == "mamba":
        core = BidirectionalMamba(channels, config.states, config.expansion)
        width = 2 * channels
    elif config.block == "lstm":
        core = BidirectionalLSTM(channels, inner)
        width = 2 * inner
    else:
        core = EncoderLayer(channels, config.heads, inner)
        width = channels
    return SequencePath(channels, axis, core, width)
