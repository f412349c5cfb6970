"""What a training step costs, and the selective scan against other ways to run it."""

from __future__ import annotations

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import set_level
from hlsim.loss import HearingLossLoss
from hlsim.neuro.config import NEURO_RATE
from hlsim.neuro.scan import selective_scan

SCAN_SHAPE = (16, 64, 256, 16)
"""Items, channels, time and states."""


def training_step(
    compensator: nn.Module, *, device: str = "cpu", batch: int = 8, seconds: float = 2.0, repeats: int = 5
) -> list[dict[str, Any]]:
    """Where a step's time goes: the compensator, the loss that judges it, its simulator alone, and the whole step.

    Args:
        compensator: called with speech at 16 kHz and an audiogram.

    Returns: rows of name, forward, and forward plus backward: median, least and greatest milliseconds.
    """
    place, ear = torch.device(device), Audiogram.standard("N3")
    generator = torch.Generator().manual_seed(0)
    clean = set_level(torch.randn(batch, round(NEURO_RATE * seconds), generator=generator), 65.0).to(place)
    compensator = compensator.to(place).train()
    loss = HearingLossLoss(ear).to(place)
    exact = HearingLossLoss(ear, simulator="msbg").to(place)
    leaf = clean.clone().requires_grad_()
    parts: list[tuple[str, Callable[[], Tensor]]] = [
        ("compensator", lambda: compensator(clean, ear).square().sum()),
        ("HearingLossLoss (neuro-msbg)", lambda: loss(leaf, clean)),
        ("- its simulator", lambda: loss.simulator(leaf, ear).square().sum()),
        ("HearingLossLoss (msbg)", lambda: exact(leaf, clean)),
        ("- its simulator", lambda: exact.simulator(leaf, ear).square().sum()),
        ("whole step (neuro-msbg)", lambda: loss(compensator(clean, ear), clean)),
        ("whole step (msbg)", lambda: exact(compensator(clean, ear), clean)),
    ]
    return _table(parts, place, repeats)


def scan_rows(*, device: str = "cpu", repeats: int = 5) -> tuple[list[dict[str, Any]], list[str]]:
    """The selective scan against the step-by-step loop, mamba-ssm's kernel and mambapy; rows, and what is missing."""
    place = torch.device(device)
    items, channels, length, states = SCAN_SHAPE
    torch.manual_seed(0)
    u = torch.randn(items, channels, length, device=place)
    delta = torch.rand(items, channels, length, device=place).mul(0.1)
    B, C = (torch.randn(items, states, length, device=place) for _ in range(2))
    A = -torch.rand(channels, states, device=place) - 0.5
    for tensor in (u, delta, A, B, C):
        tensor.requires_grad_()
    parts: list[tuple[str, Callable[[], Tensor]]] = [
        ("hlsim", lambda: selective_scan(u, delta, A, B, C).sum()),
        ("step by step", lambda: scan_loop(u, delta, A, B, C).sum()),
    ]
    skipped = []
    try:
        kernel = importlib.import_module("mamba_ssm.ops.selective_scan_interface").selective_scan_fn
        if place.type != "cuda":
            raise ImportError("runs on a GPU only")
        parts.append(("mamba-ssm", lambda: kernel(u, delta, A, B, C).sum()))
    except Exception as error:  # a build for another torch or GPU fails with whatever it likes
        skipped.append(f"mamba-ssm: {str(error).splitlines()[0]}")
    try:
        pscan = importlib.import_module("mambapy.pscan").pscan

        def mambapy() -> Tensor:
            decay = (delta.mT.unsqueeze(-1) * A).exp()
            drive = (delta * u).mT.unsqueeze(-1) * B.mT.unsqueeze(2)
            return (pscan(decay, drive) @ C.mT.unsqueeze(-1)).sum()

        parts.append(("mambapy", mambapy))
    except ImportError as error:
        skipped.append(f"mambapy: {error}")
    return _table(parts, place, repeats), skipped


def scan_loop(u: Tensor, delta: Tensor, A: Tensor, B: Tensor, C: Tensor) -> Tensor:
    """The recurrence as it is written. Shapes as ``hlsim.neuro.scan.selective_scan``'s."""
    state = torch.zeros(*u.shape[:2], A.shape[-1], device=u.device, dtype=u.dtype)
    outputs = []
    for t in range(u.shape[-1]):
        step = delta[..., t, None]
        state = (step * A).exp() * state + step * u[..., t, None] * B[:, None, :, t]
        outputs.append((state * C[:, None, :, t]).sum(-1))
    return torch.stack(outputs, -1)


def _table(
    parts: list[tuple[str, Callable[[], Tensor]]], device: torch.device, repeats: int
) -> list[dict[str, Any]]:
    times: list[dict[str, list[float]]] = [{"forward": [], "both": []} for _ in parts]
    for turn in range(repeats + 1):  # in turns, so that all see the same machine; the first does not count
        for (_, call), own in zip(parts, times, strict=True):
            for direction in ("forward", "both"):
                start = time.perf_counter()
                with torch.set_grad_enabled(direction == "both"):
                    value = call()
                if direction == "both":
                    value.backward()
                if device.type == "cuda":
                    torch.cuda.synchronize()
                if turn:
                    own[direction].append(1000.0 * (time.perf_counter() - start))
    return [
        {"name": name} | {direction: _spread(values) for direction, values in own.items()}
        for (name, _), own in zip(parts, times, strict=True)
    ]


def _spread(values: list[float]) -> dict[str, float]:
    return {"median_ms": statistics.median(values), "least_ms": min(values), "greatest_ms": max(values)}
