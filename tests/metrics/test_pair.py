"""Lengths that differ, and NumPy arrays in place of tensors."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from hlsim.metrics import HaspiReference, HasqiReference, haaqi, haspi, hasqi, mbstoi
from tests.helpers import mostly_slow


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


@pytest.mark.parametrize("score", mostly_slow([haspi, hasqi, haaqi], [haspi]))
def test_scores_of_arrays_are_arrays(score: Callable[..., Any]) -> None:
    clean = 0.02 * torch.randn(2, 11200)
    output = 0.5 * clean
    expected = score(output, clean, "N3")
    scores = score(output.numpy(), clean.numpy(), "N3")
    assert isinstance(scores, np.ndarray) and scores.dtype == np.float32
    assert scores.tolist() == expected.tolist()
    of_one_item = score(output[0].numpy(), clean[0], "N3")
    assert isinstance(of_one_item, np.float32)
    assert float(of_one_item) == pytest.approx(float(expected[0]), abs=1e-6)
    with pytest.raises(ValueError, match="divide 16-bit samples by 32768"):
        score(output.short().numpy(), clean, "N3")


def test_mbstoi_and_prepared_references_take_arrays() -> None:
    clean = 0.02 * torch.randn(2, 12000)
    output = (0.5 * clean).numpy()
    assert mbstoi(output, clean) == mbstoi(0.5 * clean, clean).item()
    left, left_output = clean[:1], output[:1]
    haspi_of = HaspiReference(left.numpy())
    assert haspi_of.score(left_output, "N3").tolist() == haspi(0.5 * left, left, "N3").tolist()
    hasqi_of = HasqiReference(left.numpy(), "N3")
    assert hasqi_of.score(left_output).tolist() == hasqi_of.parts(left_output).combined.tolist()
