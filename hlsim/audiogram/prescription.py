"""Gains that the prescription NAL-R gives to an ear.

Source: Byrne and Dillon 1986, Ear and Hearing 7(4), and for severe losses Byrne, Parkinson and
Newall 1990, Ear and Hearing 11(1).
"""

import torch
from torch import Tensor

from hlsim.torchtools import constant


def nalr_gains_db(thresholds: Tensor) -> Tensor:
    """Compute the gains that NAL-R prescribes at the eight frequencies of an audiogram.

    The formula is for 250, 500, 1000, 2000, 4000 and 6000 Hz. As in pyclarity, the gain at 3 kHz is
    the mean of those at 2 and 4 kHz, and that at 8 kHz is the gain at 6 kHz, so that the thresholds
    at 3 and 8 kHz have no influence. An ear without any loss has no gain.

    Args:
        thresholds: Thresholds in dB HL at ``hlsim.audiogram.FREQUENCIES``.

    Shape: (..., 8) -> (..., 8) in dB, 0 or more.

    >>> nalr_gains_db(torch.tensor([20.0, 20.0, 25.0, 35.0, 40.0, 45.0, 50.0, 50.0])).round()
    tensor([ 0.,  2., 13., 14., 15., 16., 18., 18.])
    """
    losses = torch.cat((thresholds[..., :4], thresholds[..., 5:7]), -1)  # without 3 and 8 kHz
    three_frequency_sum = losses[..., 1:4].sum(-1, keepdim=True)  # 500, 1000 and 2000 Hz
    common = torch.where(
        three_frequency_sum <= 180.0,
        0.05 * three_frequency_sum,
        9.0 + 0.116 * (three_frequency_sum - 180.0),
    )
    bias = _bias(like=losses)
    gains = (common + 0.31 * losses + bias).clamp_min(0.0)
    low, high = gains[..., :4], gains[..., 4:]
    at_3_khz = 0.5 * (low[..., -1:] + high[..., :1])
    all_gains = torch.cat((low, at_3_khz, high, high[..., -1:]), -1)
    has_no_loss = (losses <= 0.0).all(-1, keepdim=True)
    return torch.where(has_no_loss, 0.0, all_gains)


@constant
def _bias() -> list[float]:
    """Return the constant in dB of the formula at 250, 500, 1000, 2000, 4000 and 6000 Hz."""
    return [-17.0, -8.0, 1.0, -1.0, -2.0, -2.0]
