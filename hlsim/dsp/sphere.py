"""Sound at a rigid sphere, the simplest model of a head, in closed form.

Directions are azimuths and elevations in degrees. An azimuth of 0 is in front, 90 on the left, and
180 behind; an elevation of 90 is above.
"""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

SPEED_OF_SOUND = 343.0
"""Speed of sound in m/s, at 20 degrees Celsius."""

HEAD_RADIUS = 0.0875
"""Radius of an average head in m."""

SPACINGS = (0.002, 0.1)
"""Smallest and largest distance between the two microphones of a side in m."""

_ORDERS_ABOVE = 20
"""Number of terms of the series after the order at which the terms begin to fall."""


def unit_vectors(azimuths: ArrayLike) -> NDArray[np.float64]:
    """Return the unit vectors (front, left, up) of directions in the horizontal plane.

    Args:
        azimuths: Azimuths in degrees, (...).

    Returns:
        Unit vectors, (..., 3).

    >>> unit_vectors([0.0, 90.0]).round(6)
    array([[1., 0., 0.],
           [0., 1., 0.]])
    """
    azimuth = np.radians(azimuths)
    return np.stack((np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)), -1)


def evenly_spread_directions(count: int) -> NDArray[np.float64]:
    """Return unit vectors that lie evenly on the sphere, on a spiral (a Fibonacci lattice).

    Args:
        count: Number of directions.

    Returns:
        Unit vectors (front, left, up), (count, 3).

    >>> evenly_spread_directions(1000).mean(0).round(2) + 0.0
    array([0., 0., 0.])
    """
    number = np.arange(count)
    height = 1.0 - (2.0 * number + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * number
    width = np.sqrt(1.0 - height**2)
    return np.stack((width * np.cos(turn), width * np.sin(turn), height), -1)


def sphere_response(cosines: ArrayLike, frequencies: ArrayLike) -> NDArray[np.complex128]:
    """Compute the sound pressure of plane waves on a rigid head, relative to the free field.

    The head is a sphere of the radius ``HEAD_RADIUS``, 8.75 cm; the free field is the pressure at
    its centre without it. This is the limit of Equation 2 of Duda and Martens 1998, Journal of the
    Acoustical Society of America 104(5), for distant sources. A positive phase is an advance, as in
    ``numpy.fft``.

    Args:
        cosines: Cosine of the angle between the direction of the source and that of the point on
            the sphere, (...).
        frequencies: Frequencies in Hz, (n,), 0 or more.

    Returns:
        Complex responses, (..., n). They contain the advance or delay with respect to the centre.

    >>> facing, behind = abs(sphere_response([1.0, -1.0], [0.0, 8000.0]))
    >>> facing.round(2)  # a wall doubles the pressure of short waves
    array([1.  , 1.98])
    """
    hertz = np.asarray(frequencies, dtype=np.float64)
    # At 0 Hz, the functions are infinite, and the limit is 1, as at this frequency.
    wave_number = 2.0 * np.pi * np.maximum(hertz, 1e-3) * HEAD_RADIUS / SPEED_OF_SOUND
    orders = np.arange(int(wave_number.max(initial=0.0)) + _ORDERS_ABOVE)
    with np.errstate(over="ignore", invalid="ignore"):
        derivative = scipy.special.spherical_jn(
            orders[:, None], wave_number, derivative=True
        ) - 1j * scipy.special.spherical_yn(orders[:, None], wave_number, derivative=True)
        # Of high orders, the functions overflow, and the terms are 0.
        weights = np.nan_to_num(1.0 / (wave_number**2 * derivative))
    weights *= ((2.0 * orders + 1.0) * 1j ** (orders - 1.0))[:, None]
    cosine = np.asarray(cosines, dtype=np.float64)
    series = np.polynomial.legendre.legval(cosine, weights)
    return np.moveaxis(np.asarray(series, dtype=np.complex128), 0, -1)


def microphone_positions(spacing: float = 0.01) -> NDArray[np.float64]:
    """Return the positions of a front and a rear microphone at each side of a spherical head.

    They lie on the sphere in the horizontal plane, at the same distance in front of each ear and
    behind it.

    Args:
        spacing: Distance between the two microphones of a side along the sphere in m.

    Returns:
        Unit vectors (front, left, up), (microphones, ears, 3): front and rear, left and right.

    >>> microphone_positions()[0].round(3)
    array([[ 0.057,  0.998,  0.   ],
           [ 0.057, -0.998,  0.   ]])
    """
    offset = np.degrees(0.5 * spacing / HEAD_RADIUS)
    return unit_vectors([[90.0 - offset, offset - 90.0], [90.0 + offset, -90.0 - offset]])


def head_responses(
    directions: NDArray[np.float64], frequencies: ArrayLike, spacing: float = 0.01
) -> NDArray[np.complex128]:
    """Compute the responses of the microphones on a spherical head to plane waves.

    Args:
        directions: Unit vectors of the directions of the sources, (directions, 3).
        frequencies: Frequencies in Hz, (n,).
        spacing: Distance between the two microphones of a side in m, see ``microphone_positions``.

    Returns:
        Responses relative to the free field, (directions, microphones, ears, n).

    >>> head_responses(unit_vectors([0.0, 90.0]), [500.0]).shape
    (2, 2, 2, 1)
    """
    cosines = np.einsum("dx,mex->dme", directions, microphone_positions(spacing))
    return sphere_response(cosines, frequencies)
