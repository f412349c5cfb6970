"""Filters that sum to a delay, levels of bands, gains between hops, and smoothing without loops."""

import numpy as np
import pytest
import torch

from compensators.filter_bank import (
    DELAY,
    HISTORY,
    HOP,
    _filter_shares,
    _filter_taps,
    apply_gains,
    filter_centres,
    filter_powers,
    frame_power,
    level_db,
)
from compensators.smoothing import follow_peaks, weight_of_past
from hlsim.calibration import set_level
from tests.compensators.aids import tone


@pytest.mark.parametrize("count", [4, 20, 40])
def test_filters_sum_to_a_delay(count: int) -> None:
    impulse = np.zeros(2 * DELAY + 1)
    impulse[DELAY] = 1.0
    assert np.abs(_filter_taps(count).sum(0) - impulse).max() < 1e-12
    assert np.allclose(_filter_taps(count), _filter_taps(count)[:, ::-1])  # linear phase
    assert np.allclose(_filter_shares(count, 512).sum(1), 1.0)
    assert filter_centres(count)[0] == 0.0
    assert filter_centres(count)[-1] == pytest.approx(8000.0, abs=1.0)
    assert (np.diff(filter_centres(count))[:-1] > 124.9).all()


def test_levels_are_in_db_spl() -> None:
    for hertz in (250.0, 1000.0, 3001.0):
        powers = frame_power(tone(hertz, 65.0)[None, : HISTORY + 200 * HOP])
        assert (level_db(powers.sum(-1)) - 65.0).abs().max() < 0.3
        bands = level_db(filter_powers(powers, 20)).mean((0, 1))
        assert abs(filter_centres(20)[int(bands.argmax())] - hertz) < 260.0
    noise = set_level(torch.randn(1, HISTORY + 400 * HOP), 50.0)
    assert float(level_db(frame_power(noise).sum(-1).mean())) == pytest.approx(50.0, abs=0.3)
    assert float(level_db(torch.zeros(1))) == pytest.approx(0.0, abs=1e-4)


def test_gains_equal_a_sum_in_float64() -> None:
    signal, gains = torch.randn(2, 2 * DELAY + 3 * HOP), torch.randn(2, 4, 20)
    time = (np.arange(3 * HOP) + 1) / HOP
    expected = signal[:, DELAY : DELAY + 3 * HOP].double().numpy()
    for band, taps in enumerate(_filter_taps(20)):
        for item in range(2):
            path = np.interp(time, np.arange(4), gains[item, :, band].double().numpy())
            expected[item] += np.convolve(signal[item].double().numpy(), taps, "valid") * path
    assert np.abs(apply_gains(signal, gains).numpy() - expected).max() < 1e-5
    part = apply_gains(signal[:, 10 : 2 * DELAY + 40], gains[:, :2], 10)  # from sample 10 of a hop
    assert np.abs(part.numpy() - expected[:, 10:40]).max() < 1e-5


@pytest.mark.parametrize(("attack", "release"), [(0.005, 0.1), (0.0, 0.01), (0.02, 0.5)])
def test_the_peak_follower_equals_the_recursion_of_giannoulis(
    attack: float, release: float
) -> None:
    values = 60.0 * torch.rand(2, 700, 3)
    values[:, 200:400] = 0.0
    values.requires_grad_()
    up, down = weight_of_past(attack), weight_of_past(release)
    levels, state = follow_peaks(values, torch.zeros(2, 3, 3), attack, release)
    peak = smooth = torch.zeros(2, 3)
    for frame in range(700):
        peak = torch.maximum(values[:, frame], down * peak + (1.0 - down) * values[:, frame])
        smooth = up * smooth + (1.0 - up) * peak
        assert (levels[:, frame] - smooth).abs().max() < 1e-3
    first, between = follow_peaks(values[:, :333], torch.zeros(2, 3, 3), attack, release)
    second, last = follow_peaks(values[:, 333:], between, attack, release)
    assert (torch.cat((first, second), 1) - levels).abs().max() < 1e-3
    assert (last - state).abs().max() < 1e-3
    (gradient,) = torch.autograd.grad(levels.sum(), values)
    assert gradient.isfinite().all()
