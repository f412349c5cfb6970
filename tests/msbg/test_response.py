"""The linear response equals MSBG's for normal ears and has the phase of its outputs."""

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.msbg.filter_bank import BANKS
from hlsim.msbg.response import apply_bank_phase, fixed_response, simulate_normal_ear

EARS = ("NH", "N1", "N3", "N5")


def thresholds(name: str) -> Tensor:
    return torch.tensor([Audiogram.standard(name).thresholds])


def cosine(first: Tensor, second: Tensor) -> float:
    return float(torch.cosine_similarity(first.flatten(), second.flatten(), dim=0))


@pytest.fixture
def utterance(speech: list[tuple[Tensor, int]]) -> Tensor:
    waveform, rate = speech[0]
    return set_level(resample(waveform, rate, 16000)[:1, 8000:24000], 65.0)


@pytest.mark.parametrize("rate", [16000, 22050, 44100, 48000])
def test_response_equals_msbgs_for_a_normal_ear(rate: int) -> None:
    impulse = torch.zeros(rate // 2, dtype=torch.float64)
    impulse[rate // 4] = 1.0
    output = MSBG(Audiogram.standard("NH"), sample_rate=rate).double()(impulse)
    points = rate  # one second, which is a whole number of samples at 44.1 kHz, too
    delay = np.exp(-2j * np.pi * (rate // 4) / points * np.arange(points // 2 + 1))
    expected = fixed_response(BANKS["none"], rate, points) * delay
    band = slice(100, 7800)
    spectrum = np.fft.rfft(output.numpy(), points)[band]
    assert np.linalg.norm(spectrum - expected[band]) < 2e-3 * np.linalg.norm(expected[band])


def test_normal_ear_equals_msbg_below_the_band_that_msbg_fades_out(utterance: Tensor) -> None:
    ears = thresholds("NH")
    output = MSBG()(utterance, ears)
    error = simulate_normal_ear(utterance, ears, 16000) - output
    error_spectrum, spectrum = (torch.fft.rfft(signal)[:, :7920] for signal in (error, output))
    assert float(error_spectrum.norm() / spectrum.norm()) < 10.0 ** (-70.0 / 20.0)


@pytest.mark.parametrize("name", EARS)
def test_msbgs_output_has_this_phase(name: str, utterance: Tensor) -> None:
    """The output resembles the result more than the input, if all gains are 1. Smearing remains."""
    loud = 1000.0 * utterance
    output = MSBG(Audiogram.standard(name), sample_rate=16000)(loud)
    shifted = apply_bank_phase(loud, thresholds(name), 16000)
    assert cosine(output, shifted) > {"NH": 0.97, "N1": 0.9, "N3": 0.75, "N5": 0.6}[name]
    assert cosine(output, shifted) > cosine(output, loud) + 0.1


def test_normal_speech_gets_the_phase_of_the_impaired_bank(utterance: Tensor) -> None:
    normal = MSBG(Audiogram.standard("NH"), sample_rate=16000)(utterance)
    for name in EARS[1:]:
        shifted = apply_bank_phase(normal, thresholds(name), 16000, normal=True)
        assert cosine(shifted, apply_bank_phase(utterance, thresholds(name), 16000)) > 0.97
    assert torch.equal(apply_bank_phase(normal, thresholds("NH"), 16000, normal=True), normal)


def test_magnitude_is_unchanged_and_each_item_has_the_phase_of_its_ear() -> None:
    noise = torch.randn(1, 16000, dtype=torch.float64)
    noise[:, :4000] = noise[:, -4000:] = 0.0
    ears = torch.cat([thresholds(name) for name in EARS])
    shifted = apply_bank_phase(noise.expand(4, -1), ears, 16000)
    items = torch.cat([apply_bank_phase(noise, ear[None], 16000) for ear in ears])
    torch.testing.assert_close(shifted, items)
    assert cosine(shifted[0], shifted[2]) < 0.9
    before = torch.fft.rfft(noise).abs()[..., 150:7500]
    after = torch.fft.rfft(shifted).abs()[..., 150:7500]
    assert float((after - before).norm(dim=-1).max() / before.norm()) < 0.02
