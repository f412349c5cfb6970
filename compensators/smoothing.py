"""Smoothing of the levels and gains of bands from frame to frame, which are 4 ms apart.

A smoother gets the values of some frames and a memory of earlier ones, and returns the smoothed
values and the memory after the last frame. The next call gets this memory, so that a signal may be
processed in chunks of any number of frames.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators.filter_bank import HOP, RATE
from hlsim.torchtools import constant

BLOCK_FRAMES = 128
"""Number of frames that are smoothed together by one matrix product.

Values are divided by powers of a weight with exponents up to this number, which must not underflow.
"""


def follow_peaks(
    values: Tensor, memory: Tensor, attack: float, release: float
) -> tuple[Tensor, Tensor]:
    """Smooth values with one time constant where they rise and another where they fall.

    This is the smooth decoupled peak detector of Giannoulis, Massberg and Reiss 2012, J. Audio Eng.
    Soc. 60(6), Equation 17, without a loop over frames. With x for the values, y for the result, r
    for the weight of the past that belongs to ``release`` and a for that of ``attack``:

        p[n] = max(x[n], r p[n - 1] + (1 - r) x[n]),  y[n] = a y[n - 1] + (1 - a) p[n]

    Args:
        values: Levels or gains in dB, n for each frame.
        memory: Second result of the call for the preceding frames, zeros before the first frame.
        attack: Time constant of a rise in seconds. With 0, the result follows at once.
        release: Time constant of a fall in seconds, above 0.

    Returns:
        The smoothed values, and the memory after the last frame.

    Shape: (items, frames, n), (items, 3, n) -> (items, frames, n), (items, 3, n).

    >>> values = torch.tensor([0.0, 60.0, 0.0, 0.0]).reshape(1, 4, 1)
    >>> smoothed, memory = follow_peaks(values, torch.zeros(1, 3, 1), attack=0.0, release=0.04)
    >>> smoothed.flatten().round()
    tensor([ 0., 60., 54., 49.])
    """
    fall, rise = weight_of_past(release), weight_of_past(attack)
    # p is the largest of the averages that begin at any of the frames: p = e + d, where e is the
    # average with r, and d[n] = max(x[n] - e[n], r d[n - 1]).
    average, excess, result = memory.unbind(1)
    averages = exponential_average(values, average, fall)
    blocks = []
    for block in (values - averages).split(BLOCK_FRAMES, 1):
        powers = _powers(block.shape[1], fall, like=values)
        highest = _running_maximum(block / powers)
        blocks.append(powers * torch.maximum(highest, excess.unsqueeze(1)))
        excess = blocks[-1][:, -1]
    peaks = averages + torch.cat(blocks, 1)
    results = exponential_average(peaks, result, rise)
    return results, torch.stack((averages[:, -1], excess, results[:, -1]), 1)


def weight_of_past(seconds: float) -> float:
    """Convert a time constant to the weight of the past in an exponential average of frames.

    Args:
        seconds: Time constant in seconds; 0 has the weight 0.

    >>> round(weight_of_past(0.1), 3)
    0.961
    """
    return math.exp(-HOP / (RATE * seconds)) if seconds > 0.0 else 0.0


def exponential_average(values: Tensor, before: Tensor, past: float) -> Tensor:
    """Compute the exponential average y[n] = past y[n - 1] + (1 - past) x[n].

    Args:
        values: Values x of each frame, or of each sample.
        before: Average y before the first one.
        past: Weight of the past, 0 to below 1.

    Shape: (..., frames, n), (..., n) -> (..., frames, n).

    >>> exponential_average(torch.ones(1, 3, 1), torch.zeros(1, 1), 0.5).flatten()
    tensor([0.5000, 0.7500, 0.8750])
    """
    if past == 0.0:
        return values
    averages = []
    for block in values.split(BLOCK_FRAMES, -2):
        frames = block.shape[-2]
        new = _weights(frames, past, like=values) @ block
        old = _powers(frames, past, like=values) * before.unsqueeze(-2)
        averages.append(new + old)
        before = averages[-1][..., -1, :]
    return torch.cat(averages, -2)


def _running_maximum(values: Tensor) -> Tensor:
    """Return the largest value up to each frame. Shape: (items, frames, n) -> the same."""
    if not torch.compiler.is_exporting():
        return torch.cummax(values, 1).values
    highest = [values[:, 0]]  # ONNX has no cummax.
    for value in values.unbind(1)[1:]:
        highest.append(torch.maximum(highest[-1], value))
    return torch.stack(highest, 1)


@constant
def _powers(frames: int, past: float) -> NDArray[np.float64]:
    """Return past ** 1, past ** 2, ..., past ** frames, (frames, 1)."""
    return past ** np.arange(1.0, frames + 1.0)[:, None]


@constant
def _weights(frames: int, past: float) -> NDArray[np.float64]:
    """Return the matrix that turns values of frames into their exponential averages.

    The averages start from 0, and ``past`` is the weight of the past, 0 to below 1. Returns: Lower
    triangular, (frames, frames).
    """
    distance = np.arange(frames)[:, None] - np.arange(frames)
    return np.where(distance >= 0, (1.0 - past) * past ** np.maximum(distance, 0), 0.0)
