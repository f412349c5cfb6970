"""The selective scan, the recurrence of the Mamba layer, parallel over time.

Each channel of a signal has several *states*, which remember its past: h[t] = decay[t] h[t - 1] +
drive[t], where drive is the weighted input. In the order of Mamba's names: decay[t] = exp(delta[t]
A) and drive[t] = delta[t] B[t] u[t].

Source: Gu and Dao (2023), arXiv:2312.00752.
"""

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.linalg import vecdot
from torch.nn import functional

from hlsim.torchtools import DifferentiableFunction, differentiable_once

_STATES_AT_ONCE_CPU = 2**18
"""Number of states of several items at once on a CPU, few enough for the cache of a core."""

_STATES_AT_ONCE_GPU = 2**26
"""Number of states of several items at once on a GPU, enough to keep it busy."""


def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    z: Tensor,
    delta_bias: Tensor,
) -> Tensor:
    """Filter each channel with a recursive filter whose coefficients change over time.

    This is the core of the Mamba layer. Each channel has states h[t] = exp(s[t] A) h[t - 1] +
    s[t] B[t] u[t] with h[-1] = 0 and the step size s[t] = softplus(delta[t] + delta_bias). The
    result is (C[t] h[t] + D u[t]) silu(z[t]).

    The function calls that of ``mamba_ssm``, which has the same names of arguments, for tensors on
    a GPU where it is installed, except in float64. Otherwise, the recurrence is computed in about
    log2(time) steps, each of which is parallel over time. The gradient computes the states again,
    so that they are not stored. There is no second derivative.

    Shape: (items, channels, time) -> (items, channels, time).

    Args:
        u: Input. Shape: (items, channels, time).
        delta: Step sizes before bias and softplus. Shape: (items, channels, time).
        A: Rates, negative so that the states are bounded. Shape: (channels, states).
        B: Weights of the input in the states. Shape: (items, states, time).
        C: Weights of the states in the result. Shape: (items, states, time).
        D: Weight of the input in the result. Shape: (channels,).
        z: Gate of the result. Shape: (items, channels, time).
        delta_bias: Value added to the step sizes. Shape: (channels,).

    Raises:
        RuntimeError: A second derivative is computed.

    >>> u = torch.ones(1, 1, 3)
    >>> A, D, bias = torch.zeros(1, 1), torch.zeros(1), torch.zeros(1)
    >>> step_of_1 = 0.5413 * u  # before softplus
    >>> y = selective_scan(u, step_of_1, A, B=u, C=u, D=D, z=10.0 * u, delta_bias=bias)
    >>> y.round()  # ten times a cumulative sum
    tensor([[[10., 20., 30.]]])
    """
    kernel = _kernel_for(u)
    if kernel is not None:
        return kernel(u, delta, A, B, C, D=D, z=z, delta_bias=delta_bias, delta_softplus=True)
    steps = functional.softplus(delta + delta_bias.unsqueeze(-1))
    y = _SelectiveScan.call(steps.mT, u.mT, B.mT, C.mT, A.mT.contiguous()).mT
    return torch.addcmul(y, u, D.unsqueeze(-1)) * functional.silu(z)


def _recur(decay: Tensor, states: Tensor) -> None:
    """Compute the recurrence h[t] = decay[t - 1] h[t - 1] + drive[t] with h[-1] = 0, in place.

    Neighbouring times are joined in pairs. The recurrence of the pairs has half the length and the
    same form, and the times between them follow from it. This takes about three operations per time
    in log2(time) steps. Nothing overflows, because decays are multiplied and never divided.

    Args:
        decay: Decays, which are at most 1, from each time to the next. Shape: (items, time - 1,
            ...).
        states: Drive, which the states h replace in place. Shape: (items, time, ...).
    """
    half = states.shape[1] // 2
    if half == 0:
        return
    first, second = states[:, ::2], states[:, 1::2]
    into_second, into_first = decay[:, ::2], decay[:, 1::2]
    second.addcmul_(into_second, first[:, :half])
    _recur(into_second[:, 1:] * into_first[:, : half - 1], second)
    first[:, 1:].addcmul_(into_first, second[:, : into_first.shape[1]])


