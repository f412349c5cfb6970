"""Mamba's parameters, and that it is the published computation."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from hlsim.neuro.mamba import Mamba

# as mamba_ssm 2.2's Mamba(d_model=64) has them
SHAPES = {
    "A_log": (128, 16),
    "D": (128,),
    "in_proj.weight": (256, 64),
    "conv1d.weight": (128, 1, 4),
    "conv1d.bias": (128,),
    "x_proj.weight": (36, 128),
    "dt_proj.weight": (128, 4),
    "dt_proj.bias": (128,),
    "out_proj.weight": (64, 128),
}


def test_names_and_shapes_are_those_of_mamba_ssm() -> None:
    assert {name: tuple(p.shape) for name, p in Mamba(64).named_parameters()} == SHAPES


def test_steps_start_between_a_thousandth_and_a_tenth() -> None:
    torch.manual_seed(0)
    steps = functional.softplus(Mamba(64).dt_proj.bias.detach())
    assert 0.001 <= float(steps.min()) < 0.003 and 0.03 < float(steps.max()) <= 0.1


def published(model: Mamba, sequence: Tensor) -> Tensor:
    """Gu and Dao 2023, step by step, from the parameters alone."""
    p = dict(model.named_parameters())
    x, z = (sequence @ p["in_proj.weight"].T).chunk(2, -1)
    taps = p["conv1d.weight"].squeeze(1)
    padded = functional.pad(x, (0, 0, taps.shape[1] - 1, 0))
    x = functional.silu(
        sum(padded[:, k : k + x.shape[1]] * taps[:, k] for k in range(taps.shape[1]))
        + p["conv1d.bias"]
    )
    step, B, C = (x @ p["x_proj.weight"].T).split(
        [p["dt_proj.weight"].shape[1], *2 * [p["A_log"].shape[1]]], -1
    )
    step = functional.softplus(step @ p["dt_proj.weight"].T + p["dt_proj.bias"])
    state, outputs = torch.zeros(len(x), *p["A_log"].shape, dtype=x.dtype), []
    for t in range(x.shape[1]):
        decay = torch.exp(-step[:, t, :, None] * p["A_log"].exp())
        state = decay * state + (step[:, t] * x[:, t])[..., None] * B[:, t, None]
        outputs.append((state * C[:, t, None]).sum(-1) + p["D"] * x[:, t])
    return torch.stack(outputs, 1) * functional.silu(z) @ p["out_proj.weight"].T


@pytest.mark.parametrize("sizes", [{}, {"d_state": 3, "expand": 1}])
def test_is_the_published_computation(sizes: dict[str, int]) -> None:
    torch.manual_seed(1)
    model, sequence = Mamba(16, **sizes).double(), torch.randn(2, 23, 16, dtype=torch.float64)
    torch.testing.assert_close(model(sequence), published(model, sequence), rtol=1e-10, atol=1e-10)


def test_scans_in_float32_under_autocast() -> None:
    torch.manual_seed(1)
    model, sequence = Mamba(16), torch.randn(2, 23, 16)
    with torch.autocast("cpu", torch.bfloat16):
        lower = model(sequence)
    assert lower.dtype == torch.bfloat16
    assert float((lower.float() - model(sequence)).norm() / model(sequence).norm()) < 0.03
