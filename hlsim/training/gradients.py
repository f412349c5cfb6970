"""Comparison of the gradients through a network with those through its teacher.

A simulator serves to train aids, so its gradient matters as much as its output. Networks with
nearly the same output may have different gradients, above all where the output is soft.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.calibration import NEURO_RATE
from hlsim.losses.coherent_bands import DEFAULT_WEIGHTS, coherent_band_parts
from hlsim.losses.gradient_limit import limit_gradient_spikes
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.metrics.band_levels import band_level_loss


def gradient_error(
    perceived: Tensor, signal: Tensor, clean: Tensor, ears: Tensor, teacher: nn.Module
) -> Tensor:
    """Compute 1 minus the cosine of the gradients of a loss through a network and its teacher.

    The gradient of the loss with respect to what the ear perceives is computed once, at the
    teacher's output, and passed back through both simulators to their input. So only the simulators
    differ. The criterion is ``coherent-bands`` for the first half of the items, and ``bands`` for
    the others. Spikes are limited as ``HearingLossLoss`` does.

    Shape: (items, time) three times, (items, 8) -> (items,).

    Args:
        perceived: Output of the network for ``signal``.
        signal: Input of the network in pascals, which requires a gradient.
        clean: Clean speech in pascals.
        ears: Thresholds in dB HL.
        teacher: Simulator at 16 kHz.

    Returns:
        Errors, 0 for equal directions to 2 for opposite ones, with a gradient for the network.

    Raises:
        ValueError: The teacher is not differentiable.

    >>> from hlsim import MSBG
    >>> clean, ears = 0.02 * torch.randn(2, 8000), torch.full((2, 8), 40.0)
    >>> signal = clean.clone().requires_grad_()
    >>> gradient_error(2.0 * MSBG()(signal, ears), signal, clean, ears, MSBG()).shape
    torch.Size([2])
    """
    taught, reference = HearingLossLoss(simulator=teacher).heard(signal, clean, ears)
    if not taught.requires_grad:
        raise ValueError(
            "expected a differentiable teacher, with whose gradients those of the network can be "
            "compared; set the weight of the criterion gradient to 0 in the recipe"
        )
    output = taught.detach().requires_grad_()
    half = len(signal) // 2
    parts = coherent_band_parts(output[:half], reference[:half].detach(), NEURO_RATE)
    errors = band_level_loss(output[half:], reference[half:].detach(), NEURO_RATE)
    total = sum((DEFAULT_WEIGHTS[name] * part.sum() for name, part in parts.items()), errors.sum())
    (direction,) = torch.autograd.grad(total, output)
    # For speech that is hardly perceived, the gradient would exceed single precision.
    direction = _unit_peak(direction)
    (expected,) = torch.autograd.grad(taught, signal, direction)
    (gradient,) = torch.autograd.grad(perceived, signal, direction, create_graph=True)
    limited, expected = (
        _unit_peak(_limit_spikes(values, signal)) for values in (gradient, expected)
    )
    return 1.0 - functional.cosine_similarity(limited, expected, dim=-1)


def _unit_peak(gradient: Tensor) -> Tensor:
    """Scale the largest magnitude of each item to 1, by a factor without a gradient.

    Shape: (items, time) -> (items, time).
    """
    peak = gradient.detach().abs().amax(-1, keepdim=True)
    return gradient / torch.where(peak > 0.0, peak, 1.0)


def _limit_spikes(gradient: Tensor, signal: Tensor) -> Tensor:
    """Limit the spikes of gradients as ``HearingLossLoss`` does, by factors without a gradient.

    Args:
        gradient: Gradients with respect to ``signal``.
        signal: Signals, whose pauses have a lower limit.

    Shape: (items, time), (items, time) -> (items, time).
    """
    values = gradient.detach()
    leaf = signal.detach().requires_grad_()
    limited = limit_gradient_spikes(leaf, NEURO_RATE)
    (limited_values,) = torch.autograd.grad(limited, leaf, values)
    return gradient * (limited_values / values).nan_to_num(1.0)  # 0 / 0 is NaN
