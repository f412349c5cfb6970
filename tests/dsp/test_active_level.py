"""The active speech level has known values, obeys laws and is close to pyclarity's."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim.calibration import dbfs
from hlsim.dsp.active_level import active_level_db

Speech = list[tuple[Tensor, int]]


@pytest.mark.parametrize("rate", [16000, 48000])
def test_a_steady_tone_is_active_throughout(rate: int) -> None:
    tone = torch.sin(2 * torch.pi * 400 * torch.arange(4 * rate) / rate)
    assert active_level_db(tone, rate) == pytest.approx(10 * math.log10(0.5), abs=0.05)


def test_a_gain_changes_the_level_and_silence_hardly_does(speech: Speech) -> None:
    for waveform, rate in speech:
        level = active_level_db(waveform[0], rate)
        for gain in (1e-3, 20.0):
            louder = active_level_db(gain * waveform[0].double(), rate)
            assert louder - level == pytest.approx(20 * math.log10(gain), abs=1e-6)
        assert float(dbfs(waveform[0])) <= level
        padded = torch.cat((torch.zeros(2 * rate), waveform[0], torch.zeros(3 * rate)))
        assert active_level_db(padded, rate) == pytest.approx(level, abs=0.3)


def test_level_is_close_to_pyclaritys(speech: Speech) -> None:
    """pyclarity counts frames within 12 dB of the mean level, and so fewer soft frames."""
    utils = pytest.importorskip("clarity.evaluator.msbg.msbg_utils")
    for waveform, rate in speech:
        theirs = utils.measure_rms(waveform[0].double().numpy(), rate, -12)[0]
        difference = 20 * math.log10(theirs) - active_level_db(waveform[0], rate)
        assert -0.5 < difference < 1.5


def test_silence_is_rejected() -> None:
    for waveform in (np.zeros(100), np.zeros(0)):
        with pytest.raises(ValueError):
            active_level_db(waveform, 16000)
