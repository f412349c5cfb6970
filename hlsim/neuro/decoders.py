"""Decoders: they turn the feature maps of a network into factors of a spectrogram.

A spectrogram has the shape (items, time, frequency). Feature maps are coarser: (items, channels,
time / stride[0], frequency / stride[1]), rounded up. From each point of the feature maps, a decoder
computes a patch of stride[0] by stride[1] points of the spectrogram. The patches together are cut
to the number of frames and frequencies of the spectrogram.
"""

from typing import Any

import torch
from torch import Tensor, nn

from hlsim.neuro.encoder import DenseBlock
from hlsim.torchtools import DifferentiableFunction

EPS_SQUARE = 1e-8
"""Smallest squared modulus by which ``phase_factor`` divides."""


class Decoder(nn.Module):
    """Decoder from feature maps to values at each point of a spectrogram.

    Before training, all values are 0.

    Shape: (items, channels, time / stride[0], frequency / stride[1]) -> (items, outputs, time,
        frequency).

    Args:
        channels: Number of channels of the feature maps.
        depth: Number of convolutions before the last layer.
        stride: Frames and frequencies of the spectrogram per point of the feature maps.
        outputs: Number of values per point of the spectrogram.
        normalise: Normalise the output of each convolution per item and channel.

    >>> decoder = Decoder(8, depth=0, stride=(4, 3), outputs=1, normalise=False)
    >>> decoder(torch.randn(2, 8, 5, 22), (20, 65)).shape
    torch.Size([2, 1, 20, 65])
    """

    def __init__(
        self, channels: int, depth: int, stride: tuple[int, int], outputs: int, normalise: bool
    ) -> None:
        super().__init__()
        self.stride = stride
        self.dense = DenseBlock(channels, depth, normalise)
        self.leave = nn.Linear(channels, outputs * stride[0] * stride[1])
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, features: Tensor, size: tuple[int, int]) -> Tensor:
        """Decode feature maps to values at each point of a spectrogram, see the class.

        Args:
            features: Feature maps.
            size: Number of frames and of frequencies of the spectrogram.
        """
        patches = self.leave(self.dense(features).permute(0, 2, 3, 1))
        # (items, time, frequency, outputs * step * step)
        # -> (items, outputs, time, step, frequency, step)
        grid = patches.unflatten(-1, (-1, *self.stride)).permute(0, 3, 1, 4, 2, 5)
        return grid.flatten(4, 5).flatten(2, 3)[..., : size[0], : size[1]]


def phase_factor(maps: Tensor, log_gain: Tensor) -> Tensor:
    """Compute the complex factor by which a network multiplies the input's spectrogram.

    The factor is exp(log gain + j shift). The shift of the phase is the angle of 1 + x + j y for
    two decoded values x and y.

    Shape: (items, 2, time, frequency), (items, time, frequency) -> complex (items, time,
        frequency).

    Args:
        maps: The values x and y at each point of the spectrogram, from a ``Decoder`` with two
            outputs.
        log_gain: Natural logarithm of the factor's magnitude.

    >>> phase_factor(torch.zeros(1, 2, 20, 65), torch.zeros(1, 20, 65))[0, 0, 0]
    tensor(1.+0.j)
    """
    # Autocast may return maps of lower precision.
    return _PhaseFactor.call(log_gain, *maps.to(log_gain.dtype).unbind(1))


class _PhaseFactor(DifferentiableFunction):
    """The function exp(a) z / |z| of z = 1 + x + j y, with a hand-written backward pass.

    The backward pass takes half of autograd's time. Let f be the result, g the gradient with
    respect to f, and q = g conj(f). The gradient is Re q with respect to a, -y Im q / |z|^2 with
    respect to x, and (1 + x) Im q / |z|^2 with respect to y. Shape of a, x and y: (items, time,
    frequency).
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
        # Re q changes the magnitude, and Im q turns the angle, of which d/dx is -y / |z|^2.
        q = gradient * factor.conj()
        real = x + 1.0
        square = torch.addcmul(real.square(), y, y).clamp_min(EPS_SQUARE)
        angle_gradient = q.imag / square
        return q.real, -y * angle_gradient, real * angle_gradient
