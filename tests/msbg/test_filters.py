"""The cache of filters: one a key, the same again, and no more memory than it may take."""

import pytest
import torch
from torch import Tensor
from torch.func import grad

from hlsim import MSBG, Audiogram
from hlsim.msbg import filters
from hlsim.msbg.filters import Filters, _Cache
from hlsim.msbg.smearing import _window


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> _Cache:
    cache = _Cache(4 * 2**20)
    monkeypatch.setattr(filters, "_KNOWN", cache)
    return cache


def test_the_same_filter_is_made_once() -> None:
    own = Filters(torch.float32, torch.device("cpu"))
    key = ("forward", 4410, 2206, 1.0, 44100)
    assert own.get(*key) is own.get(*key)
    assert own.get(*key) is not own.get("forward", 8820, 4411, 1.0, 44100)
    double = Filters(torch.float64, torch.device("cpu")).get(*key)
    assert double.dtype == torch.complex128 and own.get(*key).dtype == torch.complex64


def test_memory_does_not_grow_with_the_number_of_lengths(small: _Cache) -> None:
    model = MSBG(Audiogram.standard("N3"), sample_rate=16000)
    signals = [0.01 * torch.ones(1, 3000 + 2000 * n) for n in range(8)]
    first = [model(signal) for signal in signals]
    assert small.held <= small.limit
    for signal, expected in zip(signals, first, strict=True):  # the early ones are made again
        assert torch.equal(model(signal), expected)
    assert small.held <= small.limit


def test_one_filter_that_is_too_long_is_held_all_the_same(small: _Cache) -> None:
    own = Filters(torch.float32, torch.device("cpu"))
    plan = own.get("plan", "severe", 24 * 4000, 1, 22050.0)
    assert own.get("plan", "severe", 24 * 4000, 1, 22050.0) is plan and small.held > small.limit
    own.get("forward", 4410, 2206, 1.0, 44100)
    assert small.held <= small.limit


def test_what_a_transform_makes_serves_after_it(small: _Cache) -> None:
    _window.cache_clear()
    model = MSBG(Audiogram.standard("N3"), sample_rate=16000)
    wave, gain = 0.03 * torch.randn(1, 1200), torch.tensor(1.0)

    def energy(factor: Tensor) -> Tensor:
        return model(wave * factor).square().sum()

    second = grad(grad(energy))(gain)
    assert torch.equal(grad(grad(energy))(gain), second)
    leaf = gain.clone().requires_grad_()
    torch.testing.assert_close(grad(energy)(gain), torch.autograd.grad(energy(leaf), leaf)[0])
