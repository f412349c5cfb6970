"""What ``hlsim benchmark`` times: simulators behind one call, and what they are measured against."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.extras import MissingExtraError, require
from hlsim.msbg import MSBG
from hlsim.msbg.ear import MSBG_RATE
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import SIMULATOR, load_pretrained, shipped

CONNEAR_RATE = 20000

Prepare = Callable[[int, Audiogram, torch.device], Callable[[Tensor], Tensor]]


@dataclass(frozen=True)
class Row:
    """A simulator.

    Attributes:
        name: with what is to be said of it.
        rates: sample rates in Hz at which it is timed.
        prepare: rate, ear and device -> a call (batch, time) -> (batch, time).
        differentiable: whether gradients pass.
        parameters: of the network; 0 where nothing is trained.
        default: whether it is the network that ``HearingLossLoss`` takes.
    """

    name: str
    rates: tuple[int, ...]
    prepare: Prepare
    differentiable: bool = True
    parameters: int = 0
    default: bool = False


def rows(simulators: list[str] | None = None) -> tuple[list[Row], list[str]]:
    """All rows, and why some are missing.

    Args:
        simulators: Neuro-MSBGs by name or folder; by default all that ship.
    """
    both = (MSBG_RATE, NEURO_RATE)
    found = [Row("identity", both, lambda rate, ear, device: lambda wave: wave * 1.0)]
    skipped = []
    for name, build in (("pyclarity Ear", _pyclarity), ("pyclarity torch_msbg", _torch_msbg)):
        try:
            found.append(build(name))
        except MissingExtraError as error:
            skipped.append(f"{name}: {error}")
    found.append(Row("MSBG (exact)", both, _exact))
    for name in shipped(SIMULATOR) if simulators is None else simulators:
        model = load_pretrained(name)
        count = sum(p.numel() for p in model.parameters())
        default = name == "neuro-msbg"
        found.append(Row(f"Neuro-MSBG ({name})", both, _neuro(name), parameters=count, default=default))
    count = sum(p.numel() for p in ConnearShape().parameters())
    found.append(
        Row("CoNNear's shape (random weights, speed only)", (CONNEAR_RATE,), _connear, parameters=count)
    )
    return found, skipped


class ConnearShape(nn.Module):
    """A network of the published shape of CoNNear's cochlea (Baby, Van Den Broucke and Verhulst 2021), untrained.

    Four strided convolutions of 128 filters of 64 taps with tanh, as many transposed ones with skips, 201 outputs: 11.7
    million parameters. The clip goes through whole, with 256 samples of context on either side.

    Shape: (batch, time) at 20 kHz -> (batch, 201, time).
    """

    def __init__(self) -> None:
        super().__init__()
        inputs = (1, 128, 128, 128)
        self.down = nn.ModuleList(nn.Conv1d(i, 128, 64, 2, padding=31) for i in inputs)
        sizes = ((128, 128), (256, 128), (256, 128), (256, 201))
        self.up = nn.ModuleList(nn.ConvTranspose1d(i, o, 64, 2, padding=31) for i, o in sizes)

    def forward(self, wave: Tensor) -> Tensor:
        time = wave.shape[-1]
        padded = nn.functional.pad(wave, (256, 256 + -time % 16))
        hidden, skips = padded.unsqueeze(1), []
        for layer in self.down:
            hidden = layer(hidden).tanh()
            skips.append(hidden)
        for number, layer in enumerate(self.up):
            hidden = layer(hidden if number == 0 else torch.cat((hidden, skips[3 - number]), 1))
            hidden = hidden.tanh() if number < 3 else hidden
        return hidden[..., 256 : 256 + time]


def _exact(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
    return MSBG(ear, sample_rate=rate).to(device)


def _neuro(name: str) -> Prepare:
    def prepare(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
        model = load_pretrained(name, sample_rate=rate).to(device)
        return lambda wave: model(wave, ear)

    return prepare


def _connear(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
    return ConnearShape().eval().requires_grad_(False).to(device)


def _pyclarity(name: str) -> Row:
    """One item after the other, always on the CPU."""
    module = require("clarity.evaluator.msbg.msbg", "eval")

    def prepare(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
        logging.getLogger("clarity").setLevel(logging.ERROR)
        model = module.Ear(equiv_0db_spl=74.0)  # plus 20: RMS 1.0 is 94 dB SPL
        model.set_audiogram(ear.to_clarity())

        def call(wave: Tensor) -> Tensor:
            heard = [model.process(item)[0] for item in wave.double().cpu().numpy()]
            return torch.from_numpy(np.stack(heard))

        return call

    return Row(name, (MSBG_RATE,), prepare, differentiable=False)


def _torch_msbg(name: str) -> Row:
    """As it stands in pyclarity 0.9.0; its filters are built beforehand."""
    module = require("clarity.predictor.torch_msbg", "eval")

    def prepare(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
        levels = np.array(ear.thresholds)
        model = module.MSBGHearingModel(levels, np.array(FREQUENCIES), sr=rate, device=str(device)).to(device)
        return lambda wave: model(wave)

    return Row(name, (MSBG_RATE,), prepare)
