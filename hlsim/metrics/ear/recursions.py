"""Recursive filters of Kates' ear, computed by matrix products instead of a loop over samples.

A recursive filter computes each output sample from earlier outputs, which would take a loop over
samples in Python. Here a signal is divided into blocks of 64 samples. Within a block, the output is
a matrix times the block. One to eight numbers, the *state* of the filter, sum up the influence of
earlier blocks on later ones; a small matrix advances the state from block to block. The result is
the exact output of the filter and differentiable, and its computation is fast on a GPU, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.dsp.iir import butterworth, coefficients, digital_filter
from hlsim.torchtools import as_tensor, compute_once, constant

BLOCK = 64
"""Number of samples per block. Signals are padded to a multiple of it."""

RATE = 24000
"""Sample rate in Hz at which the ear is defined."""

Array = NDArray[np.float64]

StateSpace = tuple[Array, Array, Array, float, int]
"""A filter with the input u, the state x, the output y = c x + d u and the next state a x + b u.

The tuple has a, (states, states); b, (states, 1); c, (1, states); d; and the number of samples
after which the influence of an input sample has vanished.
"""


def apply_filter(design: Callable[[], StateSpace], signal: Tensor) -> Tensor:
    """Filter a signal by a real filter.

    Args:
        design: Function at the top level of a module that designs the filter, such as
            ``middle_ear``.
        signal: Signal whose length is a multiple of 64. Shape: (..., time).

    Returns:
        Output. Shape: (..., time).

    >>> apply_filter(gain_lowpass, torch.ones(1, 192)).shape
    torch.Size([1, 192])
    """
    (output,) = _recursion(design, signal.device, signal.dtype)(signal)
    return output.flatten(-2)


class Recursion(NamedTuple):
    """One or more recursive filters, as matrices that process a signal in blocks of 64 samples.

    The output of a block is ``block @ through + state @ outward``. The next block has the state
    ``state @ step + block @ inward``. The state sums up all earlier blocks in a few numbers.

    Attributes:
        through: Matrix from a block to its output. Shape: (..., 64, outputs), where ``outputs`` is
            64, or 128 for complex filters: the real parts, then the imaginary parts.
        inward: Matrix from a block to its contribution to the state. Shape: (..., 64, states).
        outward: Matrix from the state to the output. Shape: (..., states, outputs).
        step: Matrix from the state before a block to that after it. Shape: (..., states, states).
        memory: Number of samples after which the influence of an input sample has vanished.

    >>> lowpass = _recursion(gain_lowpass, torch.device("cpu"), torch.float64)
    >>> (output,) = lowpass(torch.ones(1, 192, dtype=torch.float64))
    >>> output.shape
    torch.Size([1, 3, 64])
    """

    through: Tensor
    inward: Tensor
    outward: Tensor
    step: Tensor
    memory: int

    def __call__(self, signal: Tensor) -> list[Tensor]:
        """Filter a signal.

        Args:
            signal: Signal whose length is a multiple of 64. Shape: (..., time), where the leading
                dimensions broadcast with those of the filters.

        Returns:
            Output in blocks; of complex filters, the real part and the imaginary part. Shape of
            each: (..., time / 64, 64).
        """
        blocks = signal.unflatten(-1, (-1, BLOCK))
        # Three matrix products for all blocks at once replace a loop over samples.
        states = _accumulate(blocks @ self.inward, self.step, self.memory // BLOCK)
        before = functional.pad(states[..., :-1, :], (0, 0, 1, 0))
        shape = *before.shape[:-1], BLOCK
        tensors = [blocks, before, self.through, self.outward]
        is_shared = self.through.ndim == 2  # one filter for all signals
        if is_shared:
            tensors[:2] = [tensor.flatten(0, -2) for tensor in tensors[:2]]
        else:
            tensors = [tensor.expand(*shape[:-2], -1, -1).flatten(0, -3) for tensor in tensors]
        blocks, before, through, outward = tensors
        outputs = []
        # Parts are computed separately, because operations on halves of one tensor are slow. The
        # second product is added in place, because outputs are the largest tensors of a score.
        parts = zip(through.split(BLOCK, -1), outward.split(BLOCK, -1), strict=True)
        for matrix, state_matrix in parts:
            output = blocks @ matrix
            if is_shared:
                output.addmm_(before, state_matrix)
            else:
                output.baddbmm_(before, state_matrix)
            outputs.append(output.view(shape))
        return outputs


def _accumulate(inputs: Tensor, step: Tensor, memory: int) -> Tensor:
    """Compute the state of a filter after each block.

    In each round of the loop, the number of blocks that a state sums up doubles.

    Args:
        inputs: Contribution of each block to the state. Shape: (..., blocks, states).
        step: Matrix from a state to the next one. Shape: (..., states, states).
        memory: Number of blocks after which a contribution has vanished.

    Returns:
        States. Shape: (..., blocks, states).
    """
    # A loop over blocks would need hundreds of small products; doubling needs a few large ones.
    states, reach = inputs, 1
    while reach < min(inputs.shape[-2], memory + 1):
        later = states[..., reach:, :] + states[..., :-reach, :] @ step
        states = torch.cat((states[..., :reach, :], later), -2)
        step, reach = step @ step, 2 * reach
    return states


# -- real filters ----------------------------------------------------------------------------------


@compute_once
def _recursion(
    design: Callable[[], StateSpace], device: torch.device, dtype: torch.dtype
) -> Recursion:
    """Convert a filter from state-space form to matrices for blocks of 64 samples.

    The form is balanced first, so that single precision suffices.

    Args:
        design: Function that designs the filter, which must be stable.
        device: Device of the matrices.
        dtype: Precision of the matrices.
    """
    a, b, c, d, memory = design()
    # Balancing makes each state as easily reached as observed. Otherwise a large and a small state
    # of a slow filter, such as adaptation, would cancel in single precision.
    root = np.linalg.cholesky(_gramian(a, b))
    observability = _gramian(a.T, c.T)
    rotation, singular_values, _ = np.linalg.svd(root.T @ observability @ root)
    basis = root @ rotation / singular_values**0.25
    a, b, c = np.linalg.solve(basis, a @ basis), np.linalg.solve(basis, b), c @ basis
    # Sample i of a block reaches sample j of the output by the impulse response at j - i, and the
    # state after the block by a^(63 - i) b.
    powers = np.array([*accumulate([np.eye(len(a)), *[a] * BLOCK], np.matmul)])
    impulse = np.append(d, c @ powers[: BLOCK - 1] @ b)
    lag = np.arange(BLOCK)[None, :] - np.arange(BLOCK)[:, None]
    through = np.where(lag >= 0, impulse[np.maximum(lag, 0)], 0.0)
    inward = (powers[BLOCK - 1 :: -1] @ b)[..., 0]
    outward = (c @ powers[:BLOCK])[:, 0].T
    matrices = (through, inward, outward, powers[BLOCK].T)
    return Recursion._make([*(as_tensor(matrix, dtype, device) for matrix in matrices), memory])


def _gramian(a: Array, b: Array) -> Array:
    """Return the matrix x with x = a x a^T + b b^T: how strongly an input excites each state.

    Shape: (states, states), (states, 1) -> (states, states).
    """
    states = len(a)
    gramian = np.linalg.solve(np.eye(states**2) - np.kron(a, a), (b @ b.T).ravel())
    return np.asarray(gramian.reshape(states, states))


def _state_space(numerator: Array, denominator: Array) -> tuple[Array, Array, Array, float]:
    """Return a, b, c and d of ``StateSpace`` for the coefficients of a filter, (states + 1,) each.

    The first coefficient of the denominator is 1.
    """
    order = len(denominator) - 1
    a = np.eye(order, k=-1)
    a[0] = -denominator[1:]
    c = numerator[None, 1:] - numerator[0] * denominator[None, 1:]
    return a, np.eye(order, 1), c, float(numerator[0])


def middle_ear() -> StateSpace:
    """Design the filter of the middle ear, between the eardrum and the cochlea, at 24 kHz.

    The filter is a low-pass of first order at 5 kHz and a high-pass of second order at 350 Hz, both
    Butterworth.

    Source: Kates 2013, Proceedings of Meetings on Acoustics 19, 050184.

    >>> middle_ear()[0].shape
    (3, 3)
    """
    low = coefficients(digital_filter(butterworth(1), 5000.0, RATE))
    high = coefficients(digital_filter(butterworth(2), 350.0, RATE, highpass=True))
    return *_state_space(np.convolve(low[0], high[0]), np.convolve(low[1], high[1])), 2048


def gain_lowpass() -> StateSpace:
    """Design the filter that smooths the gain of the outer hair cells over 0.2 ms.

    The filter is a Butterworth low-pass of first order at 800 Hz, for gains at 24 kHz.

    >>> gain_lowpass()[0].shape
    (1, 1)
    """
    return *_state_space(*coefficients(digital_filter(butterworth(1), 800.0, RATE))), 192


ONSET_RATIO = 2.0
"""Response of an inner hair cell at an onset, relative to its steady response."""

RAPID_SECONDS, SHORT_TERM_SECONDS = 0.002, 0.060
"""Time constants of rapid and of short-term adaptation in seconds."""


def adaptation() -> StateSpace:
    """Design the filter by which inner hair cells emphasise onsets, for levels in dB at 24 kHz.

    The response to an onset is twice the steady response, and decays with time constants of 2 and
    60 ms. Kates describes the filter by an electrical circuit, which is solved here by backward
    differences. Where the output is negative, the caller must replace it by zero.

    >>> adaptation()[0].shape
    (2, 2)
    """
    r1 = 1.0 / ONSET_RATIO
    r2 = r3 = 0.5 * (1.0 - r1)
    charge1 = r1 * r2 * RAPID_SECONDS * (r1 + r2) / (r1 * r2) * RATE
    charge2 = r2 * r3 * SHORT_TERM_SECONDS / ((r1 + r2) * r3) * RATE
    inverse = np.linalg.inv(np.array([[r1 + r2 + charge1, -r1], [-r3, r2 + r3 + charge2]]))
    a = inverse @ np.diag([charge1, charge2])
    b = inverse @ np.array([[r2], [0.0]])
    d = (1.0 - float(b[0, 0])) / r1
    return a, b, -a[:1] / r1, d, 1 << 30


# -- gammatone filters -----------------------------------------------------------------------------

GAMMATONE_ORDER = 4
"""Order of the gammatone filters, the number of their poles."""


@constant
def _binomials() -> Array:
    """Return the binomial coefficients of orders 0 to 3: row e, column d is "d choose e".

    They expand the powers (x + 1)^d of a distance x, in blocks, that grows by one block. Shape:
    (4, 4).
    """
    orders = range(GAMMATONE_ORDER)
    return np.array([[float(math.comb(d, e)) for d in orders] for e in orders])


def gammatone(decay: Tensor, angle: Tensor, memory: int, dtype: torch.dtype) -> Recursion:
    """Design gammatone filters of fourth order, the band-passes of the ear, with complex output.

    The magnitude of the output is the envelope of the band, and its real part the motion of the
    basilar membrane. A tone at the centre frequency keeps its amplitude.

    The impulse response at sample n is g p(n) exp(n (i angle - decay)) with the polynomial
    p(n) = (n + 1)(3 n^2 + 3 n + 2) / 2 and the gain g. These are four poles at exp(-decay) and two
    zeros at -2 exp(-decay). Shifting p by a block mixes only its four powers, therefore four
    complex numbers suffice as state.

    Args:
        decay: Decay of the response per sample, 2 pi 1.019 ERB / rate for normal bandwidth. Shape:
            (..., filters).
        angle: Phase of the centre frequency per sample, 2 pi frequency / rate. Shape: (filters,).
        memory: Number of samples after which the response has vanished, 50 over the smallest decay.
        dtype: Dtype of the matrices, which are computed in that of ``decay``.

    Returns:
        Filters. Shape of the matrices: (..., filters, ., .).

    >>> filters = gammatone(torch.tensor([0.05]), torch.tensor([0.3]), 1000, torch.float32)
    >>> real, imaginary = filters(torch.zeros(1, 128))
    >>> real.shape
    torch.Size([1, 2, 64])
    """
    n = torch.arange(BLOCK, dtype=decay.dtype, device=decay.device)
    gain = 2.0 * torch.expm1(-decay) ** 4 / (1.0 + 2.0 * torch.exp(-decay)) ** 2
    decay, angle = decay[..., None], angle[..., None]
    # p(n + m) is a polynomial in m, whose coefficients (p and its derivatives at n) are the rows.
    p = torch.stack(
        (
            (n + 1) * (3 * n**2 + 3 * n + 2) / 2,
            (9 * n**2 + 12 * n + 5) / 2,
            (9 * n + 6) / 2,
            torch.full_like(n, 1.5),
        )
    )
    after = gain[..., None] * torch.exp(-decay * n)
    phase, phase_to_end = angle * n, angle * (BLOCK - n)
    cosine, sine = phase.cos(), phase.sin()
    # within a block
    wave = (after * p[0])[..., None, :] * torch.stack((cosine, sine), -2)
    # Sample j of the output receives sample i of the block through the response at j - i.
    responses = functional.pad(wave.to(dtype), (BLOCK - 1, 0)).unfold(-1, BLOCK, 1).flip(-2)
    through = responses.transpose(-2, -3).flatten(-2)
    # from block to block: powers of the distance in blocks, times the decaying carrier
    order = torch.arange(GAMMATONE_ORDER, dtype=decay.dtype, device=decay.device)
    distance = ((BLOCK - n) / BLOCK)[:, None] ** order
    remainder = torch.exp(-decay * (BLOCK - n))
    waves_to_end = remainder * phase_to_end.cos(), remainder * phase_to_end.sin()
    inward = torch.cat([wave_to_end[..., None] * distance for wave_to_end in waves_to_end], -1)
    weight = after[..., None, :] * p * (float(BLOCK) ** order)[:, None]
    outward = _as_real(weight * cosine[..., None, :], weight * sine[..., None, :])
    binomials = _binomials(like=decay)
    decayed = torch.exp(-BLOCK * decay)[..., None] * binomials
    step_angle = BLOCK * angle[..., None]
    step = _as_real(decayed * torch.cos(step_angle), decayed * torch.sin(step_angle))
    inward, outward, step = (matrix.to(dtype) for matrix in (inward, outward, step))
    return Recursion(through, inward, outward, step, memory)


def _as_real(real: Tensor, imaginary: Tensor) -> Tensor:
    """Convert a complex matrix R + iI to the real one [[R, I], [-I, R]].

    A row vector of real parts and then imaginary parts is multiplied with it from the left.

    Shape: (..., rows, columns) twice -> (..., 2 rows, 2 columns).
    """
    return torch.cat((torch.cat((real, imaginary), -1), torch.cat((-imaginary, real), -1)), -2)
