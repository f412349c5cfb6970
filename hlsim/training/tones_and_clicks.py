"""Random sounds that are not speech: steady tones and clicks.

Speech and noise fluctuate. A simulator that has learned from them alone has errors of several dB on
steady tones and on clicks.
"""

import math

import torch
from torch import Tensor

LOWEST_TONE = 100.0
"""Lowest frequency of a tone in Hz."""

HIGHEST_TONE = 7500.0
"""Highest frequency of a tone in Hz."""

MAX_TONES = 4
"""Largest number of tones in an item."""

MAX_CLICKS = 8
"""Largest number of clicks in an item."""

RISE_SECONDS = 0.01
"""Duration over which a tone rises to its level."""


def draw_sounds(
    items: int,
    samples: int,
    sample_rate: int,
    generator: torch.Generator,
    early_share: float = 0.0,
) -> Tensor:
    """Draw steady tones and clicks at random, without a calibrated level.

    Every second item has one to four tones, which begin at a random time in its first half. The
    other items have one to eight clicks.

    Half of the tones have multiples of 250 Hz, like those of audiometry. Such a tone has the same
    phase in every frame, which does not happen at random frequencies.

    Args:
        items: Number of sounds.
        samples: Length in samples.
        sample_rate: Sample rate in Hz.
        generator: Source of the random numbers.
        early_share: Longest time by which tones may begin before the item, relative to half the
            item.

    Returns:
        Sounds with shape (items, time).
    """

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(items, *shape, generator=generator)

    hertz = uniform(math.log(LOWEST_TONE), math.log(HIGHEST_TONE), MAX_TONES).exp()
    is_multiple = uniform(0.0, 1.0, MAX_TONES) < 0.5
    hertz = torch.where(is_multiple, 250.0 * (hertz / 250.0).ceil(), hertz)
    levels_db = uniform(-40.0, 0.0, MAX_TONES)
    is_absent = uniform(0.0, 1.0, MAX_TONES - 1) < 0.5
    levels_db[:, 1:][is_absent] = -math.inf
    amplitudes = 10.0 ** (levels_db / 20.0)
    time = torch.arange(samples)
    # In single precision, the rounding errors of the phase would be noise 50 dB below the tone.
    start_periods = uniform(0.0, 1.0, MAX_TONES).unsqueeze(-1)
    periods = start_periods + hertz.double().unsqueeze(-1) * time / sample_rate
    tones = amplitudes.unsqueeze(-1) * torch.sin(2.0 * math.pi * periods).float()
    starts = uniform(-early_share * 0.5 * samples, 0.5 * samples, 1)
    rise = ((time - starts) / (RISE_SECONDS * sample_rate)).clamp(0.0, 1.0)

    positions = (uniform(0.0, 1.0, MAX_CLICKS) * samples).long().clamp_max(samples - 1)
    heights = uniform(-1.0, 1.0, MAX_CLICKS)
    heights[:, 0] = 1.0
    is_absent = uniform(0.0, 1.0, MAX_CLICKS - 1) < 0.5
    heights[:, 1:][is_absent] = 0.0
    clicks = torch.zeros(items, samples).scatter_add_(1, positions, heights)
    has_tones = (torch.arange(items) % 2 == 0).unsqueeze(-1)
    return torch.where(has_tones, tones.sum(1) * rise, clicks)
