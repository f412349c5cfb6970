"""The division of frequency, levels, and gains of bands at single frequencies."""

import numpy as np
import pytest
import torch

from compensators.bands import (
    DELAY,
    FRAME,
    HISTORY,
    HOP,
    LONG_FRAME,
    centres,
    frame_power,
    gain_at_rate,
    level_db,
    shares,
    speech_levels,
    spread,
)
from hlsim.calibration import set_level


@pytest.mark.parametrize("count", [4, 20, 40])
def test_bands_share_each_frequency(count: int) -> None:
    assert np.allclose(shares(count, 512).sum(1), 1.0)
    spaces = np.diff(centres(count))
    assert centres(count)[0] == 0.0 and centres(count)[-1] == pytest.approx(8000.0, abs=1.0)
    assert (spaces[:-1] > 124.9).all()
    gains = spread(torch.stack((torch.zeros(count), torch.full((count,), 12.0))))
    assert torch.equal(gains[0], torch.zeros(257)) and (gains[1] - 12.0).abs().max() < 1e-4
    # a filter of 8 ms with that gain is its own response: nothing of it lies later
    response = 10.0 ** (spread(20.0 * torch.eye(count)[2].double()) / 20.0)
    taps = np.fft.irfft(response.numpy(), LONG_FRAME)
    assert np.abs(taps[65:-64]).max() < 1e-12
    assert np.abs(response.numpy() - (1.0 + 9.0 * shares(count, LONG_FRAME)[:, 2])).mean() < 0.2


def test_levels_are_in_db_spl() -> None:
    time = torch.arange(16000) / 16000.0
    for hertz in (250.0, 1000.0, 3001.0):
        tone = set_level(torch.sin(2.0 * torch.pi * hertz * time), 65.0)
        powers, fine = (
            frame_power(tone[None, : HISTORY + 200 * HOP], points) for points in (FRAME, LONG_FRAME)
        )
        for some in (powers, fine):
            assert some.shape[1] == 200 and (level_db(some.sum(-1)) - 65.0).abs().max() < 0.3
        assert abs(31.25 * int(fine.mean((0, 1)).argmax()) - hertz) < 16.0
        bands = level_db(powers @ torch.tensor(shares(20, FRAME), dtype=torch.float32)).mean((0, 1))
        assert abs(centres(20)[int(bands.argmax())] - hertz) < 260.0
    noise = set_level(torch.randn(1, HISTORY + 400 * HOP), 50.0)
    assert abs(float(level_db(frame_power(noise, FRAME).sum(-1).mean())) - 50.0) < 0.3
    assert float(level_db(torch.zeros(1))) == pytest.approx(0.0, abs=1e-4)


def test_average_speech_has_its_level_and_falls_with_frequency() -> None:
    levels = torch.tensor(speech_levels(20))
    assert float(10.0 * torch.log10((10.0 ** (levels / 10.0)).sum())) == pytest.approx(65.0, abs=1e-4)
    assert float(levels.argmax()) in (1, 2, 3, 4) and float(levels.max() - levels[-2]) > 15.0


def test_gains_of_a_frequency_at_another_rate() -> None:
    """They begin when a frame has ended, 79 samples before it in the aligned output, and take 2 ms."""
    gains = torch.tensor([[3.0, 5.0, 5.0, 1.0, 1.0]])
    found = gain_at_rate(gains, 16000, 200)[0]
    assert found[HOP - DELAY + 31 :][0] == 3.0 and found[2 * HOP - DELAY] > 3.0
    assert found[2 * HOP - DELAY - 1] == 3.0 and (found[2 * HOP - DELAY + 31 : 4 * HOP - DELAY] == 5.0).all()
    assert torch.allclose(gain_at_rate(gains, 48000, 600)[0, ::3], found, atol=1e-5)
