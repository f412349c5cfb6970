"""The fixed response of the bank, and its phase alone."""

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim import MSBG, Audiogram
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.msbg.filterbank import BANKS
from hlsim.msbg.response import fixed_response, with_phase_of_bank

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
def test_a_normal_ears_response_is_msbgs(rate: int) -> None:
    """Of an impulse in float64: MSBG is linear there."""
    impulse = torch.zeros(rate // 2, dtype=torch.float64)
    impulse[rate // 4] = 1.0
    heard = MSBG(Audiogram.standard("NH"), sample_rate=rate).double()(impulse)
    points = rate  # 44.1 kHz shares it
    later = np.exp(-2j * np.pi * (rate // 4) / points * np.arange(points // 2 + 1))
    expected = fixed_response(BANKS["none"], rate, points) * later
    below = slice(100, 7800)
    found = np.fft.rfft(heard.numpy(), points)[below]
    assert np.linalg.norm(found - expected[below]) < 2e-3 * np.linalg.norm(expected[below])


@pytest.mark.parametrize("name", EARS)
def test_what_is_heard_has_this_phase(name: str, utterance: Tensor) -> None:
    """Loud enough for the gains to be 1: after smearing too, and unlike the signal itself."""
    loud = 1000.0 * utterance
    heard = MSBG(Audiogram.standard(name), sample_rate=16000)(loud)
    moved = with_phase_of_bank(loud, thresholds(name), 16000)
    assert cosine(heard, moved) > {"NH": 0.97, "N1": 0.9, "N3": 0.75, "N5": 0.6}[name]
    assert cosine(heard, moved) > cosine(heard, loud) + 0.1


def test_normal_speech_gets_the_phase_of_the_impaired_bank(utterance: Tensor) -> None:
    normal = MSBG(Audiogram.standard("NH"), sample_rate=16000)(utterance)
    for name in EARS[1:]:
        moved = with_phase_of_bank(normal, thresholds(name), 16000, normal=True)
        assert cosine(moved, with_phase_of_bank(utterance, thresholds(name), 16000)) > 0.97
    assert torch.equal(with_phase_of_bank(normal, thresholds("NH"), 16000, normal=True), normal)


@pytest.mark.parametrize("rate", [16000, 44100])
def test_magnitude_stays(rate: int) -> None:
    noise = torch.randn(1, rate, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise[:, : rate // 4] = noise[:, -rate // 4 :] = 0.0
    for name in EARS:
        moved = with_phase_of_bank(noise, thresholds(name), rate)
        before, after = (torch.fft.rfft(signal).abs()[0, 150:7500] for signal in (noise, moved))
        assert float((after - before).norm() / before.norm()) < 0.02


def test_each_item_by_its_own_ear(utterance: Tensor) -> None:
    ears = torch.cat([thresholds(name) for name in EARS])
    together = with_phase_of_bank(utterance.expand(4, -1), ears, 16000)
    alone = torch.cat([with_phase_of_bank(utterance, ear[None], 16000) for ear in ears])
    torch.testing.assert_close(together, alone)
    assert cosine(together[0], together[2]) < 0.9
