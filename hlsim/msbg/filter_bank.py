"""MSBG's gammatone filter banks, one for each severity of hearing loss, as frequency responses."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.torchtools import constant

_CORNER_STEP_HZ = MSBG_RATE / 8192.0
"""Unit of ``FilterBank.highpass_corners`` in Hz."""


@dataclass(frozen=True)
class FilterBank:
    """Parameters of a bank of gammatone filters, the band-pass filters of a model of the cochlea.

    Attributes:
        broadening: Bandwidth of the filters relative to that of a normal ear.
        centre_frequencies: Centre frequency of each channel in Hz, in ascending order.
        advances: Number of samples at 44.1 kHz by which each channel is advanced, so that the
            envelopes of all channels are aligned.
        highpass_corners: Corner frequencies of the high-passes of the upper channels, in units of
            44100 / 8192 Hz. The high-passes are Bessel filters of second order, which attenuate
            frequencies far below the centre frequency. The lower channels have none.
        recombination_db: Level of the sum of all channels relative to the input in dB.

    >>> BANKS["severe"].channels
    19
    """

    broadening: float
    centre_frequencies: tuple[float, ...]
    advances: tuple[float, ...]
    highpass_corners: tuple[float, ...]
    recombination_db: float

    @property
    def channels(self) -> int:
        """Number of band-pass filters."""
        return len(self.centre_frequencies)


def _parse_floats(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split()))


# The values are those of Stone and Moore's tables of 19 November 2013 in pyclarity 0.9.0
# (clarity/evaluator/msbg/msbg_hparams/GT4FBank_*.json). The filter coefficients there follow from
# these values.
_NARROW = FilterBank(
    broadening=1.5,
    centre_frequencies=_parse_floats(
        "72.58201774 97.8613053 129.44897664 168.20191403 214.95677849 270.52085193 335.670918 "
        "411.16017071 497.73221812 596.1406353 707.17226443 831.67252501 970.57129422 "
        "1124.90833831 1299.105178 1495.71733381 1717.62916574 1968.09618771 2250.79282696 "
        "2569.86632898 2929.99759889 3336.46987174 3795.24621912 4313.0570293 4897.49874403 "
        "5557.1453007 6301.67391436 7142.00704589 8090.47263733 9160.98496679 10369.24877505 "
        "11732.98965891 13272.21411103 15009.50302131 16970.34294536 19183.5"
    ),
    advances=_parse_floats(
        "485 442 396 349 311 272 239 210 186 162 143 126 111 98 87 77 69 61 54 47 42 37 33 29 26 "
        "23 20 18 16 14 12 11 10 9 8 7"
    ),
    highpass_corners=_parse_floats(
        "17 20 23 28 33 39 47 56 68 81 98 118 143 172 207 248 297 353 416 484 553 612"
    ),
    recombination_db=5.133590840990304,
)
_MIDDLE = FilterBank(
    broadening=2.0,
    centre_frequencies=_parse_floats(
        "65.82694525 95.55458999 134.88307080 185.57021234 249.40928102 328.23187888 "
        "423.94010685 538.56539628 674.34796723 833.82987446 1019.95570852 1238.68155948 "
        "1495.71733381 1797.77303045 2152.73390742 2569.86632898 3060.05966689 3636.11057091 "
        "4313.0570293 5108.57094018 6043.41944195 7142.00704589 8433.01272356 9950.13858023 "
        "11732.98965891 13828.10784223 16290.1868429 19183.5"
    ),
    advances=_parse_floats(
        "379 339 289 253 216 184 156 132 111 95 80 68 58 49 42 36 30 26 22 19 16 13 11 10 8 7 6 5"
    ),
    highpass_corners=_parse_floats("23 29 35 44 55 70 88 112 142 180 228 288 361 448 541 625"),
    recombination_db=4.967792069637238,
)
_WIDE = FilterBank(
    broadening=3.0,
    centre_frequencies=_parse_floats(
        "83.31770882 133.06739888 204.09758945 302.16469133 434.02502476 607.85199301 "
        "833.82987446 1124.90833831 1495.71733381 1968.09618771 2569.86632898 3336.46987174 "
        "4313.0570293 5557.1453007 7142.00704589 9160.98496679 11732.98965891 15009.50302131 "
        "19183.5"
    ),
    advances=_parse_floats("229 204 166 133 106 83 65 50 39 31 24 19 15 12 9 7 5 4 4"),
    highpass_corners=_parse_floats("40 54 74 102 142 199 278 387 526 664"),
    recombination_db=4.240378918292534,
)

BANKS = {"none": _NARROW, "mild": _NARROW, "moderate": _MIDDLE, "severe": _WIDE}
"""Filter bank of each severity of hearing loss."""


@constant
def gammatone_response(
    bank: FilterBank, points: int, channels: slice = slice(None), bins: int | None = None
) -> NDArray[np.complex128]:
    """Compute the frequency responses of the band-pass filters of a bank, its channels.

    Each channel is a cascade of four identical gammatone stages with one zero and two poles::

        g (1 - r cos(w) / z) / (1 - 2 r cos(w) / z + r^2 / z^2)

    Here r is exp(-2 pi broadening ERB / fs), w is 2 pi f / fs, fs is 44.1 kHz, and ERB is that of a
    normal filter at the channel's centre frequency f, at which g makes the gain 1. The advance of
    the channel and its high-pass, if it has one, are part of the response (``FilterBank.advances``,
    ``highpass_corners``).

    Args:
        bank: Filter bank of a severity, a value of ``BANKS``.
        points: FFT length at 44.1 kHz. The responses are computed at the frequencies of its
            ``rfft``.
        channels: Channels of the bank, by default all of them.
        bins: Number of frequencies from 0 Hz up, by default all of them.

    Returns:
        Complex responses, (channels, bins), where bins is points // 2 + 1 by default.

    >>> response = gammatone_response(BANKS["mild"], points=44100)
    >>> response.shape
    (36, 22051)
    >>> print(abs(response[14, 1299]).round(3))  # the channel of 1299 Hz
    1.0
    """
    indices = np.arange(bank.channels)[channels]
    count = points // 2 + 1 if bins is None else bins
    centre_hz = np.array(bank.centre_frequencies)[indices, None]
    omega = 2.0 * np.pi * np.arange(count)[None] / points
    centre_omega = 2.0 * np.pi * centre_hz / MSBG_RATE
    radius = np.exp(-2.0 * np.pi * bank.broadening * erb(centre_hz) / MSBG_RATE)

    def stage(w: NDArray[np.floating]) -> NDArray[np.complex128]:
        radius_over_z = radius * np.exp(-1j * w)
        response = 1.0 - np.cos(centre_omega) * radius_over_z
        response /= response - np.cos(centre_omega) * radius_over_z + radius_over_z**2
        return response

    response = stage(omega) / np.abs(stage(centre_omega))
    # Squaring twice gives the fourth power.
    response *= response
    response *= response
    response *= np.exp(1j * omega * np.array(bank.advances)[indices, None])

    first_highpass = bank.channels - len(bank.highpass_corners)
    has_highpass = indices >= first_highpass
    corners = np.array(bank.highpass_corners)[indices[has_highpass] - first_highpass, None]
    corner_hz = _CORNER_STEP_HZ * corners
    gain_at_centre = np.abs(_bessel_highpass(corner_hz, centre_omega[has_highpass]))
    response[has_highpass] *= _bessel_highpass(corner_hz, omega) / gain_at_centre
    return response


def _bessel_highpass(
    corner_hz: NDArray[np.float64], omega: NDArray[np.floating]
) -> NDArray[np.complex128]:
    """Compute the response of Bessel high-passes of second order, s^2 / (s^2 + 3 s + 3).

    The bilinear transform that makes them digital is warped to keep the corner frequency in place.

    Args:
        corner_hz: Corner frequencies in Hz.
        omega: Frequencies of the response in radians per sample at 44.1 kHz.

    Returns:
        Complex response, in the shape to which both arguments broadcast.
    """
    s = 1j * np.tan(omega / 2.0) / np.tan(np.pi * corner_hz / MSBG_RATE)
    return s**2 / (s**2 + 3.0 * s + 3.0)
