"""Signals of nearly equal lengths are cut to the shorter one, and others are rejected."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from hlsim import Audiogram
from hlsim.metrics import haspi, hasqi, mbstoi

N3 = Audiogram.standard("N3")


def score_two_ears(processed: Tensor, clean: Tensor, lengths: list[int] | None = None) -> Tensor:
    return mbstoi(processed.expand(2, -1), clean.expand(2, -1))


SCORES: dict[str, Callable[..., Tensor]] = {
    "haspi": partial(haspi, audiogram=N3),
    "hasqi": partial(hasqi, audiogram=N3),
    "mbstoi": score_two_ears,
}


@pytest.fixture
def clean() -> Tensor:
    return 0.03 * torch.randn(13000) * torch.sin(torch.arange(13000) / 600.0)


@pytest.mark.parametrize("name", SCORES)
def test_signals_of_nearly_equal_lengths_are_cut(clean: Tensor, name: str) -> None:
    score = SCORES[name]
    processed = 0.8 * clean + 0.01 * torch.randn(13000)
    expected = score(processed[:12000], clean[:12000])
    with pytest.warns(UserWarning, match="processed has 12000 samples and clean 13000"):
        assert torch.equal(score(processed[:12000], clean), expected)
    with pytest.warns(UserWarning, match="cut to the shorter length"):
        assert torch.equal(score(processed, clean[:12000]), expected)
    with pytest.raises(ValueError, match=r"differ by 0\.1 s at most"):
        score(torch.cat((processed, clean)), clean)


def test_lengths_of_items_are_limited_to_the_common_length(clean: Tensor) -> None:
    batch = torch.stack((clean, clean.roll(99)))
    with pytest.warns(UserWarning):
        scores = haspi(0.5 * batch[:, :12000], batch, N3, lengths=[13000, 11500])
    expected = haspi(0.5 * batch[:, :12000], batch[:, :12000], N3, lengths=[12000, 11500])
    assert torch.equal(scores, expected)
