"""Gradients of a loss through the exact MSBG, with which those through a network are compared."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.losses.band_levels import band_level_loss
from hlsim.losses.coherent_bands import DEFAULT_WEIGHTS, coherent_band_parts, limit_gradient_spikes
from hlsim.losses.criteria import weighted_sum
from hlsim.neuro.config import NEURO_RATE

_SMALLEST = 1e-30
"""Magnitude from which a gradient is not 0."""


class ExactGradients:
    """Gradients of two criteria of ``HearingLossLoss`` through the exact MSBG.

    The first half of the items has the criterion ``coherent-bands``, the others ``bands``.

    >>> signal = 0.02 * torch.randn(2, 8000)
    >>> _, _, gradient = ExactGradients()(signal, signal, torch.full((2, 8), 40.0))
    >>> gradient.shape
    torch.Size([2, 8000])
    """

    def __init__(self) -> None:
        self._loss = HearingLossLoss(simulator="msbg")

    @torch.enable_grad()
    def __call__(self, signal: Tensor, clean: Tensor, ears: Tensor) -> tuple[Tensor, ...]:
        """Compute what the ears perceive, and two gradients of the loss.

        Shape: (items, time), (items, time), (items, 8) -> three times (items, time).

        Args:
            signal: Outputs of an aid in pascals.
            clean: Clean speech in pascals.
            ears: Thresholds in dB HL.

        Returns:
            What the ears perceive; the gradient with respect to it; and the gradient with respect
            to ``signal``, with limited spikes.
        """
        signal = signal.detach().requires_grad_()
        perceived, reference = self._loss.heard(signal, clean, ears)
        leaf = perceived.detach().requires_grad_()
        half = len(signal) // 2
        parts = coherent_band_parts(leaf[:half], reference[:half], NEURO_RATE)
        values = weighted_sum(parts, {name: DEFAULT_WEIGHTS[name] for name in parts}).sum()
        values = values + band_level_loss(leaf[half:], reference[half:], NEURO_RATE).sum()
        (cotangent,) = torch.autograd.grad(values, leaf)
        # Its scale does not matter, and gradients of speech that is hardly perceived are extreme.
        cotangent = functional.normalize(cotangent, dim=-1, eps=_SMALLEST)
        (gradient,) = torch.autograd.grad(perceived, signal, cotangent)
        return perceived.detach(), cotangent, limit_spikes(gradient, signal)


def limit_spikes(gradient: Tensor, signal: Tensor) -> Tensor:
    """Limit the spikes of gradients as ``HearingLossLoss`` does.

    The factors of the limitation count as constants.

    Shape: (items, time), (items, time) -> (items, time).
    """
    with torch.enable_grad():
        leaf = signal.detach().requires_grad_()
        fixed = gradient.detach()
        limited = limit_gradient_spikes(leaf, NEURO_RATE)
        (limited,) = torch.autograd.grad(limited, leaf, fixed)
    factor = torch.where(fixed.abs() > _SMALLEST, limited / fixed, 1.0)
    return gradient * factor


def gradient_error(
    perceived: Tensor, signal: Tensor, cotangent: Tensor, expected: Tensor
) -> Tensor:
    """Compute 1 minus the cosine of a network's gradient with that of the exact MSBG.

    Shape: four times (items, time) -> (items,).

    Args:
        perceived: Output of the network for ``signal``.
        signal: Input, which requires a gradient.
        cotangent: Gradient with respect to the output of the exact MSBG.
        expected: Gradient of the exact MSBG from ``ExactGradients``.
    """
    (gradient,) = torch.autograd.grad(perceived, signal, cotangent, create_graph=True)
    gradient = limit_spikes(gradient, signal)
    scale = gradient.detach().square().mean(-1, keepdim=True).sqrt().clamp_min(_SMALLEST)
    return 1.0 - functional.cosine_similarity(gradient / scale, expected, dim=-1, eps=_SMALLEST)
