"""MSBG's gammatone filter banks: one a degree of loss, evaluated on an FFT grid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE

_CORNER_STEP = MSBG_RATE / 8192.0


@dataclass(frozen=True)
class FilterBank:
    """One bank: channel frequencies and what compensates for the filters' delays and skirts.

    Attributes:
        broadening: bandwidth of the filters over that of the normal ear.
        centre_frequencies: Hz.
        advances: samples at 44.1 kHz by which a channel is moved ahead, to line its envelope up with the others.
        highpass_corners: of the upper channels' second-order Bessel high-passes, which hold their low skirts down, in
            steps of 44100 / 8192 Hz; the lower channels have none.
        recombination_db: level by which the sum of the channels exceeds the input.
    """

    broadening: float
    centre_frequencies: tuple[float, ...]
    advances: tuple[int, ...]
    highpass_corners: tuple[int, ...]
    recombination_db: float

    @property
    def channels(self) -> int:
        return len(self.centre_frequencies)

    @property
    def first_highpass(self) -> int:
        """Index of the first channel that has a high-pass."""
        return self.channels - len(self.highpass_corners)


def _floats(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split()))


def _ints(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split()))


# Channel frequencies, advances, high-pass corners and recombination levels: Stone and Moore's tables of 19-Nov-2013 in
# pyclarity 0.9.0 (clarity/evaluator/msbg/msbg_hparams/GT4FBank_*.json). The coefficients there follow from these.
_NARROW = FilterBank(
    1.5,
    _floats(
        "72.58201774 97.8613053 129.44897664 168.20191403 214.95677849 270.52085193 335.670918 411.16017071 497.73221812 "
        "596.1406353 707.17226443 831.67252501 970.57129422 1124.90833831 1299.105178 1495.71733381 1717.62916574 "
        "1968.09618771 2250.79282696 2569.86632898 2929.99759889 3336.46987174 3795.24621912 4313.0570293 4897.49874403 "
        "5557.1453007 6301.67391436 7142.00704589 8090.47263733 9160.98496679 10369.24877505 11732.98965891 "
        "13272.21411103 15009.50302131 16970.34294536 19183.5"
    ),
    _ints(
        "485 442 396 349 311 272 239 210 186 162 143 126 111 98 87 77 69 61 54 47 42 37 33 29 26 23 20 18 16 14 12 11 10 "
        "9 8 7"
    ),
    _ints("17 20 23 28 33 39 47 56 68 81 98 118 143 172 207 248 297 353 416 484 553 612"),
    5.133590840990304,
)
_MIDDLE = FilterBank(
    2.0,
    _floats(
        "65.82694525 95.55458999 134.88307080 185.57021234 249.40928102 328.23187888 423.94010685 538.56539628 "
        "674.34796723 833.82987446 1019.95570852 1238.68155948 1495.71733381 1797.77303045 2152.73390742 2569.86632898 "
        "3060.05966689 3636.11057091 4313.0570293 5108.57094018 6043.41944195 7142.00704589 8433.01272356 9950.13858023 "
        "11732.98965891 13828.10784223 16290.1868429 19183.5"
    ),
    _ints(
        "379 339 289 253 216 184 156 132 111 95 80 68 58 49 42 36 30 26 22 19 16 13 11 10 8 7 6 5"
    ),
    _ints("23 29 35 44 55 70 88 112 142 180 228 288 361 448 541 625"),
    4.967792069637238,
)
_WIDE = FilterBank(
    3.0,
    _floats(
        "83.31770882 133.06739888 204.09758945 302.16469133 434.02502476 607.85199301 833.82987446 1124.90833831 "
        "1495.71733381 1968.09618771 2569.86632898 3336.46987174 4313.0570293 5557.1453007 7142.00704589 9160.98496679 "
        "11732.98965891 15009.50302131 19183.5"
    ),
    _ints("229 204 166 133 106 83 65 50 39 31 24 19 15 12 9 7 5 4 4"),
    _ints("40 54 74 102 142 199 278 387 526 664"),
    4.240378918292534,
)

BANKS = {"none": _NARROW, "mild": _NARROW, "moderate": _MIDDLE, "severe": _WIDE}
"""The bank of each severity."""


def gammatone_response(
    bank: FilterBank, points: int, channels: slice = slice(None), bins: int | None = None
) -> NDArray[np.complex128]:
    """Frequency responses of channels, advances and high-passes included.

    Each channel is four times the one-zero, two-pole gammatone stage g (1 - r cos(w) / z) / (1 - 2 r cos(w) / z + r^2 /
    z^2) with r = exp(-2 pi broadening ERB / fs), w = 2 pi f / fs and unit gain at its frequency f.

    Args:
        points: FFT length; the grid is that of ``rfft`` at 44.1 kHz.
        channels: which of the bank's; all by default.
        bins: how many, from 0 Hz up; all by default.

    Returns: (channels, points // 2 + 1), or as many channels and bins as were asked for.
    """
    chosen = range(bank.channels)[channels]
    centre = np.array(bank.centre_frequencies)[chosen, None]
    omega = 2.0 * np.pi * np.arange(points // 2 + 1 if bins is None else bins)[None] / points
    peak = 2.0 * np.pi * centre / MSBG_RATE
    radius = np.exp(-2.0 * np.pi * bank.broadening * erb(centre) / MSBG_RATE)

    def stage(w: NDArray[np.floating]) -> NDArray[np.complex128]:
        delayed = radius * np.exp(-1j * w)
        out = 1.0 - np.cos(peak) * delayed
        out /= out - np.cos(peak) * delayed + delayed**2
        return out

    response = stage(omega) / np.abs(stage(peak))
    for _ in range(2):  # to the fourth
        response *= response
    response *= np.exp(1j * omega * np.array(bank.advances)[chosen, None])
    first = bank.first_highpass
    upper = [place for place, channel in enumerate(chosen) if channel >= first]
    if upper:
        corners = (
            _CORNER_STEP * np.array(bank.highpass_corners)[[chosen[i] - first for i in upper], None]
        )
        unity = np.abs(_bessel_highpass(corners, peak[upper]))
        response[upper] *= _bessel_highpass(corners, omega) / unity
    return response


def _bessel_highpass(
    corner: NDArray[np.float64], omega: NDArray[np.floating]
) -> NDArray[np.complex128]:
    """s^2 / (s^2 + 3 s + 3) of the corner in Hz, by the bilinear transform with the corner kept in place."""
    s = 1j * np.tan(omega / 2.0) / np.tan(np.pi * corner / MSBG_RATE)
    return s**2 / (s**2 + 3.0 * s + 3.0)
