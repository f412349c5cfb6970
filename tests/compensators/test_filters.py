"""Filters of minimum phase, and a signal through filters that change."""

import numpy as np
import torch
from scipy import signal as scipy_signal

from compensators.bands import DELAY, GLIDE, HISTORY, HOP
from compensators.filters import TAPS, apply_filters, filter_taps


def test_taps_are_the_response_of_filters_of_minimum_phase() -> None:
    """Poles and zeros inside the circle: the gains alone give the whole response."""
    for b, a in (([1.0, -0.3, 0.1], [1.0, -0.8, 0.3]), ([2.0, -1.2, 0.6], [1.0, -0.5, 0.6])):
        _, response = scipy_signal.freqz(b, a, np.linspace(0.0, np.pi, 257))
        gains_db = torch.from_numpy(20.0 * np.log10(np.abs(response)))
        impulse = np.eye(1, TAPS)[0]
        truth = scipy_signal.lfilter(b, a, impulse)
        assert np.abs(filter_taps(gains_db).numpy() + impulse - truth).max() < 1e-6
        single = filter_taps(gains_db.float()).numpy() + impulse
        assert np.abs(single - truth).max() < 1e-5


def test_zeros_lie_inside_and_gains_are_as_asked() -> None:
    steps = torch.randn(40, dtype=torch.float64).cumsum(0)
    smooth = torch.nn.functional.interpolate(steps[None, None], 257, mode="linear", align_corners=True)[0, 0]
    gains_db = (3.0 * smooth).clamp(-18.0, 45.0)
    taps = filter_taps(gains_db).numpy() + np.eye(1, TAPS)[0]
    found = 20.0 * np.log10(np.abs(np.fft.rfft(taps, 512)))
    assert np.abs(found - gains_db.numpy()).max() < 1.0 and np.abs(found - gains_db.numpy()).mean() < 0.1
    assert np.abs(np.roots(taps)).max() < 1.05


def test_gains_of_0_db_are_no_filter_to_the_bit() -> None:
    assert torch.equal(filter_taps(torch.zeros(3, 257)), torch.zeros(3, TAPS))
    padded = torch.randn(1, HISTORY + 5 * HOP)
    assert torch.equal(apply_filters(padded, torch.zeros(1, 6, TAPS)), padded[:, HISTORY - DELAY : -DELAY])


def test_a_signal_against_a_sum_in_float64() -> None:
    padded, taps = torch.randn(2, HISTORY + 3 * HOP), torch.randn(2, 4, TAPS)
    long, knots = padded.double().numpy(), taps.double().numpy()
    truth = np.zeros((2, 3 * HOP))
    for place in range(3 * HOP):
        own = min((place % HOP + 1) / GLIDE, 1.0)
        filters = (1.0 - own) * knots[:, place // HOP] + own * knots[:, place // HOP + 1]
        now = HISTORY + place - DELAY
        truth[:, place] = long[:, now] + (filters * long[:, now - TAPS + 1 : now + 1][:, ::-1]).sum(1)
    assert np.abs(apply_filters(padded, taps).numpy() - truth).max() < 2e-5 * np.abs(truth).max()


def test_what_comes_changes_nothing_before_to_the_bit() -> None:
    padded, taps = torch.randn(1, HISTORY + 3 * HOP), torch.randn(1, 4, TAPS)
    before = apply_filters(padded, taps)
    for place in range(0, 3 * HOP, 7):
        moved = padded.clone()
        moved[:, HISTORY + place :] = 0.0
        assert torch.equal(apply_filters(moved, taps)[:, : place + 1], before[:, : place + 1])
