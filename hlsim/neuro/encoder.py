"""Encoders: they turn a spectrogram and an audiogram into the feature maps of a network."""

import torch
from torch import Tensor, nn


def log_magnitude(squared: Tensor) -> Tensor:
    """Compute an input channel of the networks: half the natural logarithm of magnitudes.

    Args:
        squared: Squared magnitudes, any shape, so the result is ``log(squared) / 4``; for 0 it is
            -6.3.

    >>> log_magnitude(torch.tensor([100.0, 1.0, 0.0])).round(decimals=2)
    tensor([ 1.1500,  0.0000, -6.3300])
    """
    return (squared + 1e-11).log() / 4.0


def sine_of_phase(spectrum: Tensor, squared: Tensor) -> Tensor:
    """Compute the sine of the phase of spectra, an input of networks beside the magnitude.

    Unlike the phase, its sine does not jump where the phase wraps from pi to -pi. In silence the
    result fades to 0 with a finite gradient.

    Args:
        spectrum: Complex spectra, any shape.
        squared: Squared magnitudes of these spectra, of the same shape.

    >>> spectrum = torch.tensor([2.0j, 0.0j])
    >>> sine_of_phase(spectrum, torch.tensor([4.0, 0.0])).round(decimals=3)
    tensor([1., 0.])
    """
    return spectrum.imag * (squared + 1e-6).rsqrt()


class AudiogramEncoder(nn.Module):
    """Encoder of an audiogram to one value per frequency, an input channel of the networks.

    The encoder consists of a convolution with 16 feature maps, a ReLU, average pooling and a linear
    layer.

    Source: the Neuro-MSBG paper, Equation 1.

    Args:
        frequencies: Number of frequencies of the spectrogram.

    >>> AudiogramEncoder(201)(torch.full((2, 8), 40.0)).shape
    torch.Size([2, 201])
    """

    def __init__(self, frequencies: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(1, 16, kernel_size=3, padding=1)
        self.pool = nn.AvgPool1d(2)
        self.project = nn.Linear(16 * 4, frequencies)

    def forward(self, thresholds: Tensor) -> Tensor:
        """Encode audiograms in dB HL. Shape: (items, 8) -> (items, frequencies)."""
        features = torch.relu(self.conv(thresholds.unsqueeze(1) / 100.0))
        return self.project(self.pool(features).flatten(1))


class Unit(nn.Sequential):
    """A convolution, optional instance normalisation, and a PReLU.

    Shape: (items, inputs, time, frequency) -> (items, channels, time, frequency).

    Args:
        conv: The convolution.
        channels: Number of channels of its output.
        normalise: Normalise each item and channel, so that the output does not depend on the level
            of the input.

    >>> Unit(nn.Conv2d(2, 8, 3, padding=1), 8, normalise=True)(torch.randn(1, 2, 20, 5)).shape
    torch.Size([1, 8, 20, 5])
    """

    def __init__(self, conv: nn.Module, channels: int, normalise: bool) -> None:
        norm = [nn.InstanceNorm2d(channels, affine=True)] if normalise else []
        super().__init__(conv, *norm, nn.PReLU(channels))


class DenseBlock(nn.Module):
    """Convolutions with dilations 1, 2, 4, ... in time, each of which reads all earlier outputs.

    Each convolution has a kernel of 3 by 3 points and a PReLU. The convolutions are not causal:
    they see as much of the future as of the past. The output is that of the last convolution.

    Shape: (items, channels, time, frequency) -> (items, channels, time, frequency).

    Args:
        channels: Number of channels.
        depth: Number of convolutions. With 0, the output is the input.
        normalise: Normalise the output of each convolution per item and channel.

    >>> DenseBlock(8, depth=2, normalise=False)(torch.randn(1, 8, 20, 5)).shape
    torch.Size([1, 8, 20, 5])
    """

    def __init__(self, channels: int, depth: int, normalise: bool) -> None:
        super().__init__()
        self.units = nn.ModuleList()
        for i in range(depth):
            # padding by the dilation keeps the number of frames
            dilation = (2**i, 1)
            conv = nn.Conv2d(channels * (i + 1), channels, 3, padding=dilation, dilation=dilation)
            self.units.append(Unit(conv, channels, normalise))

    def forward(self, features: Tensor) -> Tensor:
        outputs = [features]
        for unit in self.units:
            outputs.insert(0, unit(torch.cat(outputs, 1)))
        return outputs[0]


class DenseEncoder(nn.Module):
    """Encoder of the input channels, such as magnitude and phase, to coarser feature maps.

    Shape: (items, inputs, time, frequency) -> (items, channels, ceil(time / stride[0]),
        ceil(frequency / stride[1])).

    Source: MP-SENet (Lu, Ai and Ling 2023).

    Args:
        inputs: Number of input channels.
        channels: Number of feature maps.
        depth: Number of dilated convolutions after the first one.
        stride: Frames and frequencies of the input per point of the feature maps.
        normalise: Normalise the output of each convolution per item and channel.

    >>> encoder = DenseEncoder(3, 8, depth=0, stride=(4, 3), normalise=False)
    >>> encoder(torch.randn(1, 3, 20, 65)).shape
    torch.Size([1, 8, 5, 22])
    """

    def __init__(
        self, inputs: int, channels: int, depth: int, stride: tuple[int, int], normalise: bool
    ) -> None:
        super().__init__()
        kernel = (2 * stride[0] + 1, 2 * stride[1] + 1)
        conv = nn.Conv2d(inputs, channels, kernel, stride, padding=stride)
        self.enter = Unit(conv, channels, normalise)
        self.dense = DenseBlock(channels, depth, normalise)

    def forward(self, features: Tensor) -> Tensor:
        return self.dense(self.enter(features))
