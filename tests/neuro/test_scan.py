"""The selective scan equals the recurrence, computed step by step in float64."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.neuro import scan
from hlsim.neuro.scan import selective_scan

LENGTHS = (1, 2, 3, 4, 5, 31, 64, 101)


def recurrence(u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    state = torch.zeros(*u.shape[:2], A.shape[1], dtype=u.dtype)
    outputs = []
    for t in range(u.shape[2]):
        step = delta[:, :, t, None]
        state = torch.exp(step * A) * state + step * B[:, None, :, t] * u[:, :, t, None]
        outputs.append((state * C[:, None, :, t]).sum(-1))
    return torch.stack(outputs, -1)


def arguments(time: int, items: int = 3, channels: int = 5, states: int = 4) -> list[Tensor]:
    generator = torch.Generator().manual_seed(time)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return [
        draw(items, channels, time),
        draw(items, channels, time).abs(),
        -3.0 * draw(channels, states).abs(),
        draw(items, states, time),
        draw(items, states, time),
    ]


@pytest.mark.parametrize("time", LENGTHS)
@pytest.mark.parametrize("block", [1, 2**19], ids=["in parts", "at once"])
def test_scan_and_gradients_equal_those_of_the_recurrence(
    time: int, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "_STATES_PER_BLOCK_CPU", block)
    inputs = [tensor.requires_grad_() for tensor in arguments(time, channels=20)]
    output = selective_scan(*inputs)
    expected = recurrence(*inputs)
    torch.testing.assert_close(output, expected, rtol=1e-10, atol=1e-10)
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(expected.shape, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad(output, inputs, direction)
    expected_gradients = torch.autograd.grad(expected, inputs, direction)
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("number", range(5))
def test_a_second_derivative_by_any_input_raises_runtime_error(number: int) -> None:
    inputs = [tensor.requires_grad_() for tensor in arguments(7, 2, 2, 3)]
    energy = selective_scan(*inputs).square().sum()
    for slope in torch.autograd.grad(energy, inputs, create_graph=True):
        with pytest.raises(RuntimeError):
            torch.autograd.grad(slope.sum(), inputs[number], retain_graph=True)


def test_skip_gate_bias_and_softplus() -> None:
    u, delta, A, B, C = arguments(9)
    D, bias, z = torch.randn(5).double(), torch.randn(5).double(), torch.randn_like(u)
    output = selective_scan(u, delta, A, B, C, D, z, bias, delta_softplus=True)
    step = functional.softplus(delta + bias[:, None])
    expected = (recurrence(u, step, A, B, C) + D[:, None] * u) * functional.silu(z)
    torch.testing.assert_close(output, expected, rtol=1e-10, atol=1e-10)


def test_scan_does_not_overflow_for_extreme_decays() -> None:
    ones = torch.ones(2, 1, 4096)
    decay_of_1e_30 = selective_scan(ones / 69.0, 69.0 * ones, -torch.ones(1, 1), ones, ones)
    torch.testing.assert_close(decay_of_1e_30, ones)
    cumulative_sum = selective_scan(ones, ones, torch.zeros(1, 1), ones, ones)
    torch.testing.assert_close(cumulative_sum, torch.arange(1.0, 4097.0).expand(2, 1, -1))


def test_autocast_has_no_effect_inside() -> None:
    inputs = [tensor.float().requires_grad_() for tensor in arguments(33)]
    expected = selective_scan(*inputs)
    expected_gradients = torch.autograd.grad(expected.square().sum(), inputs)
    with torch.autocast("cpu", torch.bfloat16):
        output = selective_scan(*inputs)
        gradients = torch.autograd.grad(output.square().sum(), inputs)
    assert torch.equal(output, expected)
    torch.testing.assert_close(gradients, expected_gradients, rtol=0, atol=0)


def test_bfloat16_inputs_are_scanned_in_float32() -> None:
    """A is in float32, and the other inputs have the network's precision, as in mamba_ssm."""
    u, delta, A, B, C = (tensor.float() for tensor in arguments(33))
    u, delta, B, C = (tensor.bfloat16() for tensor in (u, delta, B, C))
    output = selective_scan(u, delta, A, B, C)
    expected = selective_scan(u.float(), delta.float(), A, B.float(), C.float())
    assert output.dtype == torch.bfloat16 and torch.equal(output, expected.bfloat16())


def test_a_kernel_receives_all_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def kernel(*inputs: Tensor, **options: Any) -> Tensor:
        calls.append((inputs, options))
        return 0.5 * inputs[0]

    monkeypatch.setattr(scan, "_kernel_for", lambda u: kernel)
    inputs = arguments(9)
    u, D, bias = inputs[0], torch.randn(5).double(), torch.randn(5).double()
    output = selective_scan(*inputs, D, u, bias, delta_softplus=True)
    assert torch.equal(output, 0.5 * u)
    ((kernel_inputs, options),) = calls
    assert all(a is b for a, b in zip(kernel_inputs, inputs, strict=True))
    assert options == {"D": D, "z": u, "delta_bias": bias, "delta_softplus": True}
