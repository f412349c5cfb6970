"""Smoothing over control frames, all frames of a call at once, with the state that the next call goes on from."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from compensators.filter_bank import HOP, RATE
from hlsim.torchtools import constant_like

_BLOCK = 128  # frames; the weights of a block are a matrix, and must not overflow


def decay(seconds: float) -> float:
    """Weight of the past in a frame that falls to 1 / e in so many seconds; 0 s gives 0."""
    return math.exp(-HOP / (RATE * seconds)) if seconds > 0.0 else 0.0


def average(values: Tensor, state: Tensor, past: float) -> Tensor:
    """Exponential average, y[n] = past y[n - 1] + (1 - past) x[n].

    Shape: (items, frames, n) and (items, n), the last y before them -> (items, frames, n).
    """
    if past == 0.0:
        return values
    done = []
    for block in values.split(_BLOCK, 1):
        frames = block.shape[1]
        done.append(
            constant_like(values, _weights, frames, past) @ block
            + constant_like(values, _fading, frames, past) * state.unsqueeze(1)
        )
        state = done[-1][:, -1]
    return done[0] if len(done) == 1 else torch.cat(done, 1)


def follow_peaks(
    values: Tensor, state: Tensor, attack: float, release: float
) -> tuple[Tensor, Tensor]:
    """A level that rises with ``attack`` and falls with ``release``, both weights of the past.

    The smooth decoupled peak detector of Giannoulis, Massberg and Reiss 2012, J. Audio Eng. Soc. 60(6), Equation 17:
    p[n] = max(x[n], release p[n - 1] + (1 - release) x[n]), y[n] = attack y[n - 1] + (1 - attack) p[n]. As p is the
    largest of what the average would be from any of the frames on, it needs no loop over frames: p = e + d, of which e is
    the average with ``release`` and d[n] = max(x[n] - e[n], release d[n - 1]).

    Args:
        state: e, d and y of the frame before, (items, 3, n).

    Shape: (items, frames, n) -> (items, frames, n) and the state after them.
    """
    mean, excess, smooth = state.unbind(1)
    slow = average(values, mean, release)
    done = []
    for over in (values - slow).split(_BLOCK, 1):
        fading = constant_like(values, _fading, over.shape[1], release)
        # one frame is its own largest: ONNX has no cummax, and a stream saves the call
        highest = over / fading if over.shape[1] == 1 else torch.cummax(over / fading, 1).values
        done.append(fading * torch.maximum(highest, excess.unsqueeze(1)))
        excess = done[-1][:, -1]
    peaks = slow + (done[0] if len(done) == 1 else torch.cat(done, 1))
    followed = average(peaks, smooth, attack)
    return followed, torch.stack((slow[:, -1], excess, followed[:, -1]), 1)


def _fading(frames: int, past: float) -> NDArray[np.float64]:
    """Returns (frames, 1)."""
    return past ** np.arange(1.0, frames + 1.0)[:, None]


def _weights(frames: int, past: float) -> NDArray[np.float64]:
    """Returns (frames, frames), lower triangular."""
    apart = np.arange(frames)[:, None] - np.arange(frames)
    return np.where(apart >= 0, (1.0 - past) * past ** np.maximum(apart, 0), 0.0)
