"""The selective scan of Mamba (Gu and Dao 2023) in plain torch: parallel over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache, cached_property, partial
from typing import Any

import torch
from torch import Tensor
from torch.linalg import vecdot
from torch.nn import functional

# States held at a time: what fits a core's cache, or keeps a GPU busy. Items and channels are taken in blocks of so many.
_BLOCK_CPU, _BLOCK_GPU = 2**18, 2**27

# Channels of a block at least: rows of fewer cost more than the cache gives.
_NARROWEST = 8

_Step = Callable[[], Any]


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
    computed again in the backward pass instead of being kept. It has a first derivative only; asked for a second, it
    raises RuntimeError.

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
    if (
        delta.shape != u.shape
        or A.shape[0] != channels
        or not B.shape == C.shape == (items, states, time)
    ):
        raise ValueError(
            f"u {[*u.shape]}, delta {[*delta.shape]}, A {[*A.shape]}, B {[*B.shape]}, C {[*C.shape]}; "
            "allowed: u and delta (items, channels, time), A (channels, states), B and C (items, states, time)"
        )
    if (kernel := _kernel_for(u)) is not None:
        output: Tensor = kernel(
            u, delta, A, B, C, D=D, z=z, delta_bias=delta_bias, delta_softplus=delta_softplus
        )
        return output
    # powers of decays want their precision
    given, whole = u.dtype, torch.promote_types(u.dtype, torch.float32)
    u, delta, A, B, C = (tensor.to(whole) for tensor in (u, delta, A, B, C))
    if delta_bias is not None:
        delta = delta + delta_bias.unsqueeze(-1)
    if delta_softplus:
        delta = functional.softplus(delta)
    y = _SelectiveScan.apply(delta.mT, u.mT, B.mT, C.mT, A.mT.contiguous()).mT
    if D is not None:
        y = torch.addcmul(y, u, D.to(whole).unsqueeze(-1))
    return (y if z is None else y * functional.silu(z)).to(given)


def _onward(decay: Tensor, states: Tensor, spare: Tensor) -> list[_Step]:
    """The steps of h[t] = decay[t] h[t-1] + drive[t] with h[-1] = 0, in place of the drive.

    Neighbours are joined in pairs, their scan is one of half the length, and the times between follow from it: about
    three operations a time, log2(time) deep, and only products of decays, so that nothing overflows.

    Shape: (items, time, ...) each; ``spare`` takes the products of decays.
    """
    time, half = states.shape[1], states.shape[1] // 2
    if not half:
        return []
    odd, later = states[:, 1::2], decay[:, 1::2]
    steps: list[_Step] = [partial(odd.addcmul_, later, states[:, : time - 1 : 2])]
    if half > 1:
        joined = spare[:, :half]
        steps.append(partial(torch.mul, later, decay[:, : time - 1 : 2], out=joined))
        steps += _onward(joined, odd, spare[:, half:])
    if time > 2:
        steps.append(partial(states[:, 2::2].addcmul_, decay[:, 2::2], odd[:, : (time - 1) // 2]))
    return steps


def _back(decay: Tensor, states: Tensor, spare: Tensor) -> list[_Step]:
    """As ``_onward``, of h[t] = decay[t] h[t+1] + drive[t] with h[time] = 0. Shape: (items, time - 1, ...) for decay."""
    time, half = states.shape[1], states.shape[1] // 2
    if not half:
        return []
    odd = time % 2  # pairs are counted from the end
    first, earlier = states[:, odd::2], decay[:, odd::2]
    steps: list[_Step] = [partial(first.addcmul_, earlier, states[:, odd + 1 :: 2])]
    if half > 1:
        joined = spare[:, : half - 1]
        steps.append(partial(torch.mul, earlier[:, :-1], decay[:, odd + 1 :: 2], out=joined))
        steps += _back(joined, first, spare[:, half:])
    if time > 2:
        between = states[:, 1 - odd : -1 : 2]
        steps.append(partial(between.addcmul_, decay[:, 1 - odd :: 2], first[:, 1 - odd :]))
    return steps


def _take(steps: list[_Step]) -> None:
    for step in steps:
        step()


class _SelectiveScan(torch.autograd.Function):
    """Shape: delta, u (items, time, channels); B, C (items, time, states); A (states, channels) -> as u.

    Inside, channels lie last and times before states: every step then works on whole rows.
    """

    @staticmethod
    def forward(delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor) -> Tensor:
        y = u.new_empty(u.shape)
        with torch.autocast(u.device.type, enabled=False):
            for rows, columns, work in _blocks(u, A, back=False):
                d, v = (tensor[rows, :, columns].contiguous() for tensor in (delta, u))
                b, c = (tensor[rows].contiguous() for tensor in (B, C))
                work.run(d, v, b, A[:, columns])
                y[rows, :, columns] = (c.unsqueeze(-2) @ work.states).squeeze(-2)
        return y

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        slopes: tuple[Tensor, ...] = _Slopes.apply(grad, *ctx.saved_tensors)
        return slopes


class _Slopes(torch.autograd.Function):
    """The gradients, by another function: with ``once_differentiable``, ``torch.autograd.grad`` for chosen inputs
    finds no way through a second derivative and leaves its part out.
    """

    @staticmethod
    def forward(
        grad: Tensor, delta: Tensor, u: Tensor, B: Tensor, C: Tensor, A: Tensor
    ) -> tuple[Tensor, ...]:
        grad_delta, grad_u = u.new_empty(u.shape), u.new_empty(u.shape)
        grad_A, grad_B, grad_C = torch.zeros_like(A), torch.zeros_like(B), torch.zeros_like(C)
        with torch.autocast(
            u.device.type, enabled=False
        ):  # backward may be called in an autocast region
            for rows, columns, work in _blocks(u, A, back=True):
                d, v, g = (tensor[rows, :, columns].contiguous() for tensor in (delta, u, grad))
                b, c = (tensor[rows].contiguous() for tensor in (B, C))
                a = A[:, columns]
                work.run(d, v, b, a)
                grad_C[rows] += vecdot(
                    work.states, g.unsqueeze(-2)
                )  # matmul takes three times as long
                slope = work.run_back(g, c)
                driven = (b.unsqueeze(-2) @ slope).squeeze(-2)
                grad_u[rows, :, columns] = driven * d
                grad_B[rows] += vecdot(slope, (d * v).unsqueeze(-2))
                exponent = work.states[:, :-1].mul_(work.decay[:, 1:]).mul_(slope[:, 1:])
                driven.mul_(v)[:, 1:] += torch.mul(exponent, a, out=work.spare[:, 1:]).sum(-2)
                grad_delta[rows, :, columns] = driven
                # both sums at once, of a slice, take 20 times as long
                grad_A[:, columns] += exponent.mul_(d[:, 1:].unsqueeze(-2)).sum(1).sum(0)
        return grad_delta, grad_u, grad_B, grad_C, grad_A

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        raise RuntimeError(
            "the selective scan (mamba blocks) has no second derivative; allowed: cnn or lstm blocks"
        )


class _Workspace:
    """Decays and states of a block, in memory that the next block uses again. Shape: (items, time, states, channels)."""

    def __init__(self, shape: tuple[int, ...], memory: list[Tensor]) -> None:
        views = [part[: math.prod(shape)].view(shape) for part in memory]
        self.decay, self.states, self.spare = views[:3]
        self.slope = views[-1]  # a fourth, where there is a way back
        self.onward = _onward(self.decay, self.states, self.spare)

    def run(self, delta: Tensor, u: Tensor, B: Tensor, A: Tensor) -> None:
        """Fill ``decay`` and ``states``."""
        torch.mul(delta.unsqueeze(-2), A, out=self.decay).exp_()
        torch.mul((delta * u).unsqueeze(-2), B.unsqueeze(-1), out=self.states)
        _take(self.onward)

    @cached_property
    def back(self) -> list[_Step]:
        return _back(self.decay[:, 1:], self.slope, self.spare)

    def run_back(self, grad: Tensor, C: Tensor) -> Tensor:
        """The gradient of the states: the same recurrence, backwards, with the next time's decay."""
        torch.mul(C.unsqueeze(-1), grad.unsqueeze(-2), out=self.slope)
        _take(self.back)
        return self.slope


