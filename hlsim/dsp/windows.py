"""Windows of FIR filters with exactly the values of scipy's.

Importing ``scipy.signal``, where scipy defines its windows, takes half a second. ``scipy.special``
takes a fifth of that.
"""

import numpy as np
import scipy
from numpy.typing import NDArray


def hamming(taps: int) -> NDArray[np.float64]:
    """Compute a symmetric Hamming window, (taps,).

    Args:
        taps: Number of values.

    >>> print(hamming(3).round(2))
    [0.08 1.   0.08]
    """
    window: NDArray[np.float64] = 0.54 + (1.0 - 0.54) * np.cos(np.linspace(-np.pi, np.pi, taps))
    return window


def kaiser(taps: int, beta: float) -> NDArray[np.float64]:
    """Compute a symmetric Kaiser window, (taps,).

    Args:
        taps: Number of values, at least 2.
        beta: Shape parameter, larger for a wider main lobe and lower side lobes.

    >>> print(kaiser(3, beta=8.0).round(4))
    [0.0023 1.     0.0023]
    """
    middle = (taps - 1) / 2.0
    distance = (np.arange(taps) - middle) / middle
    peak = scipy.special.i0(beta)
    window: NDArray[np.float64] = scipy.special.i0(beta * np.sqrt(1.0 - distance**2.0)) / peak
    return window
