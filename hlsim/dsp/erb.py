"""The scale of equivalent rectangular bandwidths (ERB) of auditory filters.

Source: Glasberg and Moore (1990), Hearing Research 47, 103-138.
"""

import numpy as np
from numpy.typing import NDArray

ERB_AT_0_HZ = 24.7
"""Equivalent rectangular bandwidth in Hz at 0 Hz."""


def erb(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Equivalent rectangular bandwidth in Hz of a normal ear at each frequency in Hz.

    Source: Glasberg and Moore (1990), Equation 3.

    >>> print(erb(np.array([1000.0])))
    [132.639]
    """
    return ERB_AT_0_HZ * (4.37e-3 * frequency + 1.0)


def erb_number(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Number of ERBs between 0 Hz and each frequency in Hz.

    Source: Glasberg and Moore (1990), Equation 4.

    >>> print(erb_number(np.array([1000.0])).round(3))
    [15.621]
    """
    return 21.4 * np.log10(1.0 + 4.37e-3 * frequency)


def erb_frequency(number: NDArray[np.float64]) -> NDArray[np.float64]:
    """Frequency in Hz at each position on the ERB scale. This is the inverse of ``erb_number``.

    >>> print(erb_frequency(erb_number(np.array([250.0, 4000.0]))).round())
    [ 250. 4000.]
    """
    return (10.0 ** (number / 21.4) - 1.0) / 4.37e-3
