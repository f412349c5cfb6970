"""The ERB scale of Glasberg and Moore (1990)."""

import numpy as np
from numpy.typing import NDArray


def erb(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Equivalent rectangular bandwidth in Hz of the normal ear at a frequency in Hz (Glasberg and Moore 1990, Eq. 3)."""
    return 24.7 * (4.37e-3 * frequency + 1.0)
