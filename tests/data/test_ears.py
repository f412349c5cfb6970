"""Random ears have the variety of measured ones."""

import torch

from hlsim.audiogram import severity_index
from hlsim.data.ears import draw_thresholds


def test_drawn_ears_look_like_measured_ones() -> None:
    ears, again = (draw_thresholds(20000, torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(ears, again)
    assert ears.shape == (20000, 8)
    assert float(ears.min()) >= -10.0 and float(ears.max()) <= 100.0
    shares = torch.bincount(severity_index(ears), minlength=4) / len(ears)
    # the docstring's: 27, 18, 19 and 36 %
    torch.testing.assert_close(shares, torch.tensor([0.27, 0.18, 0.19, 0.36]), atol=0.015, rtol=0)
    rounded = (ears % 5.0 == 0.0).all(-1).float().mean()
    assert 0.73 < float(rounded) < 0.77
    # high-frequency losses are the rule
    assert float((ears[:, -2] > ears[:, 0]).float().mean()) > 0.7
    neighbours = torch.corrcoef(ears.T).diagonal(1)
    assert float(neighbours.min()) > 0.85
    assert float((ears[:, 5] - ears[:, 4]).abs().median()) < 10.0