def _states(delta: Tensor, u: Tensor, B: Tensor, A: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the states of some items, see ``_SelectiveScan`` for the shapes of the arguments.

    Returns:
        Decays from each time to the next, (items, time - 1, states, channels); products of
        ``delta`` and ``u``, which ``B`` weights, (items, time, 1, channels); and states, (items,
        time, states, channels).
    """
    decay = (delta[:, 1:].unsqueeze(-2) * A).exp_()
    drive = (delta * u).unsqueeze(-2)
    states = drive * B.unsqueeze(-1)
    _recur(decay, states)
    return decay, drive, states


class _SelectiveScan(DifferentiableFunction):
    """The product C[t] h[t] of ``selective_scan``, whose gradient computes the states h again.

    The step sizes ``delta`` are those after the softplus. Channels are the last dimension, so that
    each step of the recurrence works on whole rows.

    Shape: (items, time, channels) for delta and u, (items, time, states) for B and C, (states,
        channels) for A -> (items, time, channels).
    """

    @staticmethod
    def forward(delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor) -> Tensor:
        outputs = []
        for part_delta, part_u, part_B, part_C in _parts(A, delta, u, B, C):
            _, _, states = _states(part_delta, part_u, part_B, A)
            outputs.append((part_C.unsqueeze(-2) @ states).squeeze(-2))
        return torch.cat(outputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        delta, u, B, C, A = ctx.saved_tensors
        grad_A = torch.zeros_like(A)
        gradients = []
        # The backward pass may run in a region of autocast.
        with torch.autocast(u.device.type, enabled=False):
            for part in _parts(A, gradient, delta, u, B, C):
                part_gradient, part_delta, part_u, part_B, part_C = part
                decay, drive, states = _states(part_delta, part_u, part_B, A)
                # matmul takes three times as long as vecdot.
                grad_C = vecdot(states, part_gradient.unsqueeze(-2))
                # The gradient with respect to the states follows the same recurrence backwards in
                # time.
                reverse = part_C.flip(1).unsqueeze(-1) * part_gradient.flip(1).unsqueeze(-2)
                _recur(decay.flip(1), reverse)
                grad_states = reverse.flip(1)
                grad_drive = (part_B.unsqueeze(-2) @ grad_states).squeeze(-2)
                grad_B = vecdot(grad_states, drive)

                # The gradient with respect to the exponent delta[t] A
                grad_exponent = states[:, :-1] * decay * grad_states[:, 1:]
                grad_delta = grad_drive * part_u
                grad_delta[:, 1:] += (grad_exponent * A).sum(-2)
                # One sum over both dimensions of a slice takes 20 times as long as two sums.
                grad_A += (grad_exponent * part_delta[:, 1:].unsqueeze(-2)).sum(1).sum(0)
                gradients.append((grad_delta, grad_drive * part_delta, grad_B, grad_C))
        whole = [torch.cat(parts) for parts in zip(*gradients, strict=True)]
        # The states are computed in place, which autograd could not differentiate.
        message = (
            "the selective scan of mamba blocks has no second derivative; use cnn or lstm blocks"
        )
        return tuple(differentiable_once(values, message) for values in (*whole, grad_A))


def _parts(A: Tensor, *tensors: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """Divide tensors into parts of a few items, whose states fit into the cache of a CPU.

    On a GPU the parts are larger, to keep it busy.

    Args:
        A: Rates, whose size is the number of states per time.
        tensors: Tensors of shape (items, time, ...).

    Returns: For each part, the items of all tensors that belong to it.
    """
    at_once = _STATES_AT_ONCE_GPU if A.is_cuda else _STATES_AT_ONCE_CPU
    states_per_item = tensors[0].shape[1] * A.numel()
    items = max(1, at_once // states_per_item)
    return zip(*(tensor.split(items) for tensor in tensors), strict=True)


def _kernel_for(u: Tensor) -> Callable[..., Any] | None:
    """Return the scan of ``mamba_ssm`` if it supports a tensor (GPU, not float64), else None."""
    return _kernel() if u.is_cuda and u.dtype != torch.float64 else None


@cache
def _kernel() -> Callable[..., Any] | None:
    """Return the selective scan of ``mamba_ssm``, or None if it cannot be imported."""
    try:
        from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
    except Exception:  # because a build for another torch or GPU may raise anything
        return None
    return selective_scan_fn
