"""Limiter of the output of a compensator, which protects the ear."""

from torch import Tensor

EXPONENT = 8.0
"""Exponent of the curve. The higher it is, the closer the curve is to clipping."""

HIGHEST_RATIO = 1e4
"""Ratio of a sample to the peak above which samples are treated alike.

Its eighth power fits into float32.
"""


def soft_limit(waveform: Tensor, peak: float) -> Tensor:
    """Limit the magnitude of samples without the edges of clipping: x / (1 + |x / peak|^8)^(1/8).

    Below half of the peak, samples are attenuated by 0.004 dB at most.

    Args:
        waveform: Samples. Any shape.
        peak: Magnitude that no sample of the result exceeds, in the unit of the samples.

    >>> import torch
    >>> soft_limit(torch.tensor([0.1, 2.0, 100.0]), peak=2.0)
    tensor([0.1000, 1.8340, 2.0000])
    """
    bounded = waveform.clamp(-HIGHEST_RATIO * peak, HIGHEST_RATIO * peak)
    return bounded * (1.0 + (bounded / peak).abs() ** EXPONENT) ** (-1.0 / EXPONENT)
