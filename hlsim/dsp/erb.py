"""The scale of equivalent rectangular bandwidths (ERB) of auditory filters.

The ERB at a frequency is a measure of how finely a normal ear resolves frequencies there. On the
ERB-number scale, equal distances are equal numbers of ERBs.

Source: Glasberg and Moore (1990), Hearing Research 47, 103-138.
"""

import numpy as np
from numpy.typing import NDArray

ERB_AT_0_HZ = 24.7
"""Equivalent rectangular bandwidth in Hz at 0 Hz."""


def erb(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the equivalent rectangular bandwidth in Hz of a normal auditory filter.

    Source: Glasberg and Moore (1990), Equation 3.

    Args:
        frequency: Centre frequencies in Hz, of any shape.

    >>> print(erb(np.array([1000.0])))
    [132.639]
    """
    return ERB_AT_0_HZ * (4.37e-3 * frequency + 1.0)


def erb_number(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the positions of frequencies on the ERB scale: the number of ERBs from 0 Hz.

    Source: Glasberg and Moore (1990), Equation 4.

    Args:
        frequency: Frequencies in Hz, of any shape.

    >>> print(erb_number(np.array([1000.0])).round(3))
    [15.621]
    """
    return 21.4 * np.log10(1.0 + 4.37e-3 * frequency)


def erb_frequency(number: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the frequencies in Hz at positions on the ERB scale, the inverse of ``erb_number``.

    Args:
        number: Numbers of ERBs from 0 Hz, of any shape.

    >>> print(erb_frequency(erb_number(np.array([250.0, 4000.0]))).round())
    [ 250. 4000.]
    """
    return (10.0 ** (number / 21.4) - 1.0) / 4.37e-3
