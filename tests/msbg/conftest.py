"""Signals of the tests of MSBG."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import FilterBank


@pytest.fixture
def band_noise() -> Callable[[FilterBank, int], np.ndarray]:
    """Function of a bank and a length, which returns noise of shape (channels, time).

    The noise lies in the band of each channel and fluctuates like speech. It has 90 dB SPL where
    RMS 1.0 is 120 dB SPL.
    """
    return _band_noise


def _band_noise(bank: FilterBank, time: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    fluctuation = np.exp(np.cumsum(rng.standard_normal(time)) / 400)
    centres = np.array(bank.centre_frequencies)
    rows = []
    for hz, width in zip(centres, erb(centres), strict=True):
        edges = [max(20.0, hz - width), min(22000.0, hz + width)]
        bandpass = scipy.signal.butter(2, edges, "bandpass", fs=MSBG_RATE, output="sos")
        row = scipy.signal.sosfilt(bandpass, rng.standard_normal(time)) * fluctuation
        rows.append(row / np.sqrt(np.mean(row**2)))
    return 10 ** (-30 / 20) * np.array(rows)
