"""The division of frequency: filters that sum to a delay, levels, and gains that go from hop to hop."""

import numpy as np
import pytest
import torch

from compensators.filter_bank import (
    DELAY,
    FRAME,
    HISTORY,
    HOP,
    apply_gains,
    centres,
    filters,
    frame_power,
    level_db,
    shares,
    speech_levels,
)
from hlsim.calibration import set_level


@pytest.mark.parametrize("count", [4, 20, 40])
def test_filters_sum_to_a_delay(count: int) -> None:
    impulse = np.zeros(2 * DELAY + 1)
    impulse[DELAY] = 1.0
    assert np.abs(filters(count).sum(0) - impulse).max() < 1e-12
    assert np.allclose(filters(count), filters(count)[:, ::-1])  # linear phase
    assert np.allclose(shares(count, 512).sum(1), 1.0)
    spaces = np.diff(centres(count))
    assert centres(count)[0] == 0.0 and centres(count)[-1] == pytest.approx(8000.0, abs=1.0)
    assert (spaces[:-1] > 124.9).all()


def test_levels_are_in_db_spl() -> None:
    time = torch.arange(16000) / 16000.0
    for hertz in (250.0, 1000.0, 3001.0):
        tone = set_level(torch.sin(2.0 * torch.pi * hertz * time), 65.0)
        powers = frame_power(tone[None, : HISTORY + 200 * HOP])
        assert (level_db(powers.sum(-1)) - 65.0).abs().max() < 0.3
        bands = level_db(powers @ torch.tensor(shares(20, FRAME), dtype=torch.float32)).mean((0, 1))
        assert abs(centres(20)[int(bands.argmax())] - hertz) < 260.0
    noise = set_level(torch.randn(1, HISTORY + 400 * HOP), 50.0)
    assert abs(float(level_db(frame_power(noise).sum(-1).mean())) - 50.0) < 0.3
    assert float(level_db(torch.zeros(1))) == pytest.approx(0.0, abs=1e-4)


def test_average_speech_has_its_level_and_falls_with_frequency() -> None:
    levels = torch.tensor(speech_levels(20))
    assert float(10.0 * torch.log10((10.0 ** (levels / 10.0)).sum())) == pytest.approx(
        65.0, abs=1e-4
    )
    assert float(levels.argmax()) in (1, 2, 3, 4) and float(levels.max() - levels[-2]) > 15.0


def test_gains_against_a_sum_in_float64() -> None:
    signal, gains = torch.randn(2, 2 * DELAY + 3 * HOP), torch.randn(2, 4, 20)
    bands = np.stack(
        [[np.convolve(item, taps, "valid") for taps in filters(20)] for item in signal.numpy()]
    )
    place = (np.arange(3 * HOP) + 1) / HOP
    knots = gains.double().numpy()
    paths = np.stack([[np.interp(place, np.arange(4), band) for band in item.T] for item in knots])
    truth = signal[:, DELAY : DELAY + 3 * HOP].numpy() + (bands * paths).sum(1)
    assert np.abs(apply_gains(signal, gains).numpy() - truth).max() < 1e-5
    # from the tenth sample of a hop on
    part = apply_gains(signal[:, 10 : 2 * DELAY + 40], gains[:, :2], 10)
    assert np.abs(part.numpy() - truth[:, 10:40]).max() < 1e-5


def test_gains_of_1_change_nothing() -> None:
    signal = torch.randn(1, 2 * DELAY + 5 * HOP)
    assert torch.equal(apply_gains(signal, torch.zeros(1, 6, 20)), signal[:, DELAY:-DELAY])
