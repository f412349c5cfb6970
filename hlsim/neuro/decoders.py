"""Decoders that turn feature maps into factors on the magnitude and shifts of the phase."""

from typing import Any

import torch
from torch import Tensor, nn

from hlsim.neuro.encoder import DenseBlock

EPS_SQUARE = 1e-8
"""Smallest squared modulus by which a phase shift is normalised."""


class Decoder(nn.Module):
    """Decoder from feature maps to the grid of a spectrum, whose output is 0 before training.

    Each point of the feature maps becomes a patch of ``stride`` points.

    Shape: (items, channels, time / stride, frequency / stride) -> (items, outputs, time,
        frequency).

    Args:
        channels: Number of channels of the feature maps.
        outputs: Number of values per point of the spectrum.
        depth: Number of convolutions of the dense block.
        stride: Time and frequency steps of the encoder, which the decoder undoes.
        normalise: Normalise the features in the dense block.

    >>> decoder = Decoder(8, 1, depth=0, stride=(4, 3), normalise=False)
    >>> decoder(torch.randn(2, 8, 5, 22), (20, 65)).shape
    torch.Size([2, 1, 20, 65])
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
        """Decode feature maps to a grid of the given time and frequency size."""
        patches = self.leave(self.dense(features).permute(0, 2, 3, 1))
        # (items, time, frequency, outputs * steps) -> (items, outputs, time, step, frequency, step)
        grid = patches.unflatten(-1, (-1, *self.stride)).permute(0, 3, 1, 4, 2, 5)
        return grid.flatten(4, 5).flatten(2, 3)[..., : size[0], : size[1]]


class MaskDecoder(Decoder):
    """Decoder of the logarithm of a factor on the magnitude.

    Args:
        recruiting: Decode two maps a and b, and return a x + b, where x is the exponent of
            recruitment at each frequency. The effect of an error of the envelope is proportional to
            it. Otherwise decode one map.

    >>> decoder = MaskDecoder(8, 0, (4, 3), normalise=False, recruiting=True)
    >>> decoder.log_mask(torch.randn(2, 8, 5, 22), (20, 65), torch.ones(2, 65)).shape
    torch.Size([2, 20, 65])
    """

    def __init__(
        self, channels: int, depth: int, stride: tuple[int, int], normalise: bool, recruiting: bool
    ) -> None:
        super().__init__(channels, 2 if recruiting else 1, depth, stride, normalise)
        self.recruiting = recruiting

    def log_mask(self, features: Tensor, size: tuple[int, int], exponents: Tensor) -> Tensor:
        """Decode the logarithm of the factor.

        Shape: (items, channels, time / stride, frequency / stride), (items, frequency) -> (items,
            time, frequency).

        Args:
            size: Number of frames and frequencies of the spectrum.
            exponents: Exponent of recruitment at each frequency.
        """
        maps = self(features, size).to(exponents.dtype)
        if not self.recruiting:
            return maps[:, 0]
        return maps[:, 0] * exponents.unsqueeze(1) + maps[:, 1]


class PhaseDecoder(Decoder):
    """Decoder of a phase shift, the angle of 1 + x + j y for two maps x and y.

    The paper's decoder predicts phase shifts, too.

    >>> decoder = PhaseDecoder(8, 0, (4, 3), normalise=False)
    >>> decoder.factor(torch.randn(2, 8, 5, 22), (20, 65), torch.zeros(2, 20, 65)).shape
    torch.Size([2, 20, 65])
    """

    def __init__(self, channels: int, depth: int, stride: tuple[int, int], normalise: bool) -> None:
        super().__init__(channels, 2, depth, stride, normalise)

    def factor(self, features: Tensor, size: tuple[int, int], log_gain: Tensor) -> Tensor:
        """Decode a complex factor exp(log gain + j shift).

        Shape: (items, channels, time / stride, frequency / stride), (items, time, frequency) ->
            complex (items, time, frequency).

        Args:
            size: Number of frames and frequencies of the spectrum.
            log_gain: Logarithm of the factor's magnitude.
        """
        # Autocast may return maps of lower precision than that of the weights.
        maps = self(features, size).to(self.leave.weight.dtype)
        factor: Tensor = _PhaseFactor.apply(log_gain, *maps.unbind(1))
        return factor


class _PhaseFactor(torch.autograd.Function):
    """exp(a) z / |z| for z = 1 + x + j y, with a gradient that takes a third of torch's steps.

    Let f be the result, g the gradient with respect to f, and q = g conj(f). The gradient is Re q
    with respect to a, -y Im q / |z|^2 with respect to x, and (1 + x) Im q / |z|^2 with respect to
    y.
    """

    @staticmethod
    def forward(log_gain: Tensor, x: Tensor, y: Tensor) -> Tensor:
        real = x + 1.0
        square = torch.addcmul(real.square(), y, y).clamp_min_(EPS_SQUARE)
        scale = square.rsqrt_().mul_(log_gain.exp())
        return torch.complex(real.mul_(scale), scale.mul_(y))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
        _, x, y = inputs
        ctx.save_for_backward(x, y, output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y, factor = ctx.saved_tensors
        q = gradient * factor.conj()
        real = x + 1.0
        square = torch.addcmul(real.square(), y, y).clamp_min(EPS_SQUARE)
        angle_gradient = q.imag / square
        return q.real, -y * angle_gradient, real * angle_gradient
