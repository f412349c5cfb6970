"""Constants are computed once for each type and device, and serve under any mode of torch."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import grad

from hlsim import MSBG, torchtools
from hlsim.msbg.filterbank import BANKS
from hlsim.msbg.multirate import multirate_bank
from hlsim.torchtools import compute_once, constant, constant_like

CPU = torch.device("cpu")


def test_compute_once_for_each_type_and_device() -> None:
    calls = []

    def make(count: int) -> list[int]:
        calls.append(count)
        return [1] * count

    first = constant(make, 3, dtype=torch.float32, device=CPU)
    assert constant(make, 3, dtype=torch.float32, device=CPU) is first
    assert first.tolist() == [1.0] * 3
    assert constant(make, 3, dtype=torch.float64, device=CPU).dtype == torch.float64
    assert constant(make, 4, dtype=torch.float32, device=CPU).shape == (4,)
    assert constant(make, 3, dtype=torch.float32, device=torch.device("meta")).is_meta
    assert calls == [3, 3, 4, 3]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> torchtools._Cache:
    cache = torchtools._Cache(4 * 2**20)
    monkeypatch.setattr(torchtools, "_CACHE", cache)
    return cache


def test_complex_constants_and_those_like_a_tensor() -> None:
    def make(count: int) -> np.ndarray:
        return 1j * np.arange(count)[::-1]

    for dtype, expected in ((torch.float32, torch.complex64), (torch.float64, torch.complex128)):
        tensor = constant(make, 3, dtype=dtype, device=CPU)
        assert tensor.dtype == expected and tensor.is_contiguous()
        assert tensor.imag.tolist() == [2.0, 1.0, 0.0]
        for like in (torch.ones(1, dtype=dtype), torch.ones(1, dtype=expected)):
            assert constant_like(like, make, 3) is tensor


def test_memory_does_not_grow_with_the_number_of_lengths(small: torchtools._Cache) -> None:
    model = MSBG("N3")
    signals = [0.01 * torch.ones(1, 3000 + 2000 * n) for n in range(8)]
    first = [model(signal) for signal in signals]
    assert small.nbytes <= small.limit
    for signal, expected in zip(signals, first, strict=True):  # the early ones are made again
        assert torch.equal(model(signal), expected)
    assert small.nbytes <= small.limit


def test_one_that_is_too_large_is_held_all_the_same(small: torchtools._Cache) -> None:
    key = (multirate_bank, BANKS["severe"], 24 * 4000, 1, 22050.0, torch.float32, CPU)
    bank = compute_once(*key)
    assert compute_once(*key) is bank and small.nbytes > small.limit
    constant(np.arange, 4410, dtype=torch.float32, device=CPU)
    assert small.nbytes <= small.limit


def test_constants_of_inference_mode_or_a_transform_serve_gradients_later(
    small: torchtools._Cache,
) -> None:
    model = MSBG("N3")
    wave, gain = 0.03 * torch.randn(1, 1200), torch.tensor(1.0)

    def energy(factor: Tensor) -> Tensor:
        return model(wave * factor).square().sum()

    with torch.inference_mode():
        model(wave)
    second = grad(grad(energy))(gain)
    assert torch.equal(grad(grad(energy))(gain), second)
    leaf = gain.clone().requires_grad_()
    torch.testing.assert_close(grad(energy)(gain), torch.autograd.grad(energy(leaf), leaf)[0])
