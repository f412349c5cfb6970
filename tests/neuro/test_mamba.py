"""Mamba has the published parameters and computes the published formulae."""

import torch
from torch import Tensor
from torch.nn import functional

from hlsim.neuro.family.mamba import Mamba

# Parameters of Mamba(d_model=64) in mamba_ssm 2.2
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


def test_parameters_are_those_of_mamba_ssms_with_step_sizes_between_0_001_and_0_1() -> None:
    model = Mamba(64)
    assert {name: tuple(p.shape) for name, p in model.named_parameters()} == SHAPES
    steps = functional.softplus(model.dt_proj.bias.detach())
    assert 0.001 <= float(steps.min()) < 0.003 and 0.03 < float(steps.max()) <= 0.1


def published_output(model: Mamba, sequence: Tensor) -> Tensor:
    """Output by the formulae of Gu and Dao (2023), computed step by step from the parameters."""
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
    state = torch.zeros(len(x), *p["A_log"].shape, dtype=x.dtype)
    outputs = []
    for t in range(x.shape[1]):
        decay = torch.exp(-step[:, t, :, None] * p["A_log"].exp())
        state = decay * state + (step[:, t] * x[:, t])[..., None] * B[:, t, None]
        outputs.append((state * C[:, t, None]).sum(-1) + p["D"] * x[:, t])
    return torch.stack(outputs, 1) * functional.silu(z) @ p["out_proj.weight"].T


def test_output_equals_the_published_formulae() -> None:
    torch.manual_seed(1)
    model = Mamba(16, d_state=3, expand=1).double()
    sequence = torch.randn(2, 23, 16, dtype=torch.float64)
    expected = published_output(model, sequence)
    torch.testing.assert_close(model(sequence), expected, rtol=1e-10, atol=1e-10)


def test_the_scan_runs_in_float32_under_autocast() -> None:
    torch.manual_seed(1)
    model = Mamba(16)
    sequence = torch.randn(2, 23, 16)
    expected = model(sequence).detach()
    with torch.autocast("cpu", torch.bfloat16):
        output = model(sequence).detach()
    assert output.dtype == torch.bfloat16
    assert float((output.float() - expected).norm() / expected.norm()) < 0.03
