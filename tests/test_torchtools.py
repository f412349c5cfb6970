"""Constants are computed once for each type and device, and serve under any mode of torch."""

from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import grad

from hlsim import MSBG, torchtools
from hlsim.msbg.filter_bank import BANKS
from hlsim.msbg.multirate import multirate_bank
from hlsim.torchtools import constant

CPU = torch.device("cpu")


def test_constant_is_designed_once_for_each_type_and_device() -> None:
    calls = []

    @constant
    def make(count: int) -> list[int]:
        calls.append(count)
        return [1] * count

    single, double = torch.zeros(1), torch.zeros(1).double()
    first = make(3, like=single)
    assert make(3, like=single) is first
    assert first.tolist() == [1.0] * 3
    assert make(3, like=double).dtype == torch.float64
    assert make(4, like=single).shape == (4,)
    assert make(3, like=torch.zeros(1, device="meta")).is_meta
    assert calls == [3, 3, 4, 3]
    assert make(2) == [1, 1]


class SmallStore:
    """A store for 4 MiB, which is empty before each test."""

    limit = 4 * 2**20

    def __init__(self) -> None:
        self.results: OrderedDict[Any, Any] = OrderedDict()

    @property
    def nbytes(self) -> int:
        return torchtools._count_bytes([*self.results.values()])


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> SmallStore:
    store = SmallStore()
    monkeypatch.setattr(torchtools, "STORE_BYTES", store.limit)
    monkeypatch.setattr(torchtools, "_RESULTS", store.results)
    return store


def test_complex_constants_and_those_like_a_tensor() -> None:
    @constant
    def make(count: int) -> np.ndarray:
        return 1j * np.arange(count)[::-1]

    for dtype, expected in ((torch.float32, torch.complex64), (torch.float64, torch.complex128)):
        tensor = make(3, like=torch.ones(1, dtype=dtype))
        assert tensor.dtype == expected and tensor.is_contiguous()
        assert tensor.imag.tolist() == [2.0, 1.0, 0.0]
        assert make(3, like=torch.ones(1, dtype=expected)) is tensor


def test_arrays_in_dicts_and_objects_count_in_the_store() -> None:
    values = {"taps": np.zeros(3), "layer": torch.nn.Linear(2, 1, bias=False)}
    assert torchtools._count_bytes(values) == 3 * 8 + 2 * 4


def test_memory_does_not_grow_with_the_number_of_lengths(small: SmallStore) -> None:
    model = MSBG("N3")
    signals = [0.01 * torch.ones(1, 3000 + 2000 * n) for n in range(8)]
    first = [model(signal) for signal in signals]
    assert small.nbytes <= small.limit
    for signal, expected in zip(signals, first, strict=True):  # the early ones are made again
        assert torch.equal(model(signal), expected)
    assert small.nbytes <= small.limit


def test_one_that_is_too_large_is_held_all_the_same(small: SmallStore) -> None:
    arguments = (BANKS["severe"], 24 * 4000, 1, 22050.0, torch.float32, CPU)
    bank = multirate_bank(*arguments)
    assert multirate_bank(*arguments) is bank and small.nbytes > small.limit
    constant(np.arange)(4410, like=torch.zeros(1))
    assert small.nbytes <= small.limit


def test_constants_of_inference_mode_or_a_transform_serve_gradients_later(
    small: SmallStore,
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


def test_no_arguments_have_no_results() -> None:
    assert torchtools.map_on_cores(abs, [], torch.zeros(1)) == []


class Double(torchtools.DifferentiableFunction):
    """Multiplies by 2, and counts how often torch prepares a backward pass."""

    preparations = 0

    @staticmethod
    def forward(values: Tensor) -> Tensor:
        return 2.0 * values

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        Double.preparations += 1

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return 2.0 * gradient


def test_functions_prepare_a_backward_pass_only_where_gradients_are_enabled() -> None:
    leaf = torch.ones(2, requires_grad=True)
    with torch.no_grad():
        assert Double.call(leaf).tolist() == [2.0, 2.0]
    with torch.inference_mode():
        assert Double.call(leaf).tolist() == [2.0, 2.0]
    assert Double.preparations == 0
    Double.call(leaf).sum().backward()
    assert Double.preparations == 1
    assert leaf.grad is not None and leaf.grad.tolist() == [2.0, 2.0]
    assert grad(lambda values: Double.call(values).sum())(torch.ones(2)).tolist() == [2.0, 2.0]


def test_masked_samples_are_an_error() -> None:
    samples = np.ma.masked_greater(np.array([0.1, 9.0]), 1.0)
    with pytest.raises(ValueError, match=r"without a mask; .* x\.filled"):
        torchtools.as_samples(samples)
    assert torchtools.as_samples(samples.filled(0.0)).tolist() == [0.1, 0.0]
