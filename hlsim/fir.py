"""Linear-phase FIR design by frequency sampling."""

import numpy as np
from numpy.typing import NDArray

_GRID = 512


def frequency_sampling_fir(
    taps: int, frequencies: NDArray[np.float64], gains: NDArray[np.float64], window: NDArray[np.float64]
) -> NDArray[np.float64]:
    """FIR filter with given gains at given frequencies, as MATLAB's ``fir2`` designs it.

    The gains are put on a grid of 513 points with the break points moved to grid points, joined by straight lines,
    inverse transformed with a delay of (taps - 1) / 2 samples, and windowed. scipy's ``firwin2`` interpolates between
    the break points themselves, which differs by up to a few tenths of a dB where they are close; MSBG and pyclarity's
    NAL-R follow ``fir2``.

    Args:
        taps: odd number of coefficients, at most 1023.
        frequencies: ascending, 0 to 1 with 1 the Nyquist frequency.
        gains: linear gain at each frequency.
        window: (taps,).
    """
    points = _GRID + 1
    response = np.zeros(points)
    response[0] = gains[0]
    start = 0
    for i in range(len(frequencies) - 1):
        end = int(frequencies[i + 1] * points) - 1
        if end >= start:
            place = np.linspace(0.0, 1.0, end - start + 1) if end > start else np.zeros(1)
            response[start : end + 1] = place * gains[i + 1] + (1.0 - place) * gains[i]
        start = end + 1
    delay = np.exp(-0.5j * (taps - 1) * np.pi * np.arange(points) / _GRID)
    impulse = np.fft.irfft(response * delay, 2 * _GRID)
    return impulse[:taps] * window
