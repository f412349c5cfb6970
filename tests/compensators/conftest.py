"""Speech for all tests of aids."""

import pytest
import torch

from hlsim.calibration import set_level
from hlsim.dsp.resample import resample


@pytest.fixture
def utterance(speech: list[tuple[torch.Tensor, int]]) -> torch.Tensor:
    """Speech of 1.5 s at 65 dB SPL. Shape: (time,) at 16 kHz."""
    waveform, rate = speech[0]
    return set_level(resample(waveform, rate, 16000)[0, 8000:32000], 65.0)
