"""What a training step costs, and the selective scan against other ways to run it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from compensators import MappingCompensator
from hlsim.audiogram import Audiogram
from hlsim.benchmark.timing import rows_by_turns
from hlsim.calibration import set_level
from hlsim.loss import HearingLossLoss
from hlsim.neuro.config import NEURO_RATE
from hlsim.neuro.scan import kernel_for, selective_scan, torch_scan

SCAN_SHAPE = (16, 64, 256, 16)
"""Items, channels, time and states."""


def training_step(
    compensator: nn.Module | None = None,
    *,
    device: str = "cpu",
    batch: int = 8,
    seconds: float = 2.0,
    repeats: int = 5,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Where a step's time goes: the compensator, by default untrained, the loss that judges it, its simulator alone, and
    the whole step.

    Returns: rows of name, forward, and forward plus backward: median, least and greatest milliseconds and, on a GPU, peak
        memory in MiB; and what failed, with its reason.
    """
    place, ear = torch.device(device), Audiogram.standard("N3")
    generator = torch.Generator().manual_seed(0)
    clean = set_level(torch.randn(batch, round(NEURO_RATE * seconds), generator=generator), 65.0).to(place)
    compensator = (compensator or MappingCompensator()).to(place).train()
    loss = HearingLossLoss(ear).to(place)
    exact = HearingLossLoss(ear, simulator="msbg").to(place)
    leaf = clean.clone().requires_grad_()
    parts: dict[str, Callable[[], Tensor]] = {
        "compensator": lambda: compensator(clean, ear).square().sum(),
        "HearingLossLoss (neuro-msbg)": lambda: loss(leaf, clean),
        "- its simulator (neuro-msbg)": lambda: loss.simulator(leaf, ear).square().sum(),
        "HearingLossLoss (msbg)": lambda: exact(leaf, clean),
        "- its simulator (msbg)": lambda: exact.simulator(leaf, ear).square().sum(),
        "whole step (neuro-msbg)": lambda: loss(compensator(clean, ear), clean),
        "whole step (msbg)": lambda: exact(compensator(clean, ear), clean),
    }
    return rows_by_turns(parts, place, repeats)


def scan_rows(*, device: str = "cpu", repeats: int = 5) -> tuple[list[dict[str, Any]], list[str]]:
    """The selective scan in plain torch, and with mamba-ssm's kernel as hlsim calls it, against the step-by-step loop,
    that kernel alone and mambapy; rows, and what is missing."""
    place = torch.device(device)
    items, channels, length, states = SCAN_SHAPE
    torch.manual_seed(0)
    u = torch.randn(items, channels, length, device=place)
    delta = torch.rand(items, channels, length, device=place).mul(0.1)
    B, C = (torch.randn(items, states, length, device=place) for _ in range(2))
    A = -torch.rand(channels, states, device=place) - 0.5
    for tensor in (u, delta, A, B, C):
        tensor.requires_grad_()
    parts: dict[str, Callable[[], Tensor]] = {
        "hlsim (plain torch)": lambda: torch_scan(u, delta, A, B, C).sum(),
        "step by step": lambda: scan_loop(u, delta, A, B, C).sum(),
    }
    if kernel_for(u) is not None:
        parts["hlsim (by mamba-ssm's kernel)"] = lambda: selective_scan(u, delta, A, B, C).sum()
    skipped = []
    try:
        kernel = importlib.import_module("mamba_ssm.ops.selective_scan_interface").selective_scan_fn
        if place.type != "cuda":
            raise ImportError("runs on a GPU only")
        parts["mamba-ssm"] = lambda: kernel(u, delta, A, B, C).sum()
    except Exception as error:  # a build for another torch or GPU fails with whatever it likes
        skipped.append(f"mamba-ssm: {str(error).splitlines()[0]}")
    try:
        pscan = importlib.import_module("mambapy.pscan").pscan

        def mambapy() -> Tensor:
            decay = (delta.mT.unsqueeze(-1) * A).exp()
            drive = (delta * u).mT.unsqueeze(-1) * B.mT.unsqueeze(2)
            return (pscan(decay, drive) @ C.mT.unsqueeze(-1)).sum()

        parts["mambapy"] = mambapy
    except ImportError as error:
        skipped.append(f"mambapy: {error}")
    rows, failed = rows_by_turns(parts, place, repeats)
    return rows, skipped + failed


def scan_loop(u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    """The recurrence as it is written. Shapes as ``hlsim.neuro.scan.selective_scan``'s."""
    state = torch.zeros(*u.shape[:2], A.shape[-1], device=u.device, dtype=u.dtype)
    outputs = []
    for t in range(u.shape[-1]):
        step = delta[..., t, None]
        state = (step * A).exp() * state + step * u[..., t, None] * B[:, None, :, t]
        outputs.append((state * C[:, None, :, t]).sum(-1))
    return torch.stack(outputs, -1)
