"""The designs of filters are those of scipy.signal."""

import numpy as np
import pytest
from scipy import signal

from hlsim.dsp.fir import bandpass_fir, lowpass_fir
from hlsim.dsp.iir import (
    ELLIPTIC,
    ZerosPoles,
    butterworth,
    chebyshev2,
    coefficients,
    digital_filter,
    frequency_response,
)

RATE = 24000.0


@pytest.mark.parametrize(
    ("prototype", "cutoff", "highpass", "expected"),
    [
        (butterworth(1), 5000.0, False, signal.butter(1, 5000.0, fs=RATE)),
        (butterworth(2), 350.0, True, signal.butter(2, 350.0, "high", fs=RATE)),
        (chebyshev2(7, 30.0), 10500.0, False, signal.cheby2(7, 30.0, 10500.0, fs=RATE)),
        (chebyshev2(4, 30.0), 900.0, True, signal.cheby2(4, 30.0, 900.0, "high", fs=RATE)),
        (ELLIPTIC, 75.0, False, signal.ellip(2, 0.25, 35.0, 75.0, fs=RATE)),
    ],
)
def test_recursive_filters_are_those_of_scipy(
    prototype: ZerosPoles,
    cutoff: float,
    highpass: bool,
    expected: tuple[np.ndarray, np.ndarray],
) -> None:
    design = digital_filter(prototype, cutoff, RATE, highpass=highpass)
    for ours, theirs in zip(coefficients(design), expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-14)
    omega = np.linspace(0.0, np.pi, 50)
    response = signal.freqz(*expected, omega)[1]
    np.testing.assert_allclose(frequency_response(design, omega), response, atol=1e-9)


@pytest.mark.parametrize(("taps", "cutoff", "beta"), [(133, 0.8, 8.0), (20, 0.1, 26.6)])
def test_the_low_pass_is_firwin(taps: int, cutoff: float, beta: float) -> None:
    expected = signal.firwin(taps, cutoff, window=("kaiser", beta))
    np.testing.assert_allclose(lowpass_fir(taps, cutoff, beta), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("low", "high"), [(0.16, 0.256), (0.64, 1.0)])
def test_the_band_pass_is_firwin(low: float, high: float) -> None:
    edges = (low, high) if high < 1.0 else (low,)
    expected = signal.firwin(129, edges, window="hann", pass_zero=False)
    np.testing.assert_allclose(bandpass_fir(129, low, high), expected, rtol=1e-12, atol=1e-15)
