"""A small network that corrects MSBG's known gains in its bands: a fraction of a network's cost on a spectrogram."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.audiogram import SEVERITIES
from hlsim.neuro.config import NeuroConfig
from hlsim.neuro.prior import CHANNELS, Prior

_STEEPEST = 6.0


class BandCorrection(nn.Module):
    """What is heard of a spectrum: smeared, and each channel weighed by a corrected gain.

    A network reads how the channels' levels fluctuate about their envelopes, and how these differ from channel to
    channel, which does not change with the level. It gives each channel's envelope a correction, its gain a factor, and
    a phase. Each severity has filters of its own, hence its own first and last layer; the last is 0 before training.

    Args:
        config: ``channels`` is the width, ``blocks`` how many, ``kernel[0]`` their length in steps of ``stride[0]``
            frames.
    """

    def __init__(self, config: NeuroConfig) -> None:
        super().__init__()
        width, severities = config.channels, len(SEVERITIES)
        self.step = config.stride[0]
        inputs = (self.step + 1) * CHANNELS
        self.enter = nn.Parameter(
            torch.randn(severities, width, inputs) / (2.0 * math.sqrt(inputs))
        )
        self.bias = nn.Parameter(torch.zeros(severities, width, 1))
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.blocks))
        outputs = (3 if config.phase == "predicted" else 2) * CHANNELS
        self.leave = nn.Parameter(torch.zeros(severities, outputs, width))

    def forward(self, spectrum: Tensor, ears: Tensor, severity: Tensor, prior: Prior) -> Tensor:
        """Shape: complex (items, frames, frequencies), (items, 8) dB HL, (items,) -> as the first."""
        widened, smeared = prior.spread(spectrum, severity)
        given = prior.levels(smeared, severity)
        level = prior.smooth(given, severity, self.step).log()
        # each of a step's frames, and the last one again where the step is cut short
        frames = given.log()
        if short := -frames.shape[-1] % self.step:
            frames = functional.pad(frames, (0, short), mode="replicate")
        about = frames.unflatten(-1, (-1, self.step)).unbind(-1)
        slope = functional.pad(level.diff(dim=1), (0, 0, 0, 1)).clamp(-_STEEPEST, _STEEPEST)
        features = self.enter[severity] @ torch.cat([*(frame - level for frame in about), slope], 1)
        features = features + self.bias[severity]
        for block in self.blocks:
            features = block(features)
        envelope, factor, *phase = (self.leave[severity] @ features).split(CHANNELS, 1)
        gain = (prior.log_gain(level + envelope, ears, severity) + factor).exp()
        turned = (
            (gain * phase[0].cos(), gain * phase[0].sin())
            if phase
            else (gain, torch.zeros_like(gain))
        )
        factors = _between(prior.weigh(torch.cat(turned, 1), severity), self.step)
        return widened * torch.view_as_complex(factors[:, : widened.shape[1]])


class _Block(nn.Module):
    """Along time in each map, then across maps, each beside what came. Shape: (items, channels, steps) -> the same."""

    def __init__(self, config: NeuroConfig) -> None:
        super().__init__()
        width, inner, length = config.channels, config.channels * config.expansion, config.kernel[0]
        self.time = nn.Conv1d(width, width, length, padding=length // 2, groups=width)
        # not convolutions of length 1, which take twice as long
        self.widen = nn.Parameter(torch.randn(inner, width) / math.sqrt(width))
        self.narrow = nn.Parameter(torch.randn(width, inner) / (2.0 * math.sqrt(inner)))
        self.bias = nn.Parameter(torch.zeros(inner, 1))

    def forward(self, features: Tensor) -> Tensor:
        features = features + functional.silu(self.time(features))
        return features + self.narrow @ functional.silu(self.widen @ features + self.bias)


def _between(values: Tensor, step: int) -> Tensor:
    """Values at every frame, on straight lines from step to step.

    Shape: (items, steps, ...) -> (items, steps * step, ...).
    """
    later = torch.cat((values[:, 1:], values[:, -1:]), 1)
    return torch.stack(
        [values, *(values.lerp(later, k / step) for k in range(1, step))], 2
    ).flatten(1, 2)
