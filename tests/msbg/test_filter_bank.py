"""The filters of the ear and of the gammatone filter banks equal pyclarity's."""

from typing import Any

import numpy as np
import pytest
import scipy.signal

from hlsim.audiogram import SEVERITIES
from hlsim.dsp.erb import erb
from hlsim.dsp.fir import frequency_sampling_fir
from hlsim.msbg.ear import MSBG_RATE, ear_filter
from hlsim.msbg.filter_bank import BANKS, FilterBank, gammatone_response

msbg = pytest.importorskip("clarity.evaluator.msbg.msbg")
msbg_utils = pytest.importorskip("clarity.evaluator.msbg.msbg_utils")
cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")

POINTS = 8192


@pytest.fixture(params=SEVERITIES)
def both(request: pytest.FixtureRequest) -> tuple[FilterBank, dict[str, Any]]:
    """Filter bank of a severity, and pyclarity's table of it."""
    severity = request.param
    name = cochlea.HL_PARAMS["NOTHING" if severity == "none" else severity.upper()]["gtfbank_file"]
    return BANKS[severity], msbg_utils.read_gtf_file(f"msbg_hparams/{name}.json")


def test_tables_equal_pyclaritys(both: tuple[FilterBank, dict[str, Any]]) -> None:
    bank, theirs = both
    np.testing.assert_allclose(bank.centre_frequencies, theirs["GTn_CentFrq"], rtol=1e-7)
    assert list(bank.advances) == theirs["GTnDelays"].tolist()
    assert bank.recombination_db == pytest.approx(theirs["Recombination_dB"], abs=1e-12)
    assert bank.broadening == theirs["BROADEN"]
    assert bank.channels - len(bank.highpass_corners) == theirs["Start2PoleHP"] - 1
    assert (theirs["NGAMMA"], theirs["Fs"]) == (4, MSBG_RATE)
    # The entry "ERBn_CentFrq" holds bandwidths.
    bandwidths = erb(np.array(bank.centre_frequencies))
    np.testing.assert_allclose(bandwidths, theirs["ERBn_CentFrq"], rtol=1e-6)


def test_responses_equal_those_of_pyclaritys_coefficients(
    both: tuple[FilterBank, dict[str, Any]],
) -> None:
    bank, theirs = both
    omega = 2 * np.pi * np.fft.rfftfreq(POINTS)
    ours = gammatone_response(bank, POINTS)
    assert ours.shape == (bank.channels, POINTS // 2 + 1)
    assert bank.channels == len(theirs["GTn_nums"])
    for i in range(bank.channels):
        response = scipy.signal.freqz(theirs["GTn_nums"][i], theirs["GTn_denoms"][i], omega)[1] ** 4
        response = response * np.exp(1j * omega * theirs["GTnDelays"][i])
        row = i - (theirs["Start2PoleHP"] - 1)
        if row >= 0:
            highpass = scipy.signal.freqz(theirs["HP_nums"][row], theirs["HP_denoms"][row], omega)
            response *= highpass[1]
        np.testing.assert_allclose(ours[i], response, atol=2e-7 * np.abs(response).max())


@pytest.mark.parametrize("backward", [False, True])
def test_outer_and_middle_ear_filter_as_pyclarity(backward: bool) -> None:
    noise = np.random.default_rng(0).standard_normal(5000)
    correction = msbg.Ear.get_src_correction("ff")
    theirs = msbg.Ear.src_to_cochlea_filt(noise, correction, 44100.0, backward)
    ours = scipy.signal.lfilter(ear_filter(backward), 1.0, noise)
    np.testing.assert_allclose(ours, theirs, atol=1e-12 * np.abs(theirs).max())


@pytest.mark.parametrize("taps", [141, 1015])
def test_frequency_sampling_equals_pyclaritys_firwin2(taps: int) -> None:
    frequencies = np.array([0.0, 0.02, 0.1, 0.101, 0.3, 0.55, 1.0])
    gains = np.array([0.1, 1.0, 3.0, 2.5, 0.2, 1.7, 0.05])
    ours = frequency_sampling_fir(taps, frequencies, gains, kaiser_beta=4.0)
    theirs = msbg_utils.firwin2(taps, frequencies.copy(), gains.copy(), window=("kaiser", 4))
    np.testing.assert_allclose(ours, theirs, atol=1e-14)
