"""The filters of the linear stages equal pyclarity's."""

import numpy as np
import pytest
import scipy.signal

from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.msbg.ear import ear_filter, lowpass_filter

msbg = pytest.importorskip("clarity.evaluator.msbg.msbg")
msbg_utils = pytest.importorskip("clarity.evaluator.msbg.msbg_utils")


@pytest.mark.parametrize("backward", [False, True])
def test_outer_and_middle_ear_filter_as_pyclarity(backward: bool) -> None:
    noise = np.random.default_rng(0).standard_normal(5000)
    correction = msbg.Ear.get_src_correction("ff")
    theirs = msbg.Ear.src_to_cochlea_filt(noise, correction, 44100.0, backward)
    ours = scipy.signal.lfilter(ear_filter(backward), 1.0, noise)
    np.testing.assert_allclose(ours, theirs, atol=1e-12 * np.abs(theirs).max())


def test_lowpass_equals_pyclaritys() -> None:
    # These are the lines of pyclarity's Ear.process.
    length = 2 * int(np.floor(0.0015 * 44100)) + 1
    theirs = scipy.signal.firwin(length, 18000 / int(44100 / 2), window=("kaiser", 8))
    np.testing.assert_allclose(lowpass_filter(), theirs, atol=1e-15)


@pytest.mark.parametrize("taps", [141, 1015])
def test_frequency_sampling_equals_pyclaritys_firwin2(taps: int) -> None:
    frequencies = np.array([0.0, 0.02, 0.1, 0.101, 0.3, 0.55, 1.0])
    gains = np.array([0.1, 1.0, 3.0, 2.5, 0.2, 1.7, 0.05])
    ours = frequency_sampling_fir(taps, frequencies, gains, ("kaiser", 4.0))
    theirs = msbg_utils.firwin2(taps, frequencies.copy(), gains.copy(), window=("kaiser", 4))
    np.testing.assert_allclose(ours, theirs, atol=1e-14)
