"""The recursive filters of Kates' ear, block by block: matrix products in place of loops over samples.

Every filter of the ear is linear and time-invariant. Within a block of 64 samples its output is a triangular Toeplitz
product of the input; what earlier blocks leave behind is a state of two to eight numbers, handed on by a small matrix.
That is exact, fast on a GPU too, and differentiable in the signal and in the filters' bandwidths.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.torchtools import constant, without_modes

BLOCK = 64
"""Samples of a block; signals are a whole number of them long."""

RATE = 24000
"""Sample rate in Hz at which the ear is defined."""

Array = NDArray[np.float64]
P = ParamSpec("P")
Made = TypeVar("Made")


def kept(make: Callable[P, Made]) -> Callable[P, Made]:
    """Made once for the same arguments, and for use in any mode."""

    @lru_cache(maxsize=16)
    def call(*arguments: P.args, **settings: P.kwargs) -> Made:
        return without_modes(make, *arguments, **settings)

    return cast(Callable[P, Made], call)


class Recursion(NamedTuple):
    """A causal filter by blocks.

    ``output = block @ through + state @ outward``, and from block to block ``state = state @ step + block @ inward``.

    Attributes:
        through: (..., BLOCK, BLOCK), or (..., BLOCK, 2 BLOCK) with real and imaginary part side by side.
        inward: (..., BLOCK, states).
        outward: (..., states, outputs).
        step: (..., states, states).
        memory: samples after which nothing of an input is left.
    """

    through: Tensor
    inward: Tensor
    outward: Tensor
    step: Tensor
    memory: int

    def __call__(self, signal: Tensor) -> Tensor:
        """The outputs, in blocks. Shape: (rows or 1, time) -> (rows, time / BLOCK, outputs)."""
        blocks = signal.unflatten(-1, (-1, BLOCK))
        states = _accumulated(blocks @ self.inward, self.step, self.memory // BLOCK)
        before = functional.pad(states[..., :-1, :], (0, 0, 1, 0))
        # in place, for these are the largest tensors of all
        return (blocks @ self.through).add_(before @ self.outward)

    def repeated(self, items: int) -> Recursion:
        """The same filters for each of several items."""
        through, inward, outward, step = (part.repeat(items, 1, 1) for part in self[:4])
        return Recursion(through, inward, outward, step, self.memory)

    def to(self, device: torch.device, dtype: torch.dtype) -> Recursion:
        """The same on a device."""
        waits = device.type == "cpu"
        through, inward, outward, step = (
            part.to(device, dtype, non_blocking=not waits) for part in self[:4]
        )
        return Recursion(through, inward, outward, step, self.memory)


def _accumulated(inputs: Tensor, step: Tensor, memory: int) -> Tensor:
    """States after each block, by doubling stretches.

    Shape: (..., blocks, states), (..., states, states) -> (..., blocks, states).
    """
    states, reach = inputs, 1
    while reach < min(inputs.shape[-2], memory + 1):
        later = states[..., reach:, :] + states[..., :-reach, :] @ step
        states = torch.cat((states[..., :reach, :], later), -2)
        step, reach = step @ step, 2 * reach
    return states


# -- real filters ------------------------------------------------------------------------------------------------------


def _recursion(a: Array, b: Array, c: Array, d: float, memory: int) -> Recursion:
    """Of the state-space filter x' = a x + b u, y = c x + d u, its states balanced for single precision."""
    root = scipy.linalg.cholesky(scipy.linalg.solve_discrete_lyapunov(a, b @ b.T), lower=True)
    seen = root.T @ scipy.linalg.solve_discrete_lyapunov(a.T, c.T @ c) @ root
    turn, size, _ = np.linalg.svd(seen)
    into = root @ turn / size**0.25
    a, b, c = np.linalg.solve(into, a @ into), np.linalg.solve(into, b), c @ into
    powers = [np.eye(len(a))]
    for _ in range(BLOCK):
        powers.append(powers[-1] @ a)
    impulse = np.array([d, *(float((c @ power @ b)[0, 0]) for power in powers[: BLOCK - 1])])
    lag = np.arange(BLOCK)[None, :] - np.arange(BLOCK)[:, None]
    through = np.where(lag >= 0, impulse[np.maximum(lag, 0)], 0.0)
    inward = np.stack([(powers[BLOCK - 1 - i] @ b)[:, 0] for i in range(BLOCK)])
    outward = np.stack([(c @ powers[i])[0] for i in range(BLOCK)], -1)
    parts = [
        torch.from_numpy(np.ascontiguousarray(x))
        for x in (through, inward, outward, powers[BLOCK].T)
    ]
    return Recursion(parts[0], parts[1], parts[2], parts[3], memory)


@kept
def middle_ear(device: torch.device, dtype: torch.dtype) -> Recursion:
    """A low-pass of first order at 5 kHz and a high-pass of second order at 350 Hz, both Butterworth (Kates 2013)."""
    low, high = (
        scipy.signal.butter(1, 5000 / (RATE / 2)),
        scipy.signal.butter(2, 350 / (RATE / 2), "high"),
    )
    a, b, c, d = scipy.signal.tf2ss(np.convolve(low[0], high[0]), np.convolve(low[1], high[1]))
    return _recursion(a, b, c, float(d[0, 0]), 2048).to(device, dtype)


