"""Mamba (Gu and Dao 2023), with the parameters of ``mamba_ssm.Mamba`` by name and shape."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.neuro.scan import selective_scan


class Mamba(nn.Module):
    """A selective state space along a sequence, causal. Shape: (items, time, d_model) -> the same.

    Args:
        d_model: channels of the sequence.
        d_state: states a channel.
        expand: channels inside over ``d_model``.
    """

    def __init__(self, d_model: int, d_state: int = 16, expand: int = 2) -> None:
        super().__init__()
        inner, rank = expand * d_model, math.ceil(d_model / 16)
        self.sizes = (rank, d_state, d_state)
        self.in_proj = nn.Linear(d_model, 2 * inner, bias=False)
        self.conv1d = nn.Conv1d(inner, inner, 4, groups=inner, padding=3)
        self.x_proj = nn.Linear(inner, sum(self.sizes), bias=False)
        self.dt_proj = nn.Linear(rank, inner)
        self.A_log = nn.Parameter(torch.arange(1.0, d_state + 1.0).log().repeat(inner, 1))
        self.D = nn.Parameter(torch.ones(inner))
        self.out_proj = nn.Linear(inner, d_model, bias=False)
        # steps from 0.001 to 0.1 at the start, evenly in their logarithm
        nn.init.uniform_(self.dt_proj.weight, -(rank**-0.5), rank**-0.5)
        step = torch.exp(torch.rand(inner) * math.log(100.0) + math.log(0.001))
        with torch.no_grad():
            self.dt_proj.bias.copy_(step + torch.log(-torch.expm1(-step)))

    def forward(self, sequence: Tensor) -> Tensor:
        time = sequence.shape[1]
        signal, gate = self.in_proj(sequence).chunk(2, -1)
        signal = functional.silu(self.conv1d(signal.mT)[..., :time].mT.contiguous())
        step, entry, leave = self.x_proj(signal).split(self.sizes, -1)
        with torch.autocast(
            sequence.device.type, enabled=False
        ):  # powers of decays want their precision
            dtype = self.A_log.dtype
            y = selective_scan(
                signal.to(dtype).mT,
                functional.linear(step.to(dtype), self.dt_proj.weight).mT,
                -self.A_log.exp(),
                entry.to(dtype).mT,
                leave.to(dtype).mT,
                self.D,
                z=gate.to(dtype).mT,
                delta_bias=self.dt_proj.bias,
                delta_softplus=True,
            )
        output: Tensor = self.out_proj(y.mT)
        return output
