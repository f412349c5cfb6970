"""Filters are those of scipy.signal, which hot paths do not import."""

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

from hlsim.dsp.fir import windowed_sinc_fir
from hlsim.dsp.iir import butterworth, inverse_chebyshev, second_order_elliptic


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_butterworth_filters_are_those_of_scipy(order):
    expected = scipy.signal.butter(order, 800.0, fs=24000)
    for coefficients, theirs in zip(butterworth(order, 800.0, 24000), expected, strict=True):
        assert_allclose(coefficients, theirs, rtol=1e-9)


@pytest.mark.parametrize("order", [2, 3, 7])
@pytest.mark.parametrize("sample_rate", [25000, 44100, 48000])
def test_inverse_chebyshev_filters_are_those_of_scipy(order, sample_rate):
    expected = scipy.signal.cheby2(order, 30.0, 10500.0, fs=sample_rate)
    ours = inverse_chebyshev(order, 30.0, 10500.0, sample_rate)
    for coefficients, theirs in zip(ours, expected, strict=True):
        assert_allclose(coefficients, theirs, rtol=1e-9)


@pytest.mark.parametrize("ripple", [0.25, 3.0])
@pytest.mark.parametrize("cutoff", [20.0, 75.0, 9000.0])
def test_elliptic_filters_are_those_of_scipy(ripple, cutoff):
    expected = scipy.signal.ellip(2, ripple, 35.0, cutoff, fs=44100)
    ours = second_order_elliptic(ripple, 35.0, cutoff, 44100)
    for coefficients, theirs in zip(ours, expected, strict=True):
        assert_allclose(coefficients, theirs, rtol=1e-9)


@pytest.mark.parametrize("edges", [(0.0, 0.3), (0.2, 0.5), (0.4, 1.0)])
def test_fir_filters_by_a_window_are_those_of_scipy(edges):
    inner = [edge for edge in edges if 0.0 < edge < 1.0]
    expected = scipy.signal.firwin(65, inner, window=("kaiser", 5.0), pass_zero=edges[0] == 0.0)
    assert_allclose(windowed_sinc_fir(*edges, np.kaiser(65, 5.0)), expected, atol=1e-14)
