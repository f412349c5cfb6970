"""What ``hlsim benchmark`` times: simulators behind one call, and what they are measured against."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.extras import MissingExtraError, require
from hlsim.msbg import MSBG
from hlsim.msbg.ear import MSBG_RATE
from hlsim.neuro.config import NEURO_RATE
from hlsim.pretrained import SIMULATOR, load_pretrained, shipped

Call = Callable[[Tensor], Tensor]
Prepare = Callable[[int, Audiogram, torch.device], Call]


@dataclass(frozen=True)
class Row:
    """A simulator, timed at sample rates in Hz.

    Attributes:
        prepare: rate, ear and device -> a call (batch, time) -> (batch, time).
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
    """All rows, with these Neuro-MSBGs by name or folder, by default all that ship, and why some are missing."""
    both = (MSBG_RATE, NEURO_RATE)
    found = [Row("identity", both, lambda rate, ear, device: lambda wave: wave * 1.0)]
    skipped = []
    for name, module, prepare, differentiable in (
        ("pyclarity Ear", "clarity.evaluator.msbg.msbg", _pyclarity_ear, False),
        ("pyclarity torch_msbg", "clarity.predictor.torch_msbg", _pyclarity_torch, True),
    ):
        try:
            prepare = partial(prepare, require(module, "pyclarity"))
            found.append(Row(name, (MSBG_RATE,), prepare, differentiable))
        except MissingExtraError as error:
            skipped.append(f"{name}: {error}")
    found.append(
        Row("MSBG (exact)", both, lambda rate, ear, device: MSBG(ear, sample_rate=rate).to(device))
    )
    for name in shipped([SIMULATOR]) if simulators is None else simulators:
        count, default = (
            sum(own.numel() for own in load_pretrained(name).parameters()),
            name == "neuro-msbg",
        )
        title = f"Neuro-MSBG ({name})"
        found.append(Row(title, both, partial(_neuro, name), parameters=count, default=default))
    return found, skipped


def _neuro(name: str, rate: int, ear: Audiogram, device: torch.device) -> Call:
    model = load_pretrained(name, sample_rate=rate).to(device)
    return lambda wave: model(wave, ear)


def _pyclarity_ear(module: Any, rate: int, ear: Audiogram, device: torch.device) -> Call:
    """One item after the other, always on the CPU."""
    logging.getLogger("clarity").setLevel(logging.ERROR)
    model = module.Ear(equiv_0db_spl=74.0)  # plus 20: RMS 1.0 is 94 dB SPL
    model.set_audiogram(ear.to_clarity())

    def call(wave: Tensor) -> Tensor:
        heard = [model.process(item)[0] for item in wave.double().cpu().numpy()]
        return torch.from_numpy(np.stack(heard))

    return call


def _pyclarity_torch(module: Any, rate: int, ear: Audiogram, device: torch.device) -> Call:
    """As it stands in pyclarity 0.9.0; its filters are built beforehand."""
    levels, frequencies = np.array(ear.thresholds), np.array(FREQUENCIES)
    model = module.MSBGHearingModel(levels, frequencies, sr=rate, device=str(device)).to(device)
    return lambda wave: model(wave)
