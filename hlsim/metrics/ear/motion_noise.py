"""Noise on the motion of the basilar membrane, drawn as pyclarity draws it."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.metrics.ear.model import CHANNELS
from hlsim.torchtools import compute_once

_PAIRS_AT_A_TIME = 16384
"""Number of pairs of random numbers that are drawn before they are counted; they fit a cache."""


@compute_once  # the conditions, the ears and the scores of an item have the same noise
def draw_motion_noise(seed: int, samples: int, dtype: torch.dtype) -> Tensor:
    """Draw the noise of one item, which takes a fifth of the time of a HASQI or more.

    Args:
        seed: Seed of the generator.
        samples: Number of samples of a channel.
        dtype: Precision of the noise.

    Returns:
        Noise with standard deviation 1 for the clean signal and for the output, (2, 32, samples).

    >>> draw_motion_noise(0, 64, torch.float32).shape
    torch.Size([2, 32, 64])
    """
    random = np.random.RandomState(seed)
    noise = torch.empty(2, CHANNELS, samples, dtype=dtype)
    for channel in noise.flatten(0, 1):
        channel.copy_(torch.from_numpy(random.standard_normal(samples)))
    return noise


@lru_cache(maxsize=256)  # the conditions and the ears of an item have the same state
def state_after_motion_noise(seed: int, samples: int) -> Any:
    """Return the state of NumPy's generator after ``draw_motion_noise``, without drawing the noise.

    NumPy makes two normal numbers of each pair of uniform ones that lies in a circle (Marsaglia's
    polar method), and rejects the other pairs. To find the state, it is enough to count.

    Args:
        seed: Seed of the generator.
        samples: Number of samples of a channel, 1 or more.

    Returns:
        State for ``numpy.random.RandomState.set_state``.

    >>> state_after_motion_noise(0, 64)[0]
    'MT19937'
    """
    random = np.random.RandomState(seed)
    missing = CHANNELS * samples  # pairs, of which each gives two numbers
    while True:
        state = random.get_state()
        squares = random.random_sample(2 * _PAIRS_AT_A_TIME) - 0.5
        squares *= squares
        inside = np.flatnonzero(squares[::2] + squares[1::2] < 0.25)
        if len(inside) >= missing:
            break
        missing -= len(inside)
    random.set_state(state)
    random.random_sample(2 * (inside[missing - 1] + 1))
    return random.get_state()
