"""Signals of nearly equal lengths are cut to the shorter one, and others are rejected."""

import pytest
import torch

from hlsim.metrics import haspi, mbstoi


def test_signals_of_nearly_equal_lengths_are_cut() -> None:
    clean = 0.03 * torch.randn(2, 13000) * torch.sin(torch.arange(13000) / 600.0)
    output = 0.8 * clean + 0.01 * torch.randn(2, 13000)
    expected = haspi(output[:, :12000], clean[:, :12000], "N3", lengths=[12000, 11500])
    with pytest.warns(UserWarning, match="output has 12000 samples and clean 13000; both are cut"):
        scores = haspi(output[:, :12000], clean, "N3", lengths=[13000, 11500])
    assert torch.equal(scores, expected)
    with pytest.warns(UserWarning, match="cut to the shorter length"):
        score = mbstoi(output, clean[:, :12000])
    assert torch.equal(score, mbstoi(output[:, :12000], clean[:, :12000]))
    with pytest.raises(ValueError, match=r"differ by 0\.1 s at most"):
        haspi(torch.cat((output, clean), -1), clean, "N3")
