"""Smoothing without loops against loops."""

import pytest
import torch

from compensators.smoothing import average, decay, follow_peaks


@pytest.mark.parametrize("past", [0.0, 0.3, 0.96])
def test_average_is_the_recursion(past: float) -> None:
    values, state = torch.randn(2, 300, 3), torch.randn(2, 3)
    found, kept = average(values, state, past), state
    for frame in range(300):
        kept = past * kept + (1.0 - past) * values[:, frame]
        assert (found[:, frame] - kept).abs().max() < 1e-5


@pytest.mark.parametrize(("attack", "release"), [(0.005, 0.1), (0.0, 0.01), (0.02, 0.5)])
def test_peaks_are_followed_as_giannoulis_says(attack: float, release: float) -> None:
    values = 60.0 * torch.rand(2, 700, 3)
    values[:, 200:400] = 0.0
    up, down = decay(attack), decay(release)
    found, state = follow_peaks(values, torch.zeros(2, 3, 3), up, down)
    peak = smooth = torch.zeros(2, 3)
    for frame in range(700):
        peak = torch.maximum(values[:, frame], down * peak + (1.0 - down) * values[:, frame])
        smooth = up * smooth + (1.0 - up) * peak
        assert (found[:, frame] - smooth).abs().max() < 1e-3
    # in two calls as in one
    first, between = follow_peaks(values[:, :333], torch.zeros(2, 3, 3), up, down)
    second, after = follow_peaks(values[:, 333:], between, up, down)
    assert (torch.cat((first, second), 1) - found).abs().max() < 1e-3 and (
        after - state
    ).abs().max() < 1e-3


def test_gradients_are_finite() -> None:
    values = torch.randn(1, 300, 2, requires_grad=True)
    found, _ = follow_peaks(values, torch.zeros(1, 3, 2), 0.5, decay(0.01))
    found.sum().backward()  # type: ignore[no-untyped-call]
    assert values.grad is not None and values.grad.isfinite().all()
