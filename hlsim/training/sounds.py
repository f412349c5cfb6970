"""Sounds that are not speech, made from a seed: steady tones and clicks.

Speech and noise fluctuate; a simulator that learned from them alone is decibels off on what does not.
"""

import math

import torch
from torch import Tensor

_LOWEST, _HIGHEST = 100.0, 7500.0  # Hz
_TONES, _CLICKS = 4, 8


def draw_sounds(
    items: int, samples: int, sample_rate: int, generator: torch.Generator, begun: float = 0.0
) -> Tensor:
    """Every second item one to four tones that begin anywhere in its first half, the others one to eight clicks.

    With ``begun``, as many samples more in which tones may have begun before the item does, as a share of its first half.

    Half of the tones have multiples of 250 Hz, as those of audiometry have: whole periods from frame to frame are a phase
    that stands still, which a network never sees at random frequencies.

    Shape: -> (items, samples), of no particular level.
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(items, *shape, generator=generator)

    hertz = uniform(math.log(_LOWEST), math.log(_HIGHEST), _TONES).exp()
    hertz = torch.where(uniform(0.0, 1.0, _TONES) < 0.5, 250.0 * (hertz / 250.0).ceil(), hertz)
    levels_db = uniform(-40.0, 0.0, _TONES)
    levels_db[:, 1:][uniform(0.0, 1.0, _TONES - 1) < 0.5] = -math.inf
    time = torch.arange(samples)
    # in double precision: in single, thousands of turns are noise 50 dB below the tone
    turns = (
        uniform(0.0, 1.0, _TONES).unsqueeze(-1) + hertz.double().unsqueeze(-1) * time / sample_rate
    )
    tones = (10.0 ** (levels_db / 20.0)).unsqueeze(-1) * torch.sin(2.0 * math.pi * turns).float()
    begins = uniform(-begun * 0.5 * samples, 0.5 * samples, 1)
    rise = ((time - begins) / (0.01 * sample_rate)).clamp(0.0, 1.0)  # 10 ms

    places = (uniform(0.0, 1.0, _CLICKS) * samples).long().clamp_max(samples - 1)
    heights = uniform(-1.0, 1.0, _CLICKS)
    heights[:, 0] = 1.0
    heights[:, 1:][uniform(0.0, 1.0, _CLICKS - 1) < 0.5] = 0.0
    clicks = torch.zeros(items, samples).scatter_add_(1, places, heights)
    return torch.where((torch.arange(items) % 2 == 0).unsqueeze(-1), tones.sum(1) * rise, clicks)
