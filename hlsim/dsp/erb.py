"""The scale of equivalent rectangular bandwidths (ERB) of Glasberg and Moore (1990), Hearing Research 47."""

import numpy as np
from numpy.typing import NDArray

ERB_AT_0_HZ = 24.7
"""Hz."""


def erb(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Equivalent rectangular bandwidth in Hz of the normal ear at a frequency in Hz (Equation 3)."""
    return ERB_AT_0_HZ * (4.37e-3 * frequency + 1.0)


def erb_number(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """How many ERBs lie below a frequency in Hz (Equation 4)."""
    return 21.4 * np.log10(1.0 + 4.37e-3 * frequency)


def erb_frequency(number: NDArray[np.float64]) -> NDArray[np.float64]:
    """The frequency in Hz below which so many ERBs lie: the inverse of ``erb_number``."""
    return (10.0 ** (number / 21.4) - 1.0) / 4.37e-3
