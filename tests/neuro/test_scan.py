"""The selective scan equals the recurrence, computed step by step in float64."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.neuro.family import scan
from hlsim.neuro.family.scan import selective_scan

NAMES = ("u", "delta", "A", "B", "C", "D", "z", "delta_bias")


def recurrence(
    u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor, D: Tensor, z: Tensor, bias: Tensor
) -> Tensor:
    delta = functional.softplus(delta + bias[:, None])
    state = torch.zeros(*u.shape[:2], A.shape[1], dtype=u.dtype)
    outputs = []
    for t in range(u.shape[2]):
        step = delta[:, :, t, None]
        state = torch.exp(step * A) * state + step * B[:, None, :, t] * u[:, :, t, None]
        outputs.append((state * C[:, None, :, t]).sum(-1))
    return (torch.stack(outputs, -1) + D[:, None] * u) * functional.silu(z)


def arguments(time: int, items: int = 3, channels: int = 5, states: int = 4) -> list[Tensor]:
    generator = torch.Generator().manual_seed(time)
    signal = (items, channels, time)
    weights = (items, states, time)
    shapes = [
        signal,
        signal,
        (channels, states),
        weights,
        weights,
        (channels,),
        signal,
        (channels,),
    ]
    tensors = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in shapes]
    tensors[2] = -3.0 * tensors[2].abs()
    return tensors


@pytest.mark.parametrize("time", [1, 2, 3, 4, 5, 31, 64, 101])
@pytest.mark.parametrize("states", [1, 2**19], ids=["in parts", "at once"])
def test_scan_and_gradients_equal_those_of_the_recurrence(
    time: int, states: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "_STATES_AT_ONCE_CPU", states)
    inputs = [tensor.requires_grad_() for tensor in arguments(time)]
    output = selective_scan(*inputs)
    expected = recurrence(*inputs)
    torch.testing.assert_close(output, expected, rtol=1e-10, atol=1e-10)
    direction = torch.randn_like(expected)
    gradients = torch.autograd.grad(output, inputs, direction)
    expected_gradients = torch.autograd.grad(expected, inputs, direction)
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["u", "delta", "A", "B", "C"])
def test_a_second_derivative_by_any_input_raises_runtime_error(name: str) -> None:
    inputs = [tensor.requires_grad_() for tensor in arguments(7, 2, 2, 3)]
    energy = selective_scan(*inputs).square().sum()
    for slope in torch.autograd.grad(energy, inputs[:5], create_graph=True):
        with pytest.raises(RuntimeError):
            torch.autograd.grad(slope.sum(), inputs[NAMES.index(name)], retain_graph=True)


@pytest.mark.parametrize("decay", [1e-30, 1.0])
def test_scan_does_not_overflow_for_extreme_decays(decay: float) -> None:
    inputs = arguments(4096, 1, 1, 1)
    inputs[2] = torch.tensor([[decay]], dtype=torch.float64).log()
    single = selective_scan(*(tensor.float() for tensor in inputs))
    torch.testing.assert_close(single, selective_scan(*inputs).float(), rtol=1e-3, atol=1e-3)


def test_gradients_are_computed_in_float32_under_autocast() -> None:
    inputs = [tensor.float().requires_grad_() for tensor in arguments(33)]
    energy = selective_scan(*inputs).square().sum()
    expected = torch.autograd.grad(energy, inputs, retain_graph=True)
    with torch.autocast("cpu", torch.bfloat16):
        gradients = torch.autograd.grad(energy, inputs)
    torch.testing.assert_close(gradients, expected, rtol=0, atol=0)


def test_a_kernel_receives_all_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def kernel(*inputs: Tensor, **options: Any) -> Tensor:
        calls.append(dict(zip(NAMES, inputs, strict=False)) | options)
        return 0.5 * inputs[0]

    monkeypatch.setattr(scan, "_kernel_for", lambda u: kernel)
    inputs = arguments(9)
    assert torch.equal(selective_scan(*inputs), 0.5 * inputs[0])
    (call,) = calls
    assert call.pop("delta_softplus") is True
    assert all(call[name] is tensor for name, tensor in zip(NAMES, inputs, strict=True))
