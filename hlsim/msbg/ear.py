"""Filters of MSBG before and after the cochlea.

The filter of the outer and middle ear turns sound in front of the listener into what reaches the
cochlea. Its inverse turns the output of the cochlea back into sound, and a low-pass follows.
"""

import numpy as np
from numpy.typing import NDArray

from hlsim.dsp.fir import frequency_sampling_fir, lowpass_fir

MSBG_RATE = 44100
"""Sample rate in Hz at which MSBG is defined."""

EAR_DELAY = 507
"""Delay in samples of each of the two ear filters, which have 1015 taps and linear phase."""

# The tables are those of the Cambridge hearing-loss simulator in pyclarity 0.9.0
# (clarity/evaluator/msbg/msbg_utils.py). The gain from the frontal free field to the eardrum is
# from Shaw (1974). The attenuation of the middle ear is from Moore, Glasberg and Baer (1997),
# shifted so that both together are 0 dB at 1 kHz.
_TABLE_HZ = np.array(
    "0 20 25 31.5 40 50 63 80 100 125 160 200 250 315 400 500 630 750 800 1000 1250 1500 "
    "1600 2000 2500 3000 3150 4000 5000 6000 6300 8000 9000 10000 11200 12500 14000 15000 "
    "16000 20000 48000".split(),
    dtype=float,
)
_MIDDLE_EAR_ATTENUATION_DB = np.array(
    "50 39.6 32 25.85 21.4 18.5 15.9 14.1 12.4 11 9.6 8.3 7.4 6.2 4.8 3.8 3.3 2.9 2.6 2.6 "
    "4.5 5.4 6.1 8.5 10.4 7.3 7 6.6 7 9.2 10.2 12.2 10.8 10.1 12.7 15 18.2 23.8 32.3 50 50".split(),
    dtype=float,
)
_FREE_FIELD_GAIN_DB = np.array(
    "0 0 0 0 0 0 0 0 0 .1 .3 .5 .9 1.4 1.6 1.7 2.5 2.7 2.6 2.6 3.2 5.2 6.6 12 16.8 15.3 15.2 "
    "14.2 10.7 7.1 6.4 1.8 -.9 -1.6 1.9 4.9 2 -2 2.5 2.5 2.5".split(),
    dtype=float,
)


def ear_filter(backward: bool = False) -> NDArray[np.float64]:
    """Design the FIR filter of the outer and middle ear, or the filter that undoes it.

    Args:
        backward: Design the inverse filter, from the cochlea to the sound in front of the listener.

    Returns:
        Coefficients at 44.1 kHz, (1015,).

    >>> ear_filter().shape
    (1015,)
    """
    nyquist = MSBG_RATE / 2.0
    gain_db = _FREE_FIELD_GAIN_DB - _MIDDLE_EAR_ATTENUATION_DB
    if backward:
        gain_db = -gain_db
    below_nyquist = nyquist > _TABLE_HZ
    hz = np.append(_TABLE_HZ[below_nyquist], nyquist)
    gain_db = np.append(gain_db[below_nyquist], np.interp(nyquist, _TABLE_HZ, gain_db))
    # 23 ms, so that the gain is accurate down to about 100 Hz
    taps = 2 * EAR_DELAY + 1
    gains = 10.0 ** (gain_db / 20.0)
    return frequency_sampling_fir(taps, hz / nyquist, gains, kaiser_beta=4.0)


def lowpass_filter() -> NDArray[np.float64]:
    """Design the FIR low-pass that removes artefacts of the model above 18 kHz.

    Returns:
        Coefficients at 44.1 kHz, (133,).

    >>> lowpass_filter().shape
    (133,)
    """
    return lowpass_fir(133, 18000.0 / (MSBG_RATE / 2.0), kaiser_beta=8.0)