@kept
def gain_lowpass(device: torch.device, dtype: torch.dtype) -> Recursion:
    """The 0.2 ms that a compressive gain takes: a Butterworth low-pass of first order at 800 Hz."""
    a, b, c, d = scipy.signal.tf2ss(*scipy.signal.butter(1, 800 / (RATE / 2)))
    return _recursion(a, b, c, float(d[0, 0]), 192).to(device, dtype)


_OVERSHOOT, _RAPID, _SHORT_TERM = 2.0, 0.002, 0.060


@kept
def adaptation(device: torch.device, dtype: torch.dtype) -> Recursion:
    """Rapid (2 ms) and short-term (60 ms) adaptation of the inner hair cell, with an onset of twice the steady output.

    An equivalent circuit of two resistors and two capacitors by backward differences; what comes out below 0 is to be
    cut by the caller.
    """
    r1 = 1.0 / _OVERSHOOT
    r2 = r3 = 0.5 * (1.0 - r1)
    charge1 = r1 * r2 * _RAPID * (r1 + r2) / (r1 * r2) * RATE
    charge2 = r2 * r3 * _SHORT_TERM / ((r1 + r2) * r3) * RATE
    inverse = np.linalg.inv(np.array([[r1 + r2 + charge1, -r1], [-r3, r2 + r3 + charge2]]))
    a = inverse @ np.diag([charge1, charge2])
    b = inverse @ np.array([[r2], [0.0]])
    return _recursion(a, b, -a[:1] / r1, (1.0 - float(b[0, 0])) / r1, 1 << 30).to(device, dtype)


# -- gammatone filters -------------------------------------------------------------------------------------------------

_ORDER = 4


def _binomials() -> Array:
    """C(d, e) in row e and column d: how the powers of a distance grow by a block. Returns (4, 4)."""
    orders = range(_ORDER)
    return np.array([[float(math.comb(d, e)) for d in orders] for e in orders])


def gammatone(decay: Tensor, angle: Tensor, memory: int, dtype: torch.dtype) -> Recursion:
    """Gammatone filters of fourth order as complex band-passes.

    The impulse response at sample n is g p(n) exp(n (i angle - decay)) with p(n) = (n + 1)(3 n^2 + 3 n + 2) / 2: four
    poles exp(-decay) with two zeros at -2 exp(-decay), g so that a tone at the centre keeps its amplitude (its envelope
    is the modulus, its motion the real part). Shifting p by a block mixes its four powers alone, hence four complex
    states.

    Args:
        decay: per sample, 2 pi 1.019 ERB / rate times the bandwidth in normal ones. Shape: (rows,).
        angle: 2 pi centre frequency / rate. Shape: (rows,).
        memory: samples after which nothing is left: 50 over the least decay.
        dtype: of the matrices; they are computed in that of ``decay``.
    """
    n = torch.arange(BLOCK, dtype=decay.dtype, device=decay.device)
    gain = 2.0 * torch.expm1(-decay) ** 4 / (1.0 + 2.0 * torch.exp(-decay)) ** 2
    p = torch.stack(
        (
            (n + 1) * (3 * n**2 + 3 * n + 2) / 2,
            (9 * n**2 + 12 * n + 5) / 2,
            (9 * n + 6) / 2,
            torch.full_like(n, 1.5),
        )
    )
    after = gain[:, None] * torch.exp(-decay[:, None] * n)
    turn, back = angle[:, None] * n, angle[:, None] * (BLOCK - n)
    # -- within a block
    wave = (after * p[0])[..., None] * torch.stack((turn.cos(), turn.sin()), -1)  # rows, BLOCK, 2
    lag = torch.arange(BLOCK, device=decay.device)
    lag = lag - lag[:, None]
    wave = functional.pad(wave, (0, 0, 0, 1)).to(dtype)
    through = wave[:, torch.where(lag >= 0, lag, BLOCK)]  # rows, in, out, 2
    # -- from block to block; powers of the distance, in blocks, times the decaying carrier
    power = torch.arange(_ORDER, dtype=decay.dtype, device=decay.device)
    distance = ((BLOCK - n) / BLOCK)[:, None] ** power
    left = torch.exp(-decay[:, None] * (BLOCK - n))
    inward = [(left * wave)[..., None] * distance for wave in (back.cos(), back.sin())]
    weight = after[:, None] * p * (float(BLOCK) ** power)[:, None]
    real, imaginary = weight * turn.cos()[:, None], weight * turn.sin()[:, None]
    outward = torch.cat((torch.cat((real, imaginary), -1), torch.cat((-imaginary, real), -1)), -2)
    binomials = constant(_binomials, dtype=decay.dtype, device=decay.device)
    whole = torch.exp(-BLOCK * decay)[:, None, None] * binomials
    cosine, sine = (whole * wave(BLOCK * angle)[:, None, None] for wave in (torch.cos, torch.sin))
    step = torch.cat((torch.cat((cosine, sine), -1), torch.cat((-sine, cosine), -1)), -2)
    through = through.transpose(-1, -2).flatten(-2)
    return Recursion(
        through, torch.cat(inward, -1).to(dtype), outward.to(dtype), step.to(dtype), memory
    )
