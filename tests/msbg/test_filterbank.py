"""The gammatone filter banks equal those of pyclarity's coefficients."""

from typing import Any

import numpy as np
import pytest
import scipy.signal

from hlsim.audiogram import SEVERITIES
from hlsim.dsp.erb import erb
from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.filterbank import BANKS, FilterBank, gammatone_response

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
