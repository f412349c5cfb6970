"""Input channels, among them the encoded audiogram, and the dense encoder that turns them into feature maps."""

import torch
from torch import Tensor, nn
from torch.nn import functional


def log_magnitude(squared: Tensor) -> Tensor:
    """Half the logarithm of a magnitude, from its square. Any shape; silence gives -6.3."""
    return (squared + 1e-11).log() / 4.0


def sine_of_phase(spectrum: Tensor, squared: Tensor) -> Tensor:
    """Faded out near silence: its gradient stays finite, and unlike the phase it has no jump at pi. Any shape."""
    return spectrum.imag * (squared + 1e-6).rsqrt()


class AudiogramEncoder(nn.Module):
    """Thresholds to one value a frequency: linear(flatten(average pool(ReLU(conv)))), 16 feature maps (Equation 1).

    Args:
        frequencies: F, the frequencies of the transform.
    """

    def __init__(self, frequencies: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(1, 16, kernel_size=3, padding=1)
        self.pool = nn.AvgPool1d(2)
        self.project = nn.Linear(16 * 4, frequencies)

    def forward(self, thresholds: Tensor) -> Tensor:
        """Shape: (items, 8) dB HL -> (items, F)."""
        features = torch.relu(self.conv(thresholds.unsqueeze(1) / 100.0))
        encoded: Tensor = self.project(self.pool(features).flatten(1))
        return encoded


class Unit(nn.Sequential):
    """Convolution, instance normalisation where the level may go, PReLU. Shape: (items, channels, time, frequency)."""

    def __init__(self, conv: nn.Module, channels: int, normalise: bool) -> None:
        norm = [nn.InstanceNorm2d(channels, affine=True)] if normalise else []
        super().__init__(conv, *norm, nn.PReLU(channels))


class DilatedConv(nn.Conv2d):
    """A convolution of 3 x 3, dilated in time, as long as its input. Shape: (items, channels, time, frequency)."""

    def __init__(self, inputs: int, outputs: int, dilation: int) -> None:
        super().__init__(inputs, outputs, 3, padding=(dilation, 1), dilation=(dilation, 1))

    def forward(self, features: Tensor) -> Tensor:
        step, time = self.dilation[0], features.shape[2]
        trained = torch.is_grad_enabled() and self.weight.requires_grad
        if step == 1 or not trained or features.device.type != "cpu":
            return super().forward(features)
        # on a CPU the weights' gradient takes three to six times as long with dilation as of every step-th time by itself
        phases = (
            functional.pad(features, (0, 0, 0, -time % step)).unflatten(2, (-1, step)).movedim(3, 1)
        )
        convolved = functional.conv2d(phases.flatten(0, 1), self.weight, self.bias, padding=1)
        return convolved.unflatten(0, (-1, step)).movedim(1, 3).flatten(2, 3)[:, :, :time]


class DenseBlock(nn.Module):
    """Convolutions over time and frequency, dilated 1, 2, 4, ... in time, each fed with all before it.

    Shape: (items, channels, time, frequency) -> the same. A depth of 0 changes nothing.
    """

    def __init__(self, channels: int, depth: int, normalise: bool) -> None:
        super().__init__()
        self.units = nn.ModuleList(
            Unit(DilatedConv(channels * (i + 1), channels, 2**i), channels, normalise)
            for i in range(depth)
        )

    def forward(self, features: Tensor) -> Tensor:
        outputs = [features]
        for unit in self.units:
            outputs.insert(0, unit(torch.cat(outputs, 1)))
        return outputs[0]


class DenseEncoder(nn.Module):
    """Input channels to feature maps on a coarser grid (Lu, Ai and Ling 2023).

    Shape: (items, inputs, time, frequency) -> (items, channels, time / stride, frequency / stride), rounded up.
    """

    def __init__(
        self, inputs: int, channels: int, depth: int, stride: tuple[int, int], normalise: bool
    ) -> None:
        super().__init__()
        kernel = (2 * stride[0] + 1, 2 * stride[1] + 1)
        self.enter = Unit(
            nn.Conv2d(inputs, channels, kernel, stride, padding=stride), channels, normalise
        )
        self.dense = DenseBlock(channels, depth, normalise)

    def forward(self, features: Tensor) -> Tensor:
        encoded: Tensor = self.dense(self.enter(features))
        return encoded


class FrameEncoder(nn.Module):
    """A linear map of each frame, all of its frequencies and input channels together: the monolithic baselines' entry.

    Shape: (items, inputs, time, frequency) -> (items, channels, time, 1).
    """

    def __init__(self, inputs: int, frequencies: int, channels: int) -> None:
        super().__init__()
        self.enter = nn.Linear(inputs * frequencies, channels)

    def forward(self, features: Tensor) -> Tensor:
        vectors: Tensor = self.enter(features.transpose(1, 2).flatten(2))
        return vectors.mT.unsqueeze(-1)
