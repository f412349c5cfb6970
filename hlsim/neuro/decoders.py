"""The decoders: feature maps to a magnitude factor, a magnitude, or a phase on the transform's grid."""

from typing import Any

import torch
from torch import Tensor, nn

from hlsim.neuro.encoder import DenseBlock

_TINY = 1e-8


class Decoder(nn.Module):
    """Feature maps back to the transform's grid, each point to a patch of ``stride``; zero before training.

    Shape: (items, channels, time / stride, frequency / stride) -> (items, outputs, time, frequency).
    """

    def __init__(
        self, channels: int, outputs: int, depth: int, stride: tuple[int, int], normalise: bool
    ) -> None:
        super().__init__()
        self.stride = stride
        self.dense = DenseBlock(channels, depth, normalise)
        self.leave = nn.Linear(channels, outputs * stride[0] * stride[1])
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        patches = self.leave(self.dense(features).permute(0, 2, 3, 1))
        # (items, time, frequency, (outputs, step, step)) -> (items, outputs, time, step, frequency, step)
        grid = patches.unflatten(-1, (-1, *self.stride)).permute(0, 3, 1, 4, 2, 5)
        return grid.flatten(4, 5).flatten(2, 3)[..., : size[0], : size[1]]


class MaskDecoder(Decoder):
    """Logarithm of the factor on the magnitude, starting at 0.

    Args:
        recruiting: two maps a, b: the factor is exp(a x + b) with x the recruitment exponent of the ear at each
            frequency, since errors of an envelope grow with it. Otherwise one map.
    """

    def __init__(
        self, channels: int, depth: int, stride: tuple[int, int], normalise: bool, recruiting: bool
    ) -> None:
        super().__init__(channels, 2 if recruiting else 1, depth, stride, normalise)
        self.recruiting = recruiting

    def log_mask(self, features: Tensor, size: tuple[int, int], exponents: Tensor) -> Tensor:
        """Shape: as ``Decoder``, and (items, frequency) -> (items, time, frequency)."""
        maps = self(features, size).to(exponents.dtype)
        return maps[:, 0] * exponents.unsqueeze(1) + maps[:, 1] if self.recruiting else maps[:, 0]


class PhaseDecoder(Decoder):
    """A phase shift, as the angle of two maps, starting at 0. The paper's decoder predicts shifts too."""

    def __init__(self, channels: int, depth: int, stride: tuple[int, int], normalise: bool) -> None:
        super().__init__(channels, 2, depth, stride, normalise)

    def factor(self, features: Tensor, size: tuple[int, int], log_gain: Tensor) -> Tensor:
        """exp(log gain + j shift). Shape: as ``Decoder``, (items, time, frequency) -> complex, the same."""
        dtype = self.leave.weight.dtype  # of the weights, whatever autocast makes of the maps
        result: Tensor = _Turning.apply(log_gain, *self(features, size).to(dtype).unbind(1))
        return result


class _Turning(torch.autograd.Function):
    """exp(a) z / |z| of z = 1 + x + j y, with a gradient of a third of the steps.

    With the result f, the gradient g at it, and q = g conj(f), it is Re q for a, and for x and y that of the angle:
    -y Im q / |z|^2 and (1 + x) Im q / |z|^2.
    """

    @staticmethod
    def forward(log_gain: Tensor, right: Tensor, up: Tensor) -> Tensor:
        right = right + 1.0
        scale = (
            torch.addcmul(right.square(), up, up).clamp_min_(_TINY).rsqrt_().mul_(log_gain.exp())
        )
        return torch.complex(right.mul_(scale), scale.mul_(up))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:], output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        right, up, factor = ctx.saved_tensors
        along = gradient * factor.conj()
        right = right + 1.0
        turn = along.imag / torch.addcmul(right.square(), up, up).clamp_min(_TINY)
        return along.real, -up * turn, right * turn
