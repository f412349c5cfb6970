"""Limit of the gradient with respect to an output, so that a few samples do not dominate it."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.torchtools import DifferentiableFunction, differentiable_once, silence_after

MAX_GRADIENT_RATIO = 6.0
"""Largest gradient outside pauses, as a multiple of the usual magnitude of the item's gradients.

The usual magnitude is the 90th percentile over samples outside pauses.
"""

LIMITER_SECONDS = 0.005
"""Duration in seconds of the blocks whose gradients are scaled together."""

SOUNDING = 1e-3
"""Power of a block, relative to that of the loudest block, from which it is not a pause."""

LIMITER_SAMPLES = 4096
"""Smallest number of samples of a longer item from which the percentile is computed."""


def limit_gradient_spikes(
    output: Tensor, sample_rate: int, lengths: Tensor | None = None
) -> Tensor:
    """Return a waveform unchanged, and limit its gradient in the backward pass.

    In ears that perceive next to nothing, a simulator gives a few samples a gradient a thousand
    times as large as that of all other samples, which then hardly affect the training step. The
    gradient is therefore divided into blocks of 5 ms. The largest magnitude in a block may be six
    times the usual magnitude of the item: the 90th percentile over its samples outside pauses, but
    without those whose gradient is 0. In pauses, which are blocks of the waveform whose RMS is more
    than 30 dB below that of the loudest block, it may be once the usual magnitude. Where it is
    larger, the whole block is scaled down to the limit. Limiting single samples would give the
    gradient a non-zero mean, from which a convolutional network learns an inaudible constant
    pressure. Samples after the end of an item have the gradient 0. NaN in a gradient is passed on.
    The gradient has no derivative of its own.

    Shape: (..., time) -> (..., time).

    Args:
        output: Output of an aid.
        sample_rate: Sample rate in Hz.
        lengths: Number of samples of each item of a padded batch, (...), on the CPU. By default,
            all items are as long as the batch.

    >>> samples = torch.randn(1, 1600, requires_grad=True)
    >>> gradient = torch.ones(1, 1600)
    >>> gradient[0, 800] = 1e6
    >>> limit_gradient_spikes(samples, sample_rate=16000).backward(gradient)
    >>> print(samples.grad.max().item() <= MAX_GRADIENT_RATIO)
    True
    """
    return _GradientLimiter.call(output, round(LIMITER_SECONDS * sample_rate), lengths)


class _GradientLimiter(DifferentiableFunction):
    """Identity whose gradient is limited, as ``limit_gradient_spikes`` describes."""

    @staticmethod
    def forward(waveform: Tensor, block: int, lengths: Tensor | None) -> Tensor:
        return waveform.view_as(waveform)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int, Tensor | None], output: Tensor) -> None:
        waveform, ctx.block, ctx.lengths = inputs
        ctx.save_for_backward(waveform)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (waveform,) = ctx.saved_tensors
        time = gradient.shape[-1]
        if ctx.lengths is not None:
            # Otherwise the gradient after the end of an item would limit that of its last block,
            # because what an ear perceives depends on later samples.
            gradient = silence_after(gradient, ctx.lengths)
        powers = _split(waveform, ctx.block).square().mean(-1)
        sizes = _split(gradient.abs(), ctx.block)
        sounding = powers >= SOUNDING * powers.amax(-1, keepdim=True)
        # Samples without a gradient, such as those after the end of an item, do not count.
        counted = sounding.unsqueeze(-1) & (sizes > 0.0)
        candidates = torch.where(counted, sizes, math.nan).flatten(-2)
        usual = _usual_sizes(candidates, time, ctx.lengths).nan_to_num(nan=math.inf)
        limit = usual * torch.where(sounding, MAX_GRADIENT_RATIO, 1.0)
        factor = (limit / sizes.amax(-1)).clamp_max(1.0)

        # Factors are linear between the edges of blocks, where the smaller one of both holds.
        before = functional.pad(factor, (1, 0), value=1.0)
        after = functional.pad(factor, (0, 1), value=1.0)
        edges = torch.minimum(before, after)
        ramp = (torch.arange(ctx.block, device=gradient.device) / ctx.block).to(edges)
        factors = torch.lerp(edges[..., :-1, None], edges[..., 1:, None], ramp).flatten(-2)
        message = (
            "a criterion that limits the gradient ('coherent-bands', 'haspi', 'hasqi') has no "
            "second derivative; use 'bands', 'paper' or a function"
        )
        return differentiable_once(gradient * factors[..., :time], message), None, None


def _usual_sizes(candidates: Tensor, time: int, lengths: Tensor | None) -> Tensor:
    """Compute the 90th percentile of magnitudes, from ``LIMITER_SAMPLES`` or more of a longer item.

    Shape: (..., n) -> (..., 1).

    Args:
        candidates: Magnitudes of the gradient; NaN where a sample is not counted.
        time: Number of samples of the batch, at most n.
        lengths: Number of samples of each item, (...), or None if each has ``time``.
    """
    if lengths is None:
        sample = candidates[..., :: max(1, time // LIMITER_SAMPLES)]
        return sample.nanquantile(0.9, -1, keepdim=True)
    # Each item is sampled as densely as it would be alone, so that padding changes no gradient.
    items = candidates.reshape(-1, candidates.shape[-1])
    quantiles = [
        item[: length : max(1, length // LIMITER_SAMPLES)].nanquantile(0.9)
        for item, length in zip(items, lengths.flatten().tolist(), strict=True)
    ]
    return torch.stack(quantiles).reshape(*lengths.shape, 1)


def _split(samples: Tensor, block: int) -> Tensor:
    """Split samples into blocks, the last one padded with zeros.

    Shape: (..., time) -> (..., blocks, block).
    """
    return functional.pad(samples, (0, -samples.shape[-1] % block)).unflatten(-1, (-1, block))
