"""The linear stages of MSBG: outer and middle ear, there and back, and the final low-pass."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.dsp.windows import kaiser

MSBG_RATE = 44100
"""The sample rate in Hz at which MSBG is defined."""

EAR_DELAY = 507
"""Samples by which each of the two ear filters delays (1015 taps, linear phase)."""

LOWPASS_HZ = 18000.0

# Tables of the Cambridge hearing-loss simulator as pyclarity 0.9.0 has them (clarity/evaluator/msbg/msbg_utils.py):
# Shaw (1974) for the frontal free field to the eardrum, the middle ear of Moore, Glasberg and Baer (1997) relative to
# 0 dB at 1 kHz. Hz; dB; dB.
_HZ = np.array(
    "0 20 25 31.5 40 50 63 80 100 125 160 200 250 315 400 500 630 750 800 1000 1250 1500 1600 2000 2500 3000 3150 4000 "
    "5000 6000 6300 8000 9000 10000 11200 12500 14000 15000 16000 20000 48000".split(),
    dtype=float,
)
_MIDDLE_EAR_DB = np.array(
    "50 39.6 32 25.85 21.4 18.5 15.9 14.1 12.4 11 9.6 8.3 7.4 6.2 4.8 3.8 3.3 2.9 2.6 2.6 4.5 5.4 6.1 8.5 10.4 7.3 7 "
    "6.6 7 9.2 10.2 12.2 10.8 10.1 12.7 15 18.2 23.8 32.3 50 50".split(),
    dtype=float,
)
_FREE_FIELD_DB = np.array(
    "0 0 0 0 0 0 0 0 0 .1 .3 .5 .9 1.4 1.6 1.7 2.5 2.7 2.6 2.6 3.2 5.2 6.6 12 16.8 15.3 15.2 14.2 10.7 7.1 6.4 1.8 "
    "-.9 -1.6 1.9 4.9 2 -2 2.5 2.5 2.5".split(),
    dtype=float,
)


@lru_cache(maxsize=2)
def ear_filter(backward: bool = False) -> NDArray[np.float64]:
    """FIR from the frontal free field to the cochlea, or ``backward``. Returns (1015,) for 44.1 kHz."""
    nyquist = MSBG_RATE / 2.0
    gain_db = _FREE_FIELD_DB - _MIDDLE_EAR_DB
    below = nyquist > _HZ
    frequencies = np.append(_HZ[below], nyquist) / nyquist
    gains = np.append(gain_db[below], np.interp(nyquist, _HZ, gain_db))
    taps = 2 * EAR_DELAY + 1  # 23 ms, to be right down to about 100 Hz
    return frequency_sampling_fir(
        taps, frequencies, 10.0 ** ((-gains if backward else gains) / 20.0), kaiser(taps, 4.0)
    )


@lru_cache(maxsize=1)
def lowpass_filter() -> NDArray[np.float64]:
    """FIR that keeps processing noise above 18 kHz out: a windowed sinc, as ``scipy.signal.firwin`` designs it.

    Returns (133,) for 44.1 kHz.
    """
    half = int(0.0015 * MSBG_RATE)
    cutoff = LOWPASS_HZ / (MSBG_RATE / 2.0)
    time = np.arange(2 * half + 1) - float(half)
    coefficients = cutoff * np.sinc(cutoff * time) * kaiser(len(time), 8.0)
    gain_at_0_hz = coefficients.sum()
    return coefficients / gain_at_0_hz
