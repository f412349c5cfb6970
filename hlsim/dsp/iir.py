"""Designs of recursive low-pass filters from the poles and zeros of analog ones.

They equal those of ``scipy.signal``, whose import takes longer than the hearing loss of 3 s.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Coefficients = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Numerator and denominator in ascending powers of the delay. The denominator begins with 1."""


def butterworth(order: int, cutoff: float, sample_rate: float) -> Coefficients:
    """Design a low-pass whose gain is as flat as possible in its passband.

    Args:
        order: Number of poles.
        cutoff: Frequency in Hz at which the gain is -3 dB.
        sample_rate: Sample rate in Hz.

    >>> print(butterworth(1, 4000.0, 16000.0)[0])
    [0.5 0.5]
    """
    return _bilinear([], _unit_circle_poles(order), cutoff, sample_rate)


def inverse_chebyshev(
    order: int, attenuation_db: float, edge: float, sample_rate: float
) -> Coefficients:
    """Design a low-pass with ripples in its stopband, Chebyshev's filter of the second type.

    Args:
        order: Number of poles.
        attenuation_db: Attenuation in the stopband, in dB.
        edge: Frequency in Hz at which the stopband begins.
        sample_rate: Sample rate in Hz.

    >>> numerator, denominator = inverse_chebyshev(7, 30.0, 7000.0, 16000.0)
    >>> round(float(numerator.sum() / denominator.sum()), 6)
    1.0
    """
    width = np.arcsinh(np.sqrt(10.0 ** (attenuation_db / 10.0) - 1.0)) / order
    on_circle = _unit_circle_poles(order)
    on_ellipse = np.sinh(width) * on_circle.real + 1j * np.cosh(width) * on_circle.imag
    heights = on_circle.imag[np.abs(on_circle.imag) > 1e-9]  # the middle one is at infinity
    return _bilinear(1j / heights, 1.0 / on_ellipse, edge, sample_rate)


def second_order_elliptic(
    ripple_db: float, attenuation_db: float, cutoff: float, sample_rate: float
) -> Coefficients:
    """Design a low-pass of second order with ripples in its passband and in its stopband.

    For a frequency w relative to the cut-off, its gain is 1 / sqrt(1 + e^2 R(w)^2), where R(w) is
    ((1 + t) w^2 - 1) / (1 - (1 - t) w^2), which is 1 at the cut-off. The zeros of the denominator
    are those of the filter, and its poles are where R(w) is i/e or -i/e.

    Args:
        ripple_db: Difference between the largest and the smallest gain of the passband, in dB.
        attenuation_db: Attenuation in the stopband, in dB.
        cutoff: Frequency in Hz at which the passband ends.
        sample_rate: Sample rate in Hz.

    >>> numerator, denominator = second_order_elliptic(0.25, 35.0, 75.0, 44100.0)
    >>> round(float(20.0 * np.log10(numerator.sum() / denominator.sum())), 6)
    -0.25
    """
    e = np.sqrt(10.0 ** (ripple_db / 10.0) - 1.0)
    # The smallest value of R in the stopband is (s + sqrt(s^2 - 1))^2, where s is its edge.
    root = ((10.0 ** (attenuation_db / 10.0) - 1.0) / e**2) ** 0.25
    stopband_edge = (root + 1.0 / root) / 2.0
    t = np.sqrt(1.0 - 1.0 / stopband_edge**2)
    zero = 1j / np.sqrt(1.0 - t)
    pole = -np.sqrt(-(1.0 + 1j * e) / (1.0 - t + 1j * e * (1.0 + t)))
    numerator, denominator = _bilinear([zero, -zero], [pole, pole.conj()], cutoff, sample_rate)
    return numerator / np.sqrt(1.0 + e**2), denominator


def _unit_circle_poles(order: int) -> NDArray[np.complex128]:
    """Return points at equal distances on the left half of the unit circle."""
    return np.exp(0.5j * np.pi * (2.0 * np.arange(order) + order + 1.0) / order)


def _bilinear(zeros: Any, poles: Any, cutoff: float, sample_rate: float) -> Coefficients:
    """Convert an analog low-pass to a digital one by the bilinear transform.

    Args:
        zeros, poles: Finite zeros and poles of the analog filter, whose cut-off frequency is 1.
        cutoff: Frequency in Hz that corresponds to it.
        sample_rate: Sample rate in Hz.

    Returns:
        Coefficients of the filter, whose gain at 0 Hz is 1.
    """
    warped = np.tan(np.pi * cutoff / sample_rate)
    poles, zeros = (
        (1.0 + warped * np.asarray(roots)) / (1.0 - warped * np.asarray(roots))
        for roots in (poles, zeros)
    )
    zeros = np.append(zeros, np.full(len(poles) - len(zeros), -1.0))  # those at infinity
    gain = np.prod(1.0 - poles) / np.prod(1.0 - zeros)
    numerator: NDArray[np.float64] = (gain * np.poly(zeros)).real
    denominator = np.poly(poles).real.astype(np.float64)
    return numerator, denominator
