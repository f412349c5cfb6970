"""NAL-RP and CAMFIT prescribe what openMHA's implementation of them does."""

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators.filter_bank import SPEECH_SPECTRUM
from hlsim import CAMFIT, NALR, NALRP, WDRC
from hlsim.audiogram import FREQUENCIES, STANDARD
from hlsim.audiogram.prescription import (
    camfit_gains,
    compressed_gains_db,
    nalr_gains_db,
    nalrp_gains_db,
)

MEASURED_HZ = (125.0, 250.0, 500.0, 750.0, 1000.0, 1500.0, 2000.0, 3000.0, 4000.0, 6000.0, 8000.0)
EARS = {
    "1 left": [10.0, 15.0, 30.0, 40.0, 45.0, 50.0, 65.0, 65.0, 75.0, 65.0, 65.0],
    "1 right": [20.0, 15.0, 20.0, 30.0, 35.0, 35.0, 40.0, 55.0, 70.0, 65.0, 85.0],
    "2 left": [50.0, 50.0, 50.0, 50.0, 55.0, 55.0, 60.0, 65.0, 80.0, 85.0, 90.0],
    "2 right": [40.0, 40.0, 40.0, 45.0, 50.0, 55.0, 65.0, 70.0, 70.0, 70.0, 70.0],
}
BANDS = {
    "1": (177.0, 297.0, 500.0, 841.0, 1414.0, 2378.0, 4000.0, 6727.0, 11314.0),
    "2": (276.0, 1029.0, 2632.0, 9391.0),
}
EDGES = {
    "1": [229.3, 385.4, 648.5, 1090.5, 1833.7, 3084.2, 5187.3, 8724.1],
    "2": [532.9, 1645.7, 4971.6],
}
ABOVE_8_KHZ = {10000: 43.4, 12500: 41.3, 16000: 40.7}  # the speech of SPEECH_SPECTRUM

# Gains in dB from the reference tables of openMHA's tests (HoerTech), the same at all levels
NALRP_GAINS = {
    "1 left": [0.0, 2.063, 8.3, 18.540, 23.274, 25.723, 28.25, 19.519, 0.0],
    "1 right": [0.0, 0.733, 2.95, 13.190, 16.600, 17.708, 24.450, 17.773, 0.0],
    "2 left": [8.035, 26.300, 26.222, 4.010],
    "2 right": [4.435, 24.359, 27.272, 3.376],
}
# The same for bands of 40, 60 and 90 dB SPL
CAMFIT_GAINS = {
    "1 left": [
        [3.954, 3.671, 9.455, 20.685, 27.46, 35.144, 41.149, 44.755, 50.381],
        [0.0, 0.0, 6.441, 15.376, 18.948, 23.868, 27.991, 31.597, 37.223],
        [0.0, 0.0, 1.92, 7.412, 6.179, 6.953, 8.255, 10.0, 10.0],
    ],
    "1 right": [
        [6.448, 2.454, 1.881, 13.75, 18.47, 24.504, 36.363, 52.706, 60.0],
        [0.0, 0.0, 1.604, 11.178, 13.863, 18.317, 23.332, 39.548, 40.0],
        [0.0, 0.0, 1.188, 7.319, 6.953, 9.036, 3.784, 10.0, 10.0],
    ],
    "2 left": [
        [26.957, 31.419, 34.425, 60.0],
        [16.186, 26.073, 25.456, 40.0],
        [0.029, 10.0, 10.0, 10.0],
    ],
    "2 right": [
        [18.938, 27.977, 37.489, 54.608],
        [10.903, 23.903, 27.152, 40.0],
        [0.0, 10.0, 10.0, 10.0],
    ],
}


def speech_levels(case: str) -> Tensor:
    """Compute the level of average speech at 65 dB SPL in the bands of a case of openMHA."""
    thirds = {**SPEECH_SPECTRUM, **ABOVE_8_KHZ}
    centres = np.array(list(thirds), dtype=float)
    low, high = centres * 2.0 ** (-1.0 / 6.0), centres * 2.0 ** (1.0 / 6.0)
    edges = np.array([0.0, *EDGES[case], np.inf])
    overlap = np.minimum(high, edges[1:, None]) - np.maximum(low, edges[:-1, None])
    shares = overlap.clip(0.0) / (high - low)
    powers = 10.0 ** ((np.array(list(thirds.values())) - 5.0) / 10.0)
    return torch.tensor(10.0 * np.log10(shares @ powers))


