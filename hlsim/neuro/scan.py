"""The selective scan, the recurrence of the Mamba layer, in torch alone and parallel over time.

Each channel of a signal has several *states*, which remember its past: h[t] = decay[t] h[t - 1] +
drive[t], where drive is the weighted input. In the order of Mamba's names: decay[t] = exp(delta[t]
A) and drive[t] = delta[t] B[t] u[t]. Items and channels are divided into *blocks*, whose states are
computed one block after the other, so that they fit into the cache of the CPU.

Source: Gu and Dao (2023), arXiv:2312.00752.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.linalg import vecdot
from torch.nn import functional

_STATES_PER_BLOCK_CPU = 2**18
"""Number of states computed at once on a CPU, few enough for the cache of a core."""

_STATES_PER_BLOCK_GPU = 2**27
"""Number of states computed at once on a GPU, enough to keep it busy."""

_MIN_CHANNELS_PER_BLOCK = 8
"""Smallest number of channels computed at once. Shorter rows cost more than the cache saves."""


def selective_scan(
    u: Tensor,
    delta: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor | None = None,
    z: Tensor | None = None,
    delta_bias: Tensor | None = None,
    delta_softplus: bool = False,
) -> Tensor:
    """Filter each channel with a recursive filter whose coefficients change over time.

    This is the core of the Mamba layer. Each channel has states h[t] = exp(delta[t] A) h[t - 1] +
    delta[t] B[t] u[t] with h[-1] = 0, and the result is (C[t] h[t] + D u[t]) silu(z[t]).

    The function has the signature of that of ``mamba_ssm``, and calls it for tensors on a GPU where
    it is installed. Otherwise, the recurrence is computed in about log2(time) steps, each of which
    is parallel over time. The gradient computes the states again, so that they are not stored.
    There is no second derivative.

    Shape: (items, channels, time) -> (items, channels, time).

    Args:
        u: Input. Shape: (items, channels, time).
        delta: Step sizes. Shape: (items, channels, time).
        A: Rates, negative so that the states are bounded. Shape: (channels, states).
        B: Weights of the input in the states. Shape: (items, states, time).
        C: Weights of the states in the result. Shape: (items, states, time).
        D: Weight of the input in the result, 0 by default. Shape: (channels,).
        z: Gate of the result, no gate by default. Shape: (items, channels, time).
        delta_bias: Value added to the step sizes, 0 by default. Shape: (channels,).
        delta_softplus: Apply softplus to the step sizes and their bias.

    Raises:
        RuntimeError: A second derivative is computed.

    >>> u = torch.ones(1, 1, 3)
    >>> selective_scan(u, delta=u, A=torch.zeros(1, 1), B=u, C=u)  # a cumulative sum
    tensor([[[1., 2., 3.]]])
    """
    kernel = _kernel_for(u)
    if kernel is not None:
        output: Tensor = kernel(
            u, delta, A, B, C, D=D, z=z, delta_bias=delta_bias, delta_softplus=delta_softplus
        )
        return output
    # Products of many decays need at least the precision of float32.
    input_dtype = u.dtype
    dtype = torch.promote_types(input_dtype, torch.float32)
    u, delta, A, B, C = (tensor.to(dtype) for tensor in (u, delta, A, B, C))
    if delta_bias is not None:
        delta = delta + delta_bias.unsqueeze(-1)
    if delta_softplus:
        delta = functional.softplus(delta)
    y = _SelectiveScan.apply(delta.mT, u.mT, B.mT, C.mT, A.mT.contiguous()).mT
    if D is not None:
        y = torch.addcmul(y, u, D.to(dtype).unsqueeze(-1))
    if z is not None:
        y = y * functional.silu(z)
    return y.to(input_dtype)


def _recur_forward(decay: Tensor, states: Tensor, scratch: Tensor) -> None:
    """Compute h[t] = decay[t] h[t - 1] + drive[t] with h[-1] = 0.

    Neighbouring times are joined in pairs. The recurrence of the pairs has half the length and the
    same form, and the times between them follow from it. This takes about three operations per time
    in log2(time) steps. Nothing overflows, because decays are multiplied and never divided.

    Shape: (items, time, ...) for all tensors.

    Args:
        decay: Decays, which are at most 1.
        states: Drive, which the states replace.
        scratch: Memory for products of decays.
    """
    time = states.shape[1]
    half = time // 2
    if half == 0:
        return
    # The second time of each pair
    second_states = states[:, 1::2]
    second_decay = decay[:, 1::2]
    first_states = states[:, : time - 1 : 2]
    second_states.addcmul_(second_decay, first_states)
    if half > 1:
        pair_decay = scratch[:, :half]
        first_decay = decay[:, : time - 1 : 2]
        torch.mul(second_decay, first_decay, out=pair_decay)
        _recur_forward(pair_decay, second_states, scratch[:, half:])
    if time > 2:
        states_before = second_states[:, : (time - 1) // 2]
        states[:, 2::2].addcmul_(decay[:, 2::2], states_before)


def _recur_backward(decay: Tensor, states: Tensor, scratch: Tensor) -> None:
    """Compute h[t] = decay[t] h[t + 1] + drive[t] with h[time] = 0.

    This is ``_recur_forward`` backwards in time, with pairs counted from the end.

    Shape: (items, time - 1, ...) for ``decay``, (items, time, ...) for the others.
    """
    time = states.shape[1]
    half = time // 2
    if half == 0:
        return
    start = time % 2
    first_states = states[:, start::2]
    first_decay = decay[:, start::2]
    second_states = states[:, start + 1 :: 2]
    first_states.addcmul_(first_decay, second_states)
    if half > 1:
        pair_decay = scratch[:, : half - 1]
        second_decay = decay[:, start + 1 :: 2]
        torch.mul(first_decay[:, :-1], second_decay, out=pair_decay)
        _recur_backward(pair_decay, first_states, scratch[:, half:])
    if time > 2:
        states_after = first_states[:, 1 - start :]
        states[:, 1 - start : -1 : 2].addcmul_(decay[:, 1 - start :: 2], states_after)


class _SelectiveScan(torch.autograd.Function):
    """The scan with its gradient, where channels are last, so that each step works on whole rows.

    Shape: (items, time, channels) for delta and u, (items, time, states) for B and C, (states,
        channels) for A -> (items, time, channels).
    """

    @staticmethod
    def forward(delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor) -> Tensor:
        y = u.new_empty(u.shape)
        with torch.autocast(u.device.type, enabled=False):
            for items, channels, (decay, states, scratch) in _blocks(u, A, tensors=3):
                block_delta = delta[items, :, channels].contiguous()
                block_u = u[items, :, channels].contiguous()
                block_B = B[items].contiguous()
                block_C = C[items].contiguous()
                torch.mul(block_delta.unsqueeze(-2), A[:, channels], out=decay).exp_()
                drive = (block_delta * block_u).unsqueeze(-2)
                torch.mul(drive, block_B.unsqueeze(-1), out=states)
                _recur_forward(decay, states, scratch)
                block_y = block_C.unsqueeze(-2) @ states
                y[items, :, channels] = block_y.squeeze(-2)
        return y

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        gradients: tuple[Tensor, ...] = _ScanGradient.apply(gradient, *ctx.saved_tensors)
        return gradients


class _ScanGradient(torch.autograd.Function):
    """Gradients of the scan, which raise an error if they are differentiated.

    With ``once_differentiable`` instead, ``torch.autograd.grad`` for a subset of the inputs would
    ignore the second derivative without an error.
    """

    @staticmethod
    def forward(
        gradient: Tensor, delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor
    ) -> tuple[Tensor, ...]:
        grad_delta = u.new_empty(u.shape)
        grad_u = u.new_empty(u.shape)
        grad_A = torch.zeros_like(A)
        grad_B = torch.zeros_like(B)
        grad_C = torch.zeros_like(C)
        # The backward pass may run in a region of autocast.
        with torch.autocast(u.device.type, enabled=False):
            for items, channels, memory in _blocks(u, A, tensors=4):
                decay, states, scratch, grad_states = memory
                block_delta = delta[items, :, channels].contiguous()
                block_u = u[items, :, channels].contiguous()
                block_gradient = gradient[items, :, channels].contiguous()
                block_B = B[items].contiguous()
                block_C = C[items].contiguous()
                block_A = A[:, channels]
                torch.mul(block_delta.unsqueeze(-2), block_A, out=decay).exp_()
                drive = (block_delta * block_u).unsqueeze(-2)
                torch.mul(drive, block_B.unsqueeze(-1), out=states)
                _recur_forward(decay, states, scratch)
                # matmul takes three times as long as vecdot.
                grad_C[items] += vecdot(states, block_gradient.unsqueeze(-2))
                # The gradient with respect to the states follows the same recurrence backwards in
                # time, with the decay of the following time.
                torch.mul(block_C.unsqueeze(-1), block_gradient.unsqueeze(-2), out=grad_states)
                _recur_backward(decay[:, 1:], grad_states, scratch)
                grad_drive = (block_B.unsqueeze(-2) @ grad_states).squeeze(-2)
                grad_u[items, :, channels] = grad_drive * block_delta
                grad_B[items] += vecdot(grad_states, drive)

                # The gradient with respect to the exponent delta[t] A replaces the states.
                grad_exponent = states[:, :-1].mul_(decay[:, 1:]).mul_(grad_states[:, 1:])
                product = torch.mul(grad_exponent, block_A, out=scratch[:, 1:])
                block_grad_delta = grad_drive.mul_(block_u)
                block_grad_delta[:, 1:] += product.sum(-2)
                grad_delta[items, :, channels] = block_grad_delta
                grad_exponent.mul_(block_delta[:, 1:].unsqueeze(-2))
                # One sum over both dimensions of a slice takes 20 times as long as two sums.
                grad_A[:, channels] += grad_exponent.sum(1).sum(0)
        return grad_delta, grad_u, grad_B, grad_C, grad_A

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        raise RuntimeError(
            "the selective scan of mamba blocks has no second derivative; use cnn or lstm blocks"
        )


def _blocks(u: Tensor, A: Tensor, tensors: int) -> Iterator[tuple[slice, slice, list[Tensor]]]:
    """Divide items and channels into blocks, either of all channels or of one item.

    Yields:
        Items of the block, its channels, and a number of tensors for values of all its states,
        (items, time, states, channels) each, in memory that all blocks share.
    """
    items, time, channels = u.shape
    states = len(A)
    states_per_block = _STATES_PER_BLOCK_GPU if u.is_cuda else _STATES_PER_BLOCK_CPU
    rows = max(_MIN_CHANNELS_PER_BLOCK, states_per_block // max(1, time * states))
    # Blocks of one item have about the same number of channels each.
    channels_per_block = math.ceil(channels / math.ceil(channels / rows))
    items_per_block = max(1, min(items, rows // channels))
    values = items_per_block * time * states * channels_per_block
    memory = [u.new_empty(values) for _ in range(tensors)]
    for item in range(0, items, items_per_block):
        for channel in range(0, channels, channels_per_block):
            block_items = min(items_per_block, items - item)
            block_channels = min(channels_per_block, channels - channel)
            shape = (block_items, time, states, block_channels)
            yield (
                slice(item, item + block_items),
                slice(channel, channel + block_channels),
                [part[: math.prod(shape)].view(shape) for part in memory],
            )


def _kernel_for(u: Tensor) -> Callable[..., Any] | None:
    """Return the scan of ``mamba_ssm`` if it works for a tensor, otherwise None."""
    return _kernel() if u.is_cuda and u.dtype != torch.float64 else None


@cache
def _kernel() -> Callable[..., Any] | None:
    """Import the scan of ``mamba_ssm``; None if it or its compiled kernel is not installed."""
    try:
        from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
    except Exception:  # because a build for another torch or GPU may raise anything
        return None
    return selective_scan_fn
