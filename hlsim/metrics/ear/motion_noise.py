"""Noise on the motion of the basilar membrane, drawn as pyclarity draws it."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hlsim.metrics.ear.model import CHANNELS
from hlsim.torchtools import compute_once


class MotionNoise(NamedTuple):
    """Noise of one item, and what the random numbers after it depend on.

    Attributes:
        signals: Noise with standard deviation 1 for the clean signal and for the output. Shape: (2,
            32, samples).
        state: State of NumPy's generator after the noise, from which HASPI draws its own.

    >>> MotionNoise._fields
    ('signals', 'state')
    """

    signals: Tensor
    state: Any


@compute_once  # the conditions, the ears and the scores of an item have the same noise
def draw_motion_noise(seed: int, samples: int, dtype: torch.dtype) -> MotionNoise:
    """Draw the noise of one item, which takes a sixth of the time of a HASQI with this noise.

    Args:
        seed: Seed of the generator.
        samples: Number of samples of a channel.
        dtype: Precision of the noise.

    >>> draw_motion_noise(0, 64, torch.float32).signals.shape
    torch.Size([2, 32, 64])
    """
    random = np.random.RandomState(seed)
    signals = torch.empty(2, CHANNELS, samples, dtype=dtype)
    for channel in signals.flatten(0, 1):
        channel.copy_(torch.from_numpy(random.standard_normal(samples)))
    return MotionNoise(signals, random.get_state())
