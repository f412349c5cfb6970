"""The selective scan against the recurrence, step by step, in float64."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.neuro import scan
from hlsim.neuro.scan import selective_scan

LENGTHS = (1, 2, 3, 4, 5, 31, 64, 101)


def by_steps(u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    state, outputs = torch.zeros(*u.shape[:2], A.shape[1], dtype=u.dtype), []
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
def test_equals_the_recurrence_and_so_do_its_gradients(
    time: int, block: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scan, "_BLOCK_CPU", block)
    given = [tensor.requires_grad_() for tensor in arguments(time, channels=20)]
    found, true = selective_scan(*given), by_steps(*given)
    torch.testing.assert_close(found, true, rtol=1e-10, atol=1e-10)
    weight = torch.randn(
        true.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    # at one step the decay multiplies nothing
    for a, b in zip(
        torch.autograd.grad((found * weight).sum(), given),
        torch.autograd.grad((true * weight).sum(), given),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-10)


def test_gradcheck() -> None:
    given = [tensor.requires_grad_() for tensor in arguments(7, 2, 2, 3)]
    assert torch.autograd.gradcheck(selective_scan, given)


@pytest.mark.parametrize("wanted", range(5))
def test_a_second_derivative_is_refused(wanted: int) -> None:
    """For any input, where torch would leave out what it cannot follow."""
    given = [tensor.requires_grad_() for tensor in arguments(7, 2, 2, 3)]
    slopes = torch.autograd.grad(selective_scan(*given).square().sum(), given, create_graph=True)
    for slope in slopes:
        with pytest.raises(RuntimeError):
            torch.autograd.grad(slope.sum(), given[wanted], retain_graph=True)


def test_skip_gate_bias_and_softplus() -> None:
    u, delta, A, B, C = arguments(9)
    D, bias, z = torch.randn(5).double(), torch.randn(5).double(), torch.randn_like(u)
    found = selective_scan(u, delta, A, B, C, D, z, bias, delta_softplus=True)
    step = functional.softplus(delta + bias[:, None])
    true = (by_steps(u, step, A, B, C) + D[:, None] * u) * functional.silu(z)
    torch.testing.assert_close(found, true, rtol=1e-10, atol=1e-10)


def test_is_causal_and_remembers() -> None:
    u, delta, A, B, C = arguments(40)
    changed = u.clone()
    changed[..., 20] += 1.0
    difference = selective_scan(changed, delta, A, B, C) - selective_scan(u, delta, A, B, C)
    assert not bool(difference[..., :20].any()) and bool(difference[..., 20:23].abs().min() > 0.0)


def test_does_not_overflow_where_decays_vanish_and_sums_where_there_are_none() -> None:
    ones, drive = torch.ones(2, 1, 4096), torch.full((2, 1, 4096), 1 / 69.0)
    vanishing = selective_scan(drive, 69.0 * ones, -torch.ones(1, 1), ones, ones)  # decays of 1e-30
    torch.testing.assert_close(vanishing, ones)
    kept = selective_scan(ones, ones, torch.zeros(1, 1), ones, ones)
    torch.testing.assert_close(kept, torch.arange(1.0, 4097.0).expand(2, 1, -1))


def test_autocast_does_not_reach_it() -> None:
    given = [tensor.float().requires_grad_() for tensor in arguments(33)]
    true = selective_scan(*given)
    gradients = torch.autograd.grad(true.square().sum(), given)
    with torch.autocast("cpu", torch.bfloat16):
        found = selective_scan(*given)
        inside = torch.autograd.grad(found.square().sum(), given)
    assert torch.equal(found, true)
    assert all(torch.equal(a, b) for a, b in zip(inside, gradients, strict=True))
    # mamba_ssm's convention: A in float32, the rest as the network has it
    u, delta, A, B, C = (tensor.float() for tensor in arguments(33))
    lower = [tensor.bfloat16() for tensor in (u, delta, B, C)]
    coarse = selective_scan(lower[0], lower[1], A, *lower[2:])
    fine = selective_scan(
        lower[0].float(), lower[1].float(), A, *(tensor.float() for tensor in lower[2:])
    )
    assert coarse.dtype == torch.bfloat16 and torch.equal(coarse, fine.bfloat16())


def test_float32_is_near_float64() -> None:
    given = arguments(101)
    single = selective_scan(*(tensor.float() for tensor in given)).double()
    true = selective_scan(*given)
    assert float((single - true).norm() / true.norm()) < 1e-5


def test_shapes_that_do_not_fit_raise_value_error() -> None:
    u, delta, A, B, C = arguments(6)
    with pytest.raises(ValueError):
        selective_scan(u, delta, A, B[..., :5], C)
    with pytest.raises(ValueError):
        selective_scan(u, delta[:, :2], A, B, C)


def test_a_kernel_does_all_of_it_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def kernel(*given: Tensor, **options: Any) -> Tensor:
        calls.append((given, options))
        return 0.5 * given[0]

    monkeypatch.setattr(scan, "_kernel_for", lambda u: kernel)
    given, D, bias = arguments(9), torch.randn(5).double(), torch.randn(5).double()
    found = selective_scan(*given, D, given[0], bias, delta_softplus=True)
    assert torch.equal(found, 0.5 * given[0])
    ((taken, options),) = calls
    assert all(a is b for a, b in zip(taken, given, strict=True))
    assert options == {"D": D, "z": given[0], "delta_bias": bias, "delta_softplus": True}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_and_by_the_kernel_where_it_is() -> None:
    given = [tensor.float().cuda() for tensor in arguments(101)]
    true = selective_scan(*arguments(101)).float()
    torch.testing.assert_close(selective_scan(*given).cpu(), true, rtol=1e-4, atol=1e-4)
