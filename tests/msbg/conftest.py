from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal

from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import FilterBank


@pytest.fixture
def band_noise() -> Callable[[FilterBank, int], np.ndarray]:
    """Noise in each channel's band, fluctuating as speech does, 90 dB SPL where RMS 1.0 is 120."""
    return _band_noise


def _band_noise(bank: FilterBank, time: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    slow = np.exp(np.cumsum(rng.standard_normal(time)) / 400)
    rows = []
    for hz, width in zip(
        bank.centre_frequencies, erb(np.array(bank.centre_frequencies)), strict=True
    ):
        edges = [max(20.0, hz - width), min(22000.0, hz + width)]
        sos = scipy.signal.butter(2, edges, "bandpass", fs=MSBG_RATE, output="sos")
        row = scipy.signal.sosfilt(sos, rng.standard_normal(time)) * slow
        rows.append(row / np.sqrt(np.mean(row**2)))
    return 10 ** (-30 / 20) * np.array(rows)
