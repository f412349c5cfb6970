"""Comparison of the gradients through a network with those through the exact MSBG.

A simulator serves to train aids, so its gradient matters as much as its output. Networks with
nearly the same output may have different gradients, above all where the output is soft.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.losses.band_levels import band_level_loss
from hlsim.losses.coherent_bands import DEFAULT_WEIGHTS, coherent_band_parts, limit_gradient_spikes
from hlsim.losses.criteria import weighted_sum
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.neuro.config import NEURO_RATE

_SMALLEST_GRADIENT = 1e-30
"""Magnitude below which a gradient counts as 0."""


class ExactGradients(NamedTuple):
    """Gradients of a loss through the exact MSBG.

    Shape: (items, time) each.

    Attributes:
        output: Gradient with respect to what the ears perceive, up to a factor for each item.
        input: Gradient with respect to the input of the simulator, with limited spikes.
    """

    output: Tensor
    input: Tensor


@torch.enable_grad()
def exact_gradients(signal: Tensor, clean: Tensor, ears: Tensor) -> ExactGradients:
    """Compute gradients of two criteria of ``HearingLossLoss`` through the exact MSBG.

    The first half of the items has the criterion ``coherent-bands``, the others ``bands``.

    Shape: (items, time), (items, time), (items, 8).

    Args:
        signal: Inputs of the simulator in pascals.
        clean: Clean speech in pascals.
        ears: Thresholds in dB HL.

    >>> signal = 0.02 * torch.randn(2, 8000)
    >>> exact_gradients(signal, signal, torch.full((2, 8), 40.0)).input.shape
    torch.Size([2, 8000])
    """
    signal = signal.detach().requires_grad_()
    perceived, reference = HearingLossLoss(simulator="msbg").heard(signal, clean, ears)
    output = perceived.detach().requires_grad_()
    half = len(signal) // 2
    parts = coherent_band_parts(output[:half], reference[:half], NEURO_RATE)
    weights = {name: DEFAULT_WEIGHTS[name] for name in parts}
    errors = band_level_loss(output[half:], reference[half:], NEURO_RATE)
    total = weighted_sum(parts, weights).sum() + errors.sum()
    (output_gradient,) = torch.autograd.grad(total, output)
    # For speech that is hardly perceived, the gradient would exceed single precision.
    output_gradient = functional.normalize(output_gradient, dim=-1, eps=_SMALLEST_GRADIENT)
    (input_gradient,) = torch.autograd.grad(perceived, signal, output_gradient)
    return ExactGradients(output_gradient, _limit_spikes(input_gradient, signal))


def gradient_error(perceived: Tensor, signal: Tensor, expected: ExactGradients) -> Tensor:
    """Compute 1 minus the cosine of a network's gradient with that through the exact MSBG.

    Shape: (items, time) twice -> (items,).

    Args:
        perceived: Output of the network for ``signal``.
        signal: Input of the network, which requires a gradient.
        expected: Gradients through the exact MSBG for the same input.
    """
    (gradient,) = torch.autograd.grad(perceived, signal, expected.output, create_graph=True)
    limited = _limit_spikes(gradient, signal)
    size = limited.detach().square().mean(-1, keepdim=True).sqrt().clamp_min(_SMALLEST_GRADIENT)
    unit = limited / size
    return 1.0 - functional.cosine_similarity(unit, expected.input, dim=-1, eps=_SMALLEST_GRADIENT)


def _limit_spikes(gradient: Tensor, signal: Tensor) -> Tensor:
    """Limit the spikes of gradients as ``HearingLossLoss`` does, by factors without a gradient.

    Shape: (items, time) twice -> (items, time).
    """
    values = gradient.detach()
    with torch.enable_grad():
        leaf = signal.detach().requires_grad_()
        limited = limit_gradient_spikes(leaf, NEURO_RATE)
    (limited_values,) = torch.autograd.grad(limited, leaf, values)
    is_zero = values.abs() < _SMALLEST_GRADIENT
    factors = torch.where(is_zero, 1.0, limited_values / values)
    return gradient * factors
