"""Limiter of the output of a compensator."""

from torch import Tensor

EXPONENT = 8.0

HIGHEST_RATIO = 1e4
"""Ratio of a sample to the peak from which on samples count alike.

Its eighth power fits into float32.
"""


def soft_limit(waveform: Tensor, peak: float) -> Tensor:
    """Limit the magnitude of samples smoothly: x / (1 + |x / peak|^8)^(1/8).

    The curve is smooth, and nearly linear below half of the peak, where it attenuates by 0.004 dB
    at most.

    Shape: any -> the same, between -peak and peak.

    >>> import torch
    >>> soft_limit(torch.tensor([0.1, 2.0, 100.0]), peak=2.0)
    tensor([0.1000, 1.8340, 2.0000])
    """
    bounded = waveform.clamp(-HIGHEST_RATIO * peak, HIGHEST_RATIO * peak)
    return bounded * (1.0 + (bounded / peak).abs() ** EXPONENT) ** (-1.0 / EXPONENT)