@pytest.mark.parametrize("name", EARS)
def test_nalrp_equals_openmha(name: str) -> None:
    ear = torch.tensor(EARS[name], dtype=torch.float64)
    gains = nalrp_gains_db(ear, BANDS[name[0]], MEASURED_HZ)
    assert (gains - torch.tensor(NALRP_GAINS[name])).abs().max() < 0.01


@pytest.mark.parametrize("name", EARS)
def test_camfit_equals_openmha_from_40_to_90_db_spl(name: str) -> None:
    ear = torch.tensor(EARS[name], dtype=torch.float64)
    speech = speech_levels(name[0])
    line = camfit_gains(ear, speech, BANDS[name[0]], MEASURED_HZ)
    levels = torch.tensor([[40.0], [60.0], [90.0]])
    gains = compressed_gains_db(line, levels, speech)
    assert (gains - torch.tensor(CAMFIT_GAINS[name])).abs().max() < 0.1


def test_camfit_gains_stop_rising_below_speech_and_never_attenuate() -> None:
    ear, speech = torch.tensor(EARS["1 left"]), speech_levels("1").float()
    line = camfit_gains(ear, speech, BANDS["1"], MEASURED_HZ)
    softest = compressed_gains_db(line, speech - 38.0, speech)
    assert torch.equal(compressed_gains_db(line, torch.full((9,), -10.0), speech), softest)
    assert not compressed_gains_db(line, torch.full((9,), 110.0), speech).any()


@pytest.mark.parametrize("name", ["NH", "N1", "N3"])
def test_camfit_never_amplifies_louder_sounds_more(name: str) -> None:
    """Where there is hardly a loss, the two points of a band lie on a line that rises."""
    gains = [CAMFIT().gains(name, level) for level in (50.0, 65.0, 80.0, 90.0)]
    assert float(torch.stack(gains).diff(dim=0).max()) < 0.1


def test_nalrp_corrects_profound_losses_only() -> None:
    """The published rows for 95 to 120 dB HL are 5 dB apart; between them is a straight line."""
    ears = torch.full((4, 8), 80.0, dtype=torch.float64)
    ears[:, 3] = torch.tensor([90.0, 95.0, 97.5, 120.0])
    sums = 160.0 + ears[:, 3:4]
    without = 9.0 + 0.116 * (sums - 180.0) + 0.31 * 80.0 + torch.tensor([-17.0, -8.0, 1.0])
    added = nalrp_gains_db(ears)[:, :3] - without
    rows = torch.tensor([[0.0, 0.0, 0.0], [4.0, 3.0, 0.0], [5.0, 3.5, 0.0], [15.0, 9.0, 0.0]])
    torch.testing.assert_close(added, rows.double())


def test_nalrp_is_nalr_below_its_corrections() -> None:
    """At 250 to 2000, 4000 and 6000 Hz; the two differ at 3 kHz and above 6 kHz."""
    at = [0, 1, 2, 3, 5, 6]
    ears = torch.tensor([STANDARD[name] for name in ("NH", "N1", "N3", "N5", "S1")]).double()
    torch.testing.assert_close(nalrp_gains_db(ears)[:, at], nalr_gains_db(ears)[:, at])


def test_the_aids_have_the_prescribed_gains() -> None:
    """A filter's gain is a mean over a third of an octave; a band's depends on its speech."""
    ears = torch.tensor([STANDARD[name] for name in ("N3", "N6")]).float()
    noise = torch.tensor(np.random.default_rng(0).normal(size=(2, 32000)))
    output = NALRP()(noise, ears.double())
    spectra = [torch.fft.rfft(signal).abs().square() for signal in (output, noise)]
    for column, hertz in enumerate(FREQUENCIES[:6]):
        half = round(2 * hertz * 0.05)
        near = slice(round(2 * hertz) - half, round(2 * hertz) + half + 1)
        gain = 10.0 * (spectra[0][:, near].sum(-1) / spectra[1][:, near].sum(-1)).log10()
        assert (gain - NALRP().gains(ears)[:, column]).abs().max() < 2.0
    assert torch.equal(CAMFIT().gains(ears), WDRC(prescription="camfit").gains(ears))
    at_1_khz = camfit_gains(ears, torch.tensor([53.7 - 5.0 + 1.0]), (1000.0,)).at_speech_level
    assert (CAMFIT().gains(ears)[:, 2] - at_1_khz[:, 0]).abs().max() < 3.0
    compressed = WDRC(prescription="nalrp").gains(ears)[:, 2]
    assert (compressed - NALR().gains(ears)[:, 2]).abs().max() < 3.0


def test_an_unknown_prescription_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"expected prescription to be .*camfit"):
        WDRC(prescription="nal-nl2")  # type: ignore[arg-type]
