"""Signals of nearly equal lengths are cut to the shorter one, and others are rejected."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim.metrics import haspi, hasqi, mbstoi


def score_two_ears(processed: Tensor, clean: Tensor, **settings: Any) -> Tensor:
    return mbstoi(
        torch.stack((processed, processed), -2), torch.stack((clean, clean), -2), **settings
    )


SCORES = [partial(haspi, audiogram="N3"), partial(hasqi, audiogram="N3"), score_two_ears]


@pytest.fixture
def clean() -> Tensor:
    return 0.03 * torch.randn(13000) * torch.sin(torch.arange(13000) / 600.0)


@pytest.mark.parametrize("score", SCORES)
def test_signals_of_nearly_equal_lengths_are_cut(
    clean: Tensor, score: Callable[..., Tensor]
) -> None:
    processed = 0.8 * clean + 0.01 * torch.randn(13000)
    expected = score(processed[:12000], clean[:12000])
    with pytest.warns(UserWarning, match="processed has 12000 samples and clean 13000"):
        assert torch.equal(score(processed[:12000], clean), expected)
    with pytest.warns(UserWarning, match="cut to the shorter length"):
        assert torch.equal(score(processed, clean[:12000]), expected)
    with pytest.raises(ValueError, match=r"differ by 0\.1 s at most"):
        score(torch.cat((processed, clean)), clean)


@pytest.mark.parametrize("score", SCORES[:2])
def test_lengths_of_items_are_limited_to_the_common_length(
    clean: Tensor, score: Callable[..., Tensor]
) -> None:
    batch = torch.stack((clean, clean.roll(99)))
    with pytest.warns(UserWarning):
        scores = score(0.5 * batch[:, :12000], batch, lengths=[13000, 11500])
    expected = score(0.5 * batch[:, :12000], batch[:, :12000], lengths=[12000, 11500])
    assert torch.equal(scores, expected)
