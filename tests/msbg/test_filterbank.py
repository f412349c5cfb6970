"""The gammatone banks against the coefficients that pyclarity ships."""

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
    """Our bank of a severity and the reference's."""
    severity = request.param
    name = cochlea.HL_PARAMS["NOTHING" if severity == "none" else severity.upper()]["gtfbank_file"]
    return BANKS[severity], msbg_utils.read_gtf_file(f"msbg_hparams/{name}.json")


def test_tables(both: tuple[FilterBank, dict[str, Any]]) -> None:
    bank, theirs = both
    np.testing.assert_allclose(bank.centre_frequencies, theirs["GTn_CentFrq"], rtol=1e-7)
    assert list(bank.advances) == theirs["GTnDelays"].tolist()
    assert bank.recombination_db == pytest.approx(theirs["Recombination_dB"], abs=1e-12)
    assert bank.broadening == theirs["BROADEN"]
    assert bank.first_highpass == theirs["Start2PoleHP"] - 1
    assert (theirs["NGAMMA"], theirs["Fs"]) == (4, MSBG_RATE)
    # its "ERBn_CentFrq" are bandwidths
    np.testing.assert_allclose(
        erb(np.array(bank.centre_frequencies)), theirs["ERBn_CentFrq"], rtol=1e-6
    )


def test_responses_with_advances_and_highpasses(both: tuple[FilterBank, dict[str, Any]]) -> None:
    bank, theirs = both
    omega = 2 * np.pi * np.fft.rfftfreq(POINTS)
    ours = gammatone_response(bank, POINTS)
    assert ours.shape == (bank.channels, POINTS // 2 + 1)
    assert bank.channels == len(theirs["GTn_nums"])
    for i in range(bank.channels):
        response = scipy.signal.freqz(theirs["GTn_nums"][i], theirs["GTn_denoms"][i], omega)[1] ** 4
        response = response * np.exp(1j * omega * theirs["GTnDelays"][i])
        place = i - (theirs["Start2PoleHP"] - 1)
        if place >= 0:
            response *= scipy.signal.freqz(
                theirs["HP_nums"][place], theirs["HP_denoms"][place], omega
            )[1]
        np.testing.assert_allclose(ours[i], response, atol=2e-7 * np.abs(response).max())


def test_a_click_through_the_reference_bank(both: tuple[FilterBank, dict[str, Any]]) -> None:
    """In the time domain, away from the ends, where the reference puts zeros."""
    bank, theirs = both
    click = np.zeros(POINTS)
    click[2000] = 1.0
    filters = (
        cochlea.FilterBank(theirs[f"{kind}_nums"], theirs[f"{kind}_denoms"])
        for kind in ("GTn", "HP")
    )
    first, second = filters
    expected = cochlea.gammatone_filterbank(
        click, theirs["NGAMMA"], first, theirs["GTnDelays"], theirs["Start2PoleHP"], second
    )
    ours = np.fft.irfft(gammatone_response(bank, POINTS) * np.fft.rfft(click), POINTS)
    np.testing.assert_allclose(
        ours[:, 500:7000], expected[:, 500:7000], atol=1e-6 * np.abs(expected).max()
    )


def test_channels_have_unit_gain_at_their_frequency_and_the_sum_is_what_the_table_says() -> None:
    for bank in (BANKS["mild"], BANKS["moderate"], BANKS["severe"]):
        response = gammatone_response(bank, MSBG_RATE)  # a bin a hertz
        for channel, hz in zip(response, bank.centre_frequencies, strict=True):
            assert np.interp(hz, np.arange(len(channel)), np.abs(channel)) == pytest.approx(
                1.0, abs=1e-3
            )
        level = 20 * np.log10(np.abs(response.sum(0)[300:8000])) - bank.recombination_db
        assert abs(level.mean()) < 0.5 and np.abs(level).max() < 3.0


def test_none_and_mild_share_a_bank_and_the_others_do_not() -> None:
    assert BANKS["none"] is BANKS["mild"]
    assert [BANKS[name].channels for name in SEVERITIES] == [36, 36, 28, 19]
