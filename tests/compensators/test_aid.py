"""The insertion gains that an aid reports are those of its prescription and of its output."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import NALR, WDRC, HearingAid, MappingCompensator, load_compensator
from compensators.filter_bank import speech_density
from hlsim import Listener
from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import set_level


@pytest.mark.parametrize("ear", ["N2", "N4", "S2"])
def test_compression_has_about_the_gains_of_nalr(ear: str) -> None:
    """The level of noise varies, and compression follows its peaks, which lowers the gain."""
    below = NALR().gains(ear, level=80.0) - WDRC().gains(ear)
    assert float(below.min()) > -0.5
    assert float(below.max()) < 2.5


def levels_in_thirds_of_octave(signal: Tensor) -> Tensor:
    """Measure the levels after the first second in dB. Shape: (64000,) -> (8,)."""
    powers = torch.fft.rfft(signal[16000:]).abs().square()
    hertz = torch.fft.rfftfreq(48000, 1.0 / 16000.0)[:, None]
    is_near = (hertz / torch.tensor(FREQUENCIES)).log2().abs() < 1.0 / 6.0
    return 10.0 * (powers @ is_near.float()).log10()


@pytest.mark.parametrize("name", ["wdrc", "hearing-aid", "compensator-general"])
@pytest.mark.parametrize("level", [50.0, 65.0])
def test_gains_are_those_of_the_output_for_other_noise(name: str, level: float) -> None:
    phases = 2.0 * np.pi * np.random.default_rng(1).random(32000)
    spectrum = np.concatenate([[0.0], np.sqrt(speech_density(64000)) * np.exp(1j * phases)])
    noise = set_level(torch.tensor(np.fft.irfft(spectrum)).float(), level)
    aid: Any = load_compensator(name)
    options = {"noise_reduction": 0.0} if name == "hearing-aid" else {}
    gains = levels_in_thirds_of_octave(aid(noise, "N3", **options))
    gains -= levels_in_thirds_of_octave(noise)
    assert float((aid.gains("N3", level) - gains).abs().max()) < 1.0


@pytest.mark.parametrize("name", ["wdrc", "hearing-aid"])
def test_linked_gains_of_any_number_of_ears(name: str) -> None:
    """Both ears of a pair get the same noise, so that linking changes nothing."""
    linked, alone = load_compensator(name, linked=True), load_compensator(name)
    for ears in ("N3", ["N2", "N3", "S2"], [Listener("N2", "N4")]):
        torch.testing.assert_close(linked.gains(ears), alone.gains(ears))


@pytest.mark.parametrize("kind", [NALR, WDRC, HearingAid, MappingCompensator])
def test_every_aid_takes_an_ear_first(kind: Any) -> None:
    aid = kind("N3").eval()
    torch.testing.assert_close(aid.gains(), aid.gains("N3"))
    waveform = torch.from_numpy(0.02 * np.random.default_rng(0).normal(size=2000)).float()
    torch.testing.assert_close(aid(waveform), aid(waveform, "N3"))


def test_gains_have_the_shape_of_the_ears_and_need_valid_ones() -> None:
    listener = Listener("N2", "N4")
    for aid in (NALR(), WDRC(), load_compensator("hearing-aid")):
        both = aid.gains([listener, listener])
        assert both.shape == (2, 2, 8)
        torch.testing.assert_close(both[0, 1], aid.gains("N4"))
        with pytest.raises(ValueError):
            aid.gains(None)
    with pytest.raises(ValueError):
        WDRC().gains("N3", 121.0)
