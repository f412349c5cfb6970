"""The selective scan of Mamba (Gu and Dao 2023) in plain torch: parallel over time, on any device."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

# States held at a time: what fits a core's cache, or keeps a GPU busy. Items are taken in blocks of so many.
_BLOCK_CPU, _BLOCK_GPU = 2**19, 2**27


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
    """y with h[t] = exp(delta[t] A) h[t-1] + delta[t] B[t] u[t] and y[t] = C[t] h[t] + D u[t], times silu(z).

    The signature of ``mamba_ssm``'s function of that name, whose kernel does the work where it imports and the tensors
    are on a GPU. Here the recurrence is a tree: about log2(time) steps, each over all times at once; the states are
    computed again in the backward pass instead of being kept.

    Shape: u, delta, z (items, channels, time); A (channels, states); B, C (items, states, time); D, delta_bias
        (channels,) -> (items, channels, time).

    Args:
        A: negative, or the states grow.
        delta_softplus: pass delta (+ delta_bias) through softplus.

    Raises:
        ValueError: shapes that do not fit.
    """
    items, channels, time = u.shape
    states = A.shape[-1]
    if delta.shape != u.shape or A.shape[0] != channels or not B.shape == C.shape == (items, states, time):
        raise ValueError(
            f"u {[*u.shape]}, delta {[*delta.shape]}, A {[*A.shape]}, B {[*B.shape]}, C {[*C.shape]}; "
            "allowed: u and delta (items, channels, time), A (channels, states), B and C (items, states, time)"
        )
    kernel = _kernel() if u.is_cuda and u.dtype != torch.float64 else None
    if kernel is not None:
        output: Tensor = kernel(
            u, delta, A, B, C, D=D, z=z, delta_bias=delta_bias, delta_softplus=delta_softplus
        )
        return output
    if delta_bias is not None:
        delta = delta + delta_bias.unsqueeze(-1)
    if delta_softplus:
        delta = functional.softplus(delta)
    # time first: a step of the tree then works on whole rows
    first = [tensor.permute(2, 0, 1) for tensor in (delta, u, B, C)]
    y = _SelectiveScan.apply(*first, A).permute(1, 2, 0)
    if D is not None:
        y = y + D.unsqueeze(-1) * u
    return y if z is None else y * functional.silu(z)


def linear_scan(decay: Tensor, drive: Tensor) -> Tensor:
    """h with h[t] = decay[t] h[t-1] + drive[t] and h[-1] = 0. Shape: (time, ...) twice -> (time, ...).

    Neighbours are joined in pairs, their scan is one of half the length, and the times between follow from it: about
    three operations a time, log2(time) deep, and only products of decays, so that nothing overflows.
    """
    if len(drive) == 1:
        return drive
    pairs = 2 * (len(drive) // 2)
    odd = decay[1::2]
    joined = linear_scan(decay[:pairs:2] * odd, torch.addcmul(drive[1::2], odd, drive[:pairs:2]))
    states = torch.empty_like(drive)
    states[0] = drive[0]
    states[1::2] = joined
    torch.addcmul(drive[2::2], decay[2::2], joined[: (len(drive) - 1) // 2], out=states[2::2])
    return states


def _linear_scan_back(decay: Tensor, drive: Tensor) -> Tensor:
    """h with h[t] = decay[t] h[t+1] + drive[t] and h[time] = 0. Shape: (time - 1, ...), (time, ...) -> (time, ...)."""
    time = len(drive)
    if time == 1:
        return drive
    odd = time % 2  # pairs are counted from the end
    first = decay[odd::2]
    joined = _linear_scan_back(
        first[:-1] * decay[odd + 1 :: 2] if time > 3 else first[:0],
        torch.addcmul(drive[odd::2], first, drive[odd + 1 :: 2]),
    )
    states = torch.empty_like(drive)
    states[odd::2] = joined
    states[-1] = drive[-1]
    torch.addcmul(drive[odd + 1 : -1 : 2], decay[odd + 1 :: 2], joined[1:], out=states[odd + 1 : -1 : 2])
    if odd:
        torch.addcmul(drive[:1], decay[:1], joined[:1], out=states[:1])
    return states


class _SelectiveScan(torch.autograd.Function):
    """Shape: delta, u (time, items, channels); B, C (time, items, states); A (channels, states) -> as u."""

    @staticmethod
    def forward(ctx: Any, delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor) -> Tensor:
        ctx.save_for_backward(delta, u, B, C, A)
        outputs = []
        for part in _blocks(u, A):
            d, v, b, c = (tensor[:, part].contiguous() for tensor in (delta, u, B, C))
            outputs.append((_states(d, v, b, A)[1] @ c.unsqueeze(-1)).squeeze(-1))
        return torch.cat(outputs, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        delta, u, B, C, A = ctx.saved_tensors
        rows: list[tuple[Tensor, ...]] = []
        grad_A = torch.zeros_like(A)
        for part in _blocks(u, A):
            d, v, b, c, g = (tensor[:, part].contiguous() for tensor in (delta, u, B, C, grad))
            decay, states = _states(d, v, b, A)
            grad_c = (g.unsqueeze(-2) @ states).squeeze(-2)
            # the gradient of the states obeys the same recurrence, backwards, with the next time's decay
            slope = _linear_scan_back(decay[1:], g.unsqueeze(-1) * c.unsqueeze(-2))
            driven = (slope @ b.unsqueeze(-1)).squeeze(-1)
            grad_b = ((d * v).unsqueeze(-2) @ slope).squeeze(-2)
            exponent = slope[1:] * states[:-1] * decay[1:]
            grad_d = driven * v
            grad_d[1:] += (exponent * A).sum(-1)
            grad_A += (exponent * d[1:].unsqueeze(-1)).sum((0, 1))
            rows.append((grad_d, driven * d, grad_b, grad_c))
        return (*(torch.cat(parts, 1) for parts in zip(*rows, strict=True)), grad_A)


def _states(delta: Tensor, u: Tensor, B: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
    """Decays and states. Shape: -> (time, items, channels, states) twice."""
    decay = (delta.unsqueeze(-1) * A).exp_()
    return decay, linear_scan(decay, (delta * u).unsqueeze(-1) * B.unsqueeze(-2))


def _blocks(u: Tensor, A: Tensor) -> list[slice]:
    time, items = u.shape[:2]
    size = max(1, (_BLOCK_GPU if u.is_cuda else _BLOCK_CPU) // max(1, time * A.numel()))
    return [slice(start, start + size) for start in range(0, max(1, items), size)]


@cache
def _kernel() -> Callable[..., Any] | None:
    """``mamba_ssm``'s scan; None where it is not installed, or was built without its kernel."""
    try:
        from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
    except Exception:  # a build for another torch or GPU fails with whatever it likes
        return None
    return selective_scan_fn
