"""Recursive filters: design from analogue prototypes, coefficients and frequency responses.

The designs are those of ``scipy.signal``, whose import takes as long as a whole short command.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


class ZerosPoles(NamedTuple):
    """A filter as the zeros and poles of its transfer function, and a factor, ``gain``.

    An analogue prototype is a low-pass with the cut-off frequency 1 radian per second.

    >>> ELLIPTIC.poles.shape
    (2,)
    """

    zeros: ComplexArray
    poles: ComplexArray
    gain: float


ELLIPTIC = ZerosPoles(
    np.array([10.769854436276223j, -10.769854436276223j]),
    np.array(
        [-0.8899906387998329 - 1.1535893623216336j, -0.8899906387998329 + 1.1535893623216336j]
    ),
    0.017782794100389257,
)
"""Prototype of an elliptic low-pass of second order: 0.25 dB of ripple, then at least 35 dB less.

It is ``scipy.signal.ellipap(2, 0.25, 35.0)``.
"""


def butterworth(order: int) -> ZerosPoles:
    """Return the prototype of a Butterworth low-pass, which is 3 dB down at its cut-off frequency.

    >>> butterworth(1).poles.real.tolist()
    [-1.0]
    """
    angles = np.pi * np.arange(1 - order, order, 2) / (2 * order)
    return ZerosPoles(np.zeros(0, np.complex128), -np.exp(1j * angles), 1.0)


def chebyshev2(order: int, attenuation_db: float) -> ZerosPoles:
    """Return the prototype of a Chebyshev low-pass of type 2, with ripple above its cut-off.

    Args:
        order: Order of the filter.
        attenuation_db: Attenuation from the cut-off frequency on in dB.

    >>> chebyshev2(7, 30.0).zeros.shape
    (6,)
    """
    odd = np.arange(1 - order, order, 2)
    zeros = 1j / np.sin(np.pi * odd[odd != 0] / (2 * order))
    mu = math.asinh(math.sqrt(10.0 ** (0.1 * attenuation_db) - 1.0)) / order
    circle = -np.exp(1j * np.pi * odd / (2 * order))
    poles = 1.0 / (math.sinh(mu) * circle.real + 1j * math.cosh(mu) * circle.imag)
    return ZerosPoles(zeros, poles, float(np.real(np.prod(-poles) / np.prod(-zeros))))


def digital_filter(
    prototype: ZerosPoles, cutoff: float, sample_rate: float, highpass: bool = False
) -> ZerosPoles:
    """Convert an analogue prototype to a digital filter by the bilinear transform.

    Args:
        prototype: Prototype of the low-pass.
        cutoff: Cut-off frequency of the digital filter in Hz.
        sample_rate: Sample rate in Hz.
        highpass: Whether the digital filter is a high-pass.

    Returns:
        Zeros, poles and factor in the variable z.

    >>> digital_filter(butterworth(1), cutoff=4000.0, sample_rate=16000.0).zeros.real.tolist()
    [-1.0]
    """
    zeros, poles, gain = prototype
    missing = len(poles) - len(zeros)  # zeros at infinity
    warped = 4.0 * float(np.tan(np.pi * (cutoff / sample_rate)))
    if highpass:
        gain *= float(np.real(np.prod(-zeros) / np.prod(-poles)))
        zeros = np.append(warped / zeros, np.zeros(missing))
        poles = warped / poles
        missing = 0
    else:
        zeros, poles, gain = zeros * warped, poles * warped, gain * warped**missing
    gain *= float(np.real(np.prod(4.0 - zeros) / np.prod(4.0 - poles)))
    finite_zeros = (4.0 + zeros) / (4.0 - zeros)
    digital_zeros = np.concatenate((finite_zeros, np.full(missing, -1.0 + 0.0j)))
    return ZerosPoles(digital_zeros, (4.0 + poles) / (4.0 - poles), gain)


def coefficients(filter_: ZerosPoles) -> tuple[Array, Array]:
    """Compute numerator and denominator of a digital filter, (order + 1,) each.

    >>> numerator, denominator = coefficients(digital_filter(butterworth(1), 4000.0, 16000.0))
    >>> numerator.round(3).tolist()
    [0.5, 0.5]
    """
    numerator = filter_.gain * np.poly(filter_.zeros)
    return np.real(numerator), np.real(np.poly(filter_.poles))


def frequency_response(filter_: ZerosPoles, omega: Array) -> ComplexArray:
    """Compute the complex response of a digital filter at frequencies in radians per sample.

    Shape: (n,) -> complex (n,).

    >>> lowpass = digital_filter(butterworth(1), 4000.0, 16000.0)
    >>> abs(frequency_response(lowpass, np.array([0.0]))).round(3).tolist()
    [1.0]
    """
    points = np.exp(1j * omega)[:, None]
    factors = np.prod(points - filter_.zeros, 1) / np.prod(points - filter_.poles, 1)
    return np.asarray(filter_.gain * factors)
