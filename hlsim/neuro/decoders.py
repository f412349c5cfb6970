"""The decoders: feature maps to a magnitude factor, a magnitude, or a phase on the transform's grid."""

import torch
from torch import Tensor, nn

from hlsim.neuro.encoder import DenseBlock


class Decoder(nn.Module):
    """Feature maps back to the transform's grid, each point to a patch of ``stride``.

    Shape: (items, channels, time / stride, frequency / stride) -> (items, outputs, time, frequency).

    Args:
        from_zero: start with an output of zero.
    """

    def __init__(
        self,
        channels: int,
        outputs: int,
        depth: int,
        stride: tuple[int, int],
        normalise: bool,
        from_zero: bool,
    ) -> None:
        super().__init__()
        self.stride = stride
        self.dense = DenseBlock(channels, depth, normalise)
        self.leave = nn.Linear(channels, outputs * stride[0] * stride[1])
        if from_zero:
            nn.init.zeros_(self.leave.weight)
            nn.init.zeros_(self.leave.bias)

    def forward(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        patches = self.leave(self.dense(features).permute(0, 2, 3, 1))
        # (items, time, frequency, (outputs, step, step)) -> (items, outputs, time, step, frequency, step)
        grid = patches.unflatten(-1, (-1, *self.stride)).permute(0, 3, 1, 4, 2, 5)
        return grid.flatten(4, 5).flatten(2, 3)[..., : size[0], : size[1]]


class MaskDecoder(Decoder):
    """Logarithm of the factor on the magnitude, starting at 0.

    Two maps a, b: the factor is exp(a x + b) with x the recruitment exponent of the ear at each frequency, since errors
    of an envelope grow with it.
    """

    def __init__(self, channels: int, depth: int, stride: tuple[int, int], normalise: bool) -> None:
        super().__init__(channels, 2, depth, stride, normalise, from_zero=True)

    def log_mask(self, features: Tensor, size: tuple[int, int], exponents: Tensor) -> Tensor:
        """Shape: as ``Decoder``, and (items, frequency) -> (items, time, frequency)."""
        scaled, plain = self(features, size).unbind(1)
        mask: Tensor = scaled * exponents.unsqueeze(1) + plain
        return mask


class PhaseDecoder(Decoder):
    """A phase as the angle of two maps; with ``residual`` it starts at 0 and is added to the input's."""

    def __init__(
        self, channels: int, depth: int, stride: tuple[int, int], normalise: bool, residual: bool
    ) -> None:
        super().__init__(channels, 2, depth, stride, normalise, from_zero=residual)
        self.residual = residual

    def phasor(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        """exp(j phase). Shape: as ``Decoder`` -> complex (items, time, frequency)."""
        real, imaginary = self(features, size).unbind(1)
        if self.residual:
            real = real + 1.0
        scale = (real.square() + imaginary.square() + 1e-8).rsqrt()
        return torch.complex(real * scale, imaginary * scale)
