"""Smoothing of levels and gains over control frames, with a state for the next call."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators.filter_bank import HOP, RATE
from hlsim.torchtools import constant_like

BLOCK_FRAMES = 128
"""Frames that are computed together by a matrix, whose powers must not overflow."""


def decay(seconds: float) -> float:
    """Convert a time constant to the weight of the previous frame in an exponential average.

    The weight is 0 for 0 s.

    >>> round(decay(0.1), 3)
    0.961
    """
    return math.exp(-HOP / (RATE * seconds)) if seconds > 0.0 else 0.0


def average(values: Tensor, state: Tensor, past: float) -> Tensor:
    """Compute the exponential average y[n] = past y[n - 1] + (1 - past) x[n].

    Args:
        values: X.
        state: Y of the frame before the first one.
        past: Weight of the past.

    Shape: (items, frames, n), (items, n) -> (items, frames, n).

    >>> average(torch.ones(1, 3, 1), torch.zeros(1, 1), 0.5).flatten()
    tensor([0.5000, 0.7500, 0.8750])
    """
    if past == 0.0:
        return values
    averages = []
    for block in values.split(BLOCK_FRAMES, 1):
        frames = block.shape[1]
        new = constant_like(values, _weights, frames, past) @ block
        old = constant_like(values, _powers, frames, past) * state.unsqueeze(1)
        averages.append(new + old)
        state = averages[-1][:, -1]
    return averages[0] if len(averages) == 1 else torch.cat(averages, 1)


def follow_peaks(
    values: Tensor, state: Tensor, attack: float, release: float
) -> tuple[Tensor, Tensor]:
    """Smooth levels with one time constant where they rise and another where they fall.

    This is the smooth decoupled peak detector of Giannoulis, Massberg and Reiss 2012, J. Audio Eng.
    Soc. 60(6), Equation 17: p[n] = max(x[n], release p[n - 1] + (1 - release) x[n]), y[n] = attack
    y[n - 1] + (1 - attack) p[n]. It needs no loop over frames, because p is the largest of the
    averages that begin at any of the frames: p = e + d, where e is the average with ``release``,
    and d[n] = max(x[n] - e[n], release d[n - 1]).

    Args:
        values: X.
        state: E, d and y of the frame before the first one, (items, 3, n).
        attack: Weight of the past in a rising level, from ``decay``.
        release: Weight of the past in a falling level.

    Shape: (items, frames, n) -> (items, frames, n), and the state after the last frame.

    >>> values = torch.tensor([0.0, 60.0, 0.0, 0.0]).reshape(1, 4, 1)
    >>> levels, state = follow_peaks(values, torch.zeros(1, 3, 1), attack=0.0, release=0.9)
    >>> levels.flatten()
    tensor([ 0.0000, 60.0000, 54.0000, 48.6000])
    """
    slow_state, excess, smooth_state = state.unbind(1)
    slow = average(values, slow_state, release)
    blocks = []
    for block in (values - slow).split(BLOCK_FRAMES, 1):
        powers = constant_like(values, _powers, block.shape[1], release)
        highest = block / powers
        if block.shape[1] > 1:  # a stream saves the call
            highest = _running_maximum(highest)
        blocks.append(powers * torch.maximum(highest, excess.unsqueeze(1)))
        excess = blocks[-1][:, -1]
    peaks = slow + (blocks[0] if len(blocks) == 1 else torch.cat(blocks, 1))
    levels = average(peaks, smooth_state, attack)
    return levels, torch.stack((slow[:, -1], excess, levels[:, -1]), 1)


def _running_maximum(values: Tensor) -> Tensor:
    """Return the largest value up to each frame. Shape: (items, frames, n) -> the same."""
    if not torch.compiler.is_exporting():
        return torch.cummax(values, 1).values
    highest = [values[:, 0]]  # ONNX has no cummax.
    for value in values.unbind(1)[1:]:
        highest.append(torch.maximum(highest[-1], value))
    return torch.stack(highest, 1)


def _powers(frames: int, past: float) -> NDArray[np.float64]:
    """Return past ** 1 to past ** frames, (frames, 1)."""
    return past ** np.arange(1.0, frames + 1.0)[:, None]


def _weights(frames: int, past: float) -> NDArray[np.float64]:
    """Return the weight of each frame in each average, lower triangular, (frames, frames)."""
    distance = np.arange(frames)[:, None] - np.arange(frames)
    return np.where(distance >= 0, (1.0 - past) * past ** np.maximum(distance, 0), 0.0)
