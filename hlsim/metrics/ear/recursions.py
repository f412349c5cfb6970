"""Recursive filters of Kates' ear in blocks, by matrix products instead of loops over samples.

Every filter of the ear is linear and time-invariant. Within a block of 64 samples its output is a
triangular Toeplitz product of the input. The influence of earlier blocks is a state of two to eight
numbers, which a small matrix advances from block to block. The result is exact, fast on a GPU, too,
and differentiable in the signal and in the bandwidths of the filters.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.torchtools import constant, without_modes

BLOCK = 64
"""Samples of a block. The length of a signal is a multiple of it."""

RATE = 24000
"""Sample rate in Hz at which the ear is defined."""

Array = NDArray[np.float64]
P = ParamSpec("P")
Filter = TypeVar("Filter")


def cached_filter(design: Callable[P, Filter]) -> Callable[P, Filter]:
    """Decorate a function that designs a filter so that it designs each filter once.

    The filter can be used outside of inference mode even if it was first designed inside.

    >>> @cached_filter
    ... def ones(count):
    ...     return torch.ones(count)
    >>> ones(2) is ones(2)
    True
    """

    @wraps(design)
    @lru_cache(maxsize=16)
    def call(*arguments: P.args, **settings: P.kwargs) -> Filter:
        return without_modes(design, *arguments, **settings)

    return cast(Callable[P, Filter], call)


class Recursion(NamedTuple):
    """Causal filter that processes a signal in blocks.

    The output of a block is ``block @ through + state @ outward``. From block to block, the state
    changes to ``state @ step + block @ inward``.

    Attributes:
        through: Response to the same block. Shape: (..., BLOCK, BLOCK), or (..., BLOCK, 2 BLOCK)
            with the real and the imaginary part side by side.
        inward: Influence of a block on the state. Shape: (..., BLOCK, states).
        outward: Response to the state. Shape: (..., states, outputs).
        step: Change of the state from block to block. Shape: (..., states, states).
        memory: Samples after which the influence of an input has vanished.

    >>> lowpass = gain_lowpass(torch.device("cpu"), torch.float64)
    >>> lowpass(torch.ones(1, 192, dtype=torch.float64)).shape
    torch.Size([1, 3, 64])
    """

    through: Tensor
    inward: Tensor
    outward: Tensor
    step: Tensor
    memory: int

    def __call__(self, signal: Tensor) -> Tensor:
        """Return the outputs in blocks.

        Shape: (rows or 1, time) -> (rows, time / BLOCK, outputs).
        """
        blocks = signal.unflatten(-1, (-1, BLOCK))
        states = _accumulate(blocks @ self.inward, self.step, self.memory // BLOCK)
        before = functional.pad(states[..., :-1, :], (0, 0, 1, 0))
        # These are the largest tensors of a score, therefore the addition is in place.
        return (blocks @ self.through).add_(before @ self.outward)

    def repeated(self, items: int) -> Recursion:
        """Return the same filters for each of several items."""
        through, inward, outward, step = (part.repeat(items, 1, 1) for part in self[:4])
        return Recursion(through, inward, outward, step, self.memory)

    def to(self, device: torch.device, dtype: torch.dtype) -> Recursion:
        """Return the filter on a device, in a dtype."""
        on_gpu = device.type != "cpu"
        through, inward, outward, step = (
            part.to(device, dtype, non_blocking=on_gpu) for part in self[:4]
        )
        return Recursion(through, inward, outward, step, self.memory)


def _accumulate(inputs: Tensor, step: Tensor, memory: int) -> Tensor:
    """Compute the states after each block. The number of blocks that are summed doubles each time.

    Shape: (..., blocks, states), (..., states, states) -> (..., blocks, states).
    """
    states, reach = inputs, 1
    while reach < min(inputs.shape[-2], memory + 1):
        later = states[..., reach:, :] + states[..., :-reach, :] @ step
        states = torch.cat((states[..., :reach, :], later), -2)
        step, reach = step @ step, 2 * reach
    return states


# -- real filters ----------------------------------------------------------------------------------


def _recursion(a: Array, b: Array, c: Array, d: float, memory: int) -> Recursion:
    """Return the filter x' = a x + b u, y = c x + d u in blocks.

    Its states are balanced so that single precision suffices.
    """
    root = scipy.linalg.cholesky(scipy.linalg.solve_discrete_lyapunov(a, b @ b.T), lower=True)
    observability = scipy.linalg.solve_discrete_lyapunov(a.T, c.T @ c)
    rotation, singular_values, _ = np.linalg.svd(root.T @ observability @ root)
    basis = root @ rotation / singular_values**0.25
    a, b, c = np.linalg.solve(basis, a @ basis), np.linalg.solve(basis, b), c @ basis
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


@cached_filter
def middle_ear(device: torch.device, dtype: torch.dtype) -> Recursion:
    """Return the filter of the middle ear.

    It is a low-pass of first order at 5 kHz and a high-pass of second order at 350 Hz, both
    Butterworth.

    Source: Kates 2013, Proceedings of Meetings on Acoustics 19, 050184.

    >>> middle_ear(torch.device("cpu"), torch.float32).step.shape
    torch.Size([3, 3])
    """
    low = scipy.signal.butter(1, 5000 / (RATE / 2))
    high = scipy.signal.butter(2, 350 / (RATE / 2), "high")
    a, b, c, d = scipy.signal.tf2ss(np.convolve(low[0], high[0]), np.convolve(low[1], high[1]))
    return _recursion(a, b, c, float(d[0, 0]), 2048).to(device, dtype)


@cached_filter
def gain_lowpass(device: torch.device, dtype: torch.dtype) -> Recursion:
    """Return the filter that smooths compressive gains over 0.2 ms.

    It is a Butterworth low-pass of first order at 800 Hz.

    >>> gain_lowpass(torch.device("cpu"), torch.float32).step.shape
    torch.Size([1, 1])
    """
    a, b, c, d = scipy.signal.tf2ss(*scipy.signal.butter(1, 800 / (RATE / 2)))
    return _recursion(a, b, c, float(d[0, 0]), 192).to(device, dtype)


ONSET_RATIO = 2.0
"""Response of an inner hair cell at an onset, relative to its steady response."""

RAPID_SECONDS, SHORT_TERM_SECONDS = 0.002, 0.060
"""Time constants of rapid and of short-term adaptation."""


@cached_filter
def adaptation(device: torch.device, dtype: torch.dtype) -> Recursion:
    """Return the filter of the inner hair cells' rapid and short-term adaptation.

    It is an electrical circuit of two resistors and two capacitors, solved by backward differences.
    Negative outputs must be set to zero.

    >>> adaptation(torch.device("cpu"), torch.float32).step.shape
    torch.Size([2, 2])
    """
    r1 = 1.0 / ONSET_RATIO
    r2 = r3 = 0.5 * (1.0 - r1)
    charge1 = r1 * r2 * RAPID_SECONDS * (r1 + r2) / (r1 * r2) * RATE
    charge2 = r2 * r3 * SHORT_TERM_SECONDS / ((r1 + r2) * r3) * RATE
    inverse = np.linalg.inv(np.array([[r1 + r2 + charge1, -r1], [-r3, r2 + r3 + charge2]]))
    a = inverse @ np.diag([charge1, charge2])
    b = inverse @ np.array([[r2], [0.0]])
    return _recursion(a, b, -a[:1] / r1, (1.0 - float(b[0, 0])) / r1, 1 << 30).to(device, dtype)


# -- gammatone filters -----------------------------------------------------------------------------

GAMMATONE_ORDER = 4


def _binomials() -> Array:
    """Return the binomial coefficients by which the powers of a distance grow in a block: (4, 4).

    Row e and column d hold "d choose e".
    """
    orders = np.arange(GAMMATONE_ORDER)
    return scipy.special.comb(orders[None, :], orders[:, None])


def gammatone(decay: Tensor, angle: Tensor, memory: int, dtype: torch.dtype) -> Recursion:
    """Return gammatone filters of fourth order as complex band-passes.

    The impulse response at sample n is g p(n) exp(n (i angle - decay)) with the polynomial
    p(n) = (n + 1)(3 n^2 + 3 n + 2) / 2. These are four poles at exp(-decay) and two zeros at
    -2 exp(-decay). The factor g gives a tone at the centre frequency its own amplitude. The modulus
    of the output is the envelope, its real part the motion of the basilar membrane. Shifting p by a
    block mixes only its four powers, therefore four complex states suffice.

    Args:
        decay: Decay per sample, 2 pi 1.019 ERB / rate for normal bandwidth. Shape: (rows,).
        angle: Phase per sample, 2 pi centre frequency / rate. Shape: (rows,).
        memory: Samples after which the response has vanished, 50 over the smallest decay.
        dtype: Dtype of the matrices, which are computed in that of ``decay``.

    >>> filters = gammatone(torch.tensor([0.05]), torch.tensor([0.3]), 1000, torch.float32)
    >>> filters(torch.zeros(1, 128)).shape
    torch.Size([1, 2, 128])
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
    phase, phase_to_end = angle[:, None] * n, angle[:, None] * (BLOCK - n)
    # within a block
    wave = (after * p[0])[..., None] * torch.stack((phase.cos(), phase.sin()), -1)  # rows, BLOCK, 2
    lag = torch.arange(BLOCK, device=decay.device)
    lag = lag - lag[:, None]
    wave = functional.pad(wave, (0, 0, 0, 1)).to(dtype)
    through = wave[:, torch.where(lag >= 0, lag, BLOCK)]  # rows, in, out, 2
    # from block to block: powers of the distance in blocks, times the decaying carrier
    power = torch.arange(GAMMATONE_ORDER, dtype=decay.dtype, device=decay.device)
    distance = ((BLOCK - n) / BLOCK)[:, None] ** power
    remainder = torch.exp(-decay[:, None] * (BLOCK - n))
    inward_real = (remainder * phase_to_end.cos())[..., None] * distance
    inward_imaginary = (remainder * phase_to_end.sin())[..., None] * distance
    inward = torch.cat((inward_real, inward_imaginary), -1)
    weight = after[:, None] * p * (float(BLOCK) ** power)[:, None]
    real, imaginary = weight * phase.cos()[:, None], weight * phase.sin()[:, None]
    outward = torch.cat((torch.cat((real, imaginary), -1), torch.cat((-imaginary, real), -1)), -2)
    binomials = constant(_binomials, dtype=decay.dtype, device=decay.device)
    decayed = torch.exp(-BLOCK * decay)[:, None, None] * binomials
    cosine = decayed * torch.cos(BLOCK * angle)[:, None, None]
    sine = decayed * torch.sin(BLOCK * angle)[:, None, None]
    step = torch.cat((torch.cat((cosine, sine), -1), torch.cat((-sine, cosine), -1)), -2)
    through = through.transpose(-1, -2).flatten(-2)
    return Recursion(through, inward.to(dtype), outward.to(dtype), step.to(dtype), memory)
