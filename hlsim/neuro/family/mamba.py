"""The Mamba layer, with parameters of the same names and shapes as ``mamba_ssm.Mamba``.

Source: Gu and Dao (2023), arXiv:2312.00752.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from hlsim.neuro.family.scan import selective_scan


class Mamba(nn.Module):
    """Mamba layer: a causal layer for sequences, whose recursive filters depend on the sequence.

    The layer is the selective state space model of Gu and Dao. The names of arguments and
    parameters are those of ``mamba_ssm``.

    Shape: (items, time, d_model) -> (items, time, d_model).

    Args:
        d_model: Number of channels of the sequence.
        d_state: Number of states, values that remember the past, per inner channel.
        expand: Number of inner channels relative to ``d_model``.

    >>> Mamba(16, d_state=4)(torch.randn(2, 20, 16)).shape
    torch.Size([2, 20, 16])
    """

    def __init__(self, d_model: int, d_state: int = 16, expand: int = 2) -> None:
        super().__init__()
        inner = expand * d_model
        rank = math.ceil(d_model / 16)
        self.sizes = (rank, d_state, d_state)
        self.in_proj = nn.Linear(d_model, 2 * inner, bias=False)
        self.conv1d = nn.Conv1d(inner, inner, 4, groups=inner, padding=3)
        self.x_proj = nn.Linear(inner, sum(self.sizes), bias=False)
        self.dt_proj = nn.Linear(rank, inner)
        self.A_log = nn.Parameter(torch.arange(1.0, d_state + 1.0).log().repeat(inner, 1))
        self.D = nn.Parameter(torch.ones(inner))
        self.out_proj = nn.Linear(inner, d_model, bias=False)
        # Before training, the biases alone give step sizes between 0.001 and 0.1, whose logarithms
        # are uniformly distributed.
        nn.init.uniform_(self.dt_proj.weight, -(rank**-0.5), rank**-0.5)
        step = torch.exp(torch.rand(inner) * math.log(100.0) + math.log(0.001))
        inverse_softplus = step + torch.log(-torch.expm1(-step))
        with torch.no_grad():
            self.dt_proj.bias.copy_(inverse_softplus)

    def forward(self, sequence: Tensor) -> Tensor:
        time = sequence.shape[1]
        signal, gate = self.in_proj(sequence).chunk(2, -1)
        signal = functional.silu(self.conv1d(signal.mT)[..., :time].mT.contiguous())
        step, B, C = self.x_proj(signal).split(self.sizes, -1)
        # The scan multiplies many decays, for which bfloat16 is too imprecise.
        with torch.autocast(sequence.device.type, enabled=False):
            dtype = self.A_log.dtype
            y = selective_scan(
                signal.to(dtype).mT,
                functional.linear(step.to(dtype), self.dt_proj.weight).mT,
                -self.A_log.exp(),
                B.to(dtype).mT,
                C.to(dtype).mT,
                self.D,
                z=gate.to(dtype).mT,
                delta_bias=self.dt_proj.bias,
            )
        return self.out_proj(y.mT)
