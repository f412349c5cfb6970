"""Loudness recruitment: each channel is expanded by a gain that follows its envelope.

The envelope is low-passed at 75 Hz or less, so that it and the gain are computed at a 24th of the rate and the gain
is interpolated, or, where the envelope is near zero, the envelope.
"""

from functools import lru_cache
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.audiogram.thresholds import interpolation_weights
from hlsim.calibration import PASCAL_SPL
from hlsim.msbg.envelope import STEP
from hlsim.msbg.filterbank import FilterBank
from hlsim.torchtools import constant_like

CATCH_UP_SPL = 105.0
"""Level in dB SPL at which the impaired ear hears as loud as a normal one."""

# pyclarity limits the envelope to 1e-9 of its full scale of 120 dB SPL
_LOWEST_ENVELOPE = 1e-9 * 10.0 ** ((120.0 - PASCAL_SPL) / 20.0)
_HIGHEST_ENVELOPE = 10.0 ** ((CATCH_UP_SPL - PASCAL_SPL) / 20.0)
_TAPS = 6

AHEAD = _TAPS // 2
"""Steps ahead of a sample that its gain is interpolated from."""

_SLIGHT = 1.3  # expansion ratio at 24 dB HL


def expansion_ratios(thresholds: Tensor, weights: Tensor) -> Tensor:
    """Ratio 105 / (105 - threshold) by which each channel's level is expanded.

    Shape: (..., 8) dB HL, ``threshold_weights`` -> (..., channels).
    """
    # no matrix product, which a GPU may be allowed to round to ten bits: next to 105 dB HL every bit counts
    return CATCH_UP_SPL / (CATCH_UP_SPL - (thresholds.unsqueeze(-1) * weights).sum(-2))


def threshold_weights(bank: FilterBank) -> NDArray[np.float64]:
    """Weights of the eight thresholds in that of each channel. Returns (8, channels)."""
    return interpolation_weights(bank.centre_frequencies)


def gains(envelopes: Tensor, ratios: Tensor) -> Tensor:
    """The recruitment gain (envelope / catch-up level) ** (ratio - 1).

    Shape: (..., channels, steps), (..., channels) -> (..., channels, steps).
    """
    level = envelopes.clamp(_LOWEST_ENVELOPE, _HIGHEST_ENVELOPE).div_(_HIGHEST_ENVELOPE).log()
    return (level * (ratios.unsqueeze(-1) - 1.0)).exp_()


