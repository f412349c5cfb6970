"""Linear interpolation of levels or gains from some frequencies to others."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hlsim.torchtools import constant

Positions = tuple[float, ...] | NDArray[np.float64]


def interpolate(values: Tensor, grid: tuple[float, ...], points: tuple[float, ...]) -> Tensor:
    """Interpolate values linearly. Beyond the ends of the grid the result is constant.

    Args:
        values: Values on the grid, such as levels in dB.
        grid: Ascending positions of the values, such as frequencies in Hz.
        points: Positions of the result.

    Shape: (..., grid) -> (..., points).

    >>> import torch
    >>> interpolate(torch.tensor([0.0, 1.0]), (250.0, 500.0), (375.0, 900.0))
    tensor([0.5000, 1.0000])
    """
    # A GPU may round matrix products to ten bits, so this is a sum of products.
    weights = interpolation_weights(grid, points, like=values)
    return (values.unsqueeze(-1) * weights).sum(-2)


@constant
def interpolation_weights(grid: Positions, points: Positions) -> NDArray[np.float64]:
    """Compute the matrix that interpolates values linearly, and continues them as constants.

    Args:
        grid: Ascending positions of the values.
        points: Positions of the result.

    Returns:
        Weights, (grid, points). Values on the grid, (..., grid), times this matrix are the values
        at the points, (..., points).

    >>> interpolation_weights((250.0, 500.0), (375.0, 900.0)).T
    array([[0.5, 0.5],
           [0. , 1. ]])
    """
    return np.stack([np.interp(points, grid, row) for row in np.eye(len(grid))])