def _blocks(u: Tensor, A: Tensor, back: bool) -> Iterator[tuple[slice, slice, _Workspace]]:
    """Items, channels and the memory to work in. Blocks are of all channels, or of one item."""
    items, time, channels = u.shape
    room = max(_NARROWEST, (_BLOCK_GPU if u.is_cuda else _BLOCK_CPU) // max(1, time * len(A)))
    width = math.ceil(channels / math.ceil(channels / room))  # blocks of about the same size
    height = max(1, min(items, room // channels))
    memory = [u.new_empty(height * time * len(A) * width) for _ in range(4 if back else 3)]
    spaces: dict[tuple[int, ...], _Workspace] = {}
    for top in range(0, items, height):
        for left in range(0, channels, width):
            shape = (min(height, items - top), time, len(A), min(width, channels - left))
            if shape not in spaces:
                spaces[shape] = _Workspace(shape, memory)
            yield slice(top, top + height), slice(left, left + width), spaces[shape]


def _kernel_for(u: Tensor) -> Callable[..., Any] | None:
    """``mamba_ssm``'s scan if ``selective_scan`` takes it for such a tensor."""
    return _kernel() if u.is_cuda and u.dtype != torch.float64 else None


@cache
def _kernel() -> Callable[..., Any] | None:
    """``mamba_ssm``'s scan; None where it is not installed, or was built without its kernel."""
    try:
        from mamba_ssm.ops.selective_scan_interface import selective_scan_fn
    except Exception:  # a build for another torch or GPU fails with whatever it likes
        return None
    return selective_scan_fn