def interpolate(values: Tensor, kernel: Tensor) -> Tensor:
    """Values between the steps' ones.

    Shape: ``around``'s (..., steps + 5), ``interpolation_kernel`` -> (..., time).
    """
    width, columns = kernel.shape
    together = width - _TAPS + 1
    steps = values.shape[-1] - _TAPS + 1
    if steps % together:
        values = functional.pad(values, (0, -steps % together))
    windows = values.unfold(-1, width, together)
    # as one product, for matmul makes one a channel of it, at twice the cost
    fine = (windows.reshape(-1, width) @ kernel).view(*windows.shape[:-2], -1)
    return fine if steps % together == 0 else fine[..., : steps * columns // together]


def weigh(
    channels: Tensor, gain: Tensor, kernel: Tensor, slight: tuple[Tensor, Tensor] | None = None
) -> Tensor:
    """Interpolate the gains, apply them and sum the channels.

    Shape: (..., channels, time), ``around``'s (..., channels, steps + 5), ``interpolation_kernel`` -> (..., time).

    Args:
        slight: envelopes (..., channels, steps) and ratios (..., channels), where some ratios are slight. The low-pass
            overshoots, and where the envelope goes through zero the gain has kinks. A small loss does not bury them,
            and the way out of the ear lifts their upper end by 40 dB, so that there the envelope is interpolated instead.
    """
    full = interpolate(gain, kernel)
    if slight is not None:
        envelopes, ratios = slight
        steep = _steep(envelopes) & ((ratios != 1.0) & (ratios < _SLIGHT)).unsqueeze(-1)
        every = full.shape[-1] // steep.shape[-1]
        if steep.device.type == "cpu":
            theirs = ratios.unsqueeze(-1).expand(steep.shape)[steep]
            about = around(envelopes).unfold(-1, _TAPS, 1)[steep]
            full.unflatten(-1, (-1, every))[steep] = gains(about @ kernel[:_TAPS, :every], theirs)
        else:  # indices would have to come back from the device
            fine = gains(interpolate(around(envelopes), kernel), ratios)
            full = torch.where(steep.repeat_interleave(every, -1), fine, full)
    if torch.is_grad_enabled() and (channels.requires_grad or full.requires_grad):
        return cast(Tensor, _SumOfProducts.apply(channels, full))
    return _sum_of_products(channels, full)


def _sum_of_products(channels: Tensor, factors: Tensor) -> Tensor:
    """Shape: (..., channels, time) twice -> (..., time)."""
    if channels.device.type != "cpu":
        return (channels * factors).sum(-2)
    first, *others = zip(channels.unbind(-2), factors.unbind(-2), strict=True)
    total = torch.mul(*first)
    # in place, a channel at a time: it stays in the processor's cache, and torch's sum takes eight times as long
    for channel, factor in others:
        total.addcmul_(channel, factor)
    return total


class _SumOfProducts(torch.autograd.Function):
    """``_sum_of_products``, whose steps in place torch cannot differentiate."""

    @staticmethod
    def forward(channels: Tensor, factors: Tensor) -> Tensor:
        return _sum_of_products(channels, factors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        channels, factors = ctx.saved_tensors
        every, (first, second) = gradient.unsqueeze(-2), ctx.needs_input_grad
        return every * factors if first else None, every * channels if second else None


def around(values: Tensor) -> Tensor:
    """With those that the interpolation at the ends needs; periodic. Shape: (..., steps) -> (..., steps + 5)."""
    return torch.cat((values[..., 1 - AHEAD :], values, values[..., :AHEAD]), -1)


def _steep(envelopes: Tensor) -> Tensor:
    """Where an envelope goes through zero. Shape: (..., steps) -> (..., steps)."""
    floored = envelopes.detach().clamp_min(_LOWEST_ENVELOPE)
    low = torch.minimum(floored, floored.roll(-1, -1))
    high = torch.maximum(floored, floored.roll(-1, -1))
    return low < 0.3 * torch.maximum(high.roll(1, -1), high.roll(-1, -1))


def expand(channels: Tensor, envelopes: Tensor, ratios: Tensor) -> Tensor:
    """Apply the recruitment gain at 44.1 kHz and sum the channels.

    Shape: (..., channels, time), (..., channels, time // 24), (..., channels) -> (..., time).
    """
    kernel = constant_like(channels, interpolation_kernel)
    return weigh(channels, around(gains(envelopes, ratios)), kernel, (envelopes, ratios))


@lru_cache(maxsize=16)
def interpolation_kernel(
    samples: int = STEP, parts: int = 1, together: int = 8
) -> NDArray[np.float64]:
    """Weights of the values about some steps for the samples of these: six count for each, after Lagrange.

    Args:
        samples: in each step.
        parts: of a sample, one after the other, that weigh alike.
        together: steps that a matrix product interpolates at once; best a divisor of their number.

    Returns: (together + 5, together * samples * parts).
    """
    nodes = np.arange(_TAPS) - (_TAPS // 2 - 1.0)
    place = np.arange(samples) / samples
    weights = np.ones((_TAPS, len(place)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            weights[i] *= (place - other) / (node - other)
    kernel = np.zeros((_TAPS + together - 1, together, len(place)))
    for i in range(together):
        kernel[i : i + _TAPS, i] = weights
    return kernel.reshape(len(kernel), -1).repeat(parts, -1)
