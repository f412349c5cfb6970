"""Windows of FIR filters, with scipy's values.

scipy's own are in ``scipy.signal``, whose import takes half a second; ``scipy.special`` takes a fifth of that.
"""

import numpy as np
import scipy
from numpy.typing import NDArray


def hamming(taps: int) -> NDArray[np.float64]:
    """Symmetric Hamming window. Returns (taps,)."""
    window: NDArray[np.float64] = 0.54 + (1.0 - 0.54) * np.cos(np.linspace(-np.pi, np.pi, taps))
    return window


def kaiser(taps: int, beta: float) -> NDArray[np.float64]:
    """Symmetric Kaiser window. Returns (taps,)."""
    middle = (taps - 1) / 2.0
    distance = (np.arange(taps) - middle) / middle
    window: NDArray[np.float64] = scipy.special.i0(
        beta * np.sqrt(1.0 - distance**2.0)
    ) / scipy.special.i0(beta)
    return window
