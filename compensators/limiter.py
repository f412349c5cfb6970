"""Limiter of the output of a compensator, which protects the ear."""

from torch import Tensor

from hlsim.calibration import PASCAL_SPL

EXPONENT = 8.0
"""Exponent of the curve. The higher it is, the closer the curve is to clipping."""

HIGHEST_RATIO = 1e4
"""Ratio of a sample to the limit from which all samples have the same output.

Its eighth power fits into float32.
"""


def soft_limit(waveform: Tensor, limit_spl: float) -> Tensor:
    """Limit the magnitude of samples by a smooth curve: x / (1 + |x / limit|^8)^(1/8).

    Up to half of the limit, samples are attenuated by less than 0.005 dB.

    Args:
        waveform: Samples in pascals. Any shape.
        limit_spl: Limit of the magnitude of each sample of the result, in dB relative to 20
            micropascals.

    >>> import torch
    >>> soft_limit(torch.tensor([0.1, 2.0, 100.0]), limit_spl=100.0)  # 2 pascals
    tensor([0.1000, 1.8318, 1.9953])
    """
    peak = 10.0 ** ((limit_spl - PASCAL_SPL) / 20.0)
    bounded = waveform.clamp(-HIGHEST_RATIO * peak, HIGHEST_RATIO * peak)
    return bounded * (1.0 + (bounded / peak).abs() ** EXPONENT) ** (-1.0 / EXPONENT)
