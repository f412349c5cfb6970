"""What a training step costs, and HASPI and HASQI beside pyclarity's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from compensators import MappingCompensator
from hlsim.audiogram import Audiogram
from hlsim.benchmark.timing import clip, rows_by_turns
from hlsim.calibration import set_level
from hlsim.losses.hearing_loss import HearingLossLoss
from hlsim.metrics import HaspiReference, HasqiReference, haspi, hasqi
from hlsim.metrics.pyclarity import pyclarity_score
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread

METRIC_SECONDS = 3.0


def training_step(
    *, device: str = "cpu", repeats: int = 5
) -> tuple[list[dict[str, Any]], list[str]]:
    """Where the time of a step on 8 clips of 2 s goes: an untrained compensator, the loss that judges it, its simulator
    alone, and the whole step.

    Returns: rows of name, forward, and forward plus backward: median, least and greatest milliseconds and, on a GPU, peak
        memory in MiB; and what failed, with its reason.
    """
    place, ear = torch.device(device), Audiogram.standard("N3")
    generator = torch.Generator().manual_seed(0)
    clean = set_level(torch.randn(8, 2 * NEURO_RATE, generator=generator), 65.0).to(place)
    compensator = MappingCompensator().to(place).train()
    leaf = clean.clone().requires_grad_()

    def square(waveform: Tensor) -> Tensor:
        return waveform.square().sum()

    parts: dict[str, Callable[[], Tensor]] = {
        "compensator": lambda: square(compensator(clean, ear))
    }
    for name in ("neuro-msbg", "neuro-msbg-light", "msbg"):
        loss = HearingLossLoss(ear, simulator=name).to(place)
        parts |= {
            f"HearingLossLoss ({name})": partial(loss, leaf, clean),
            f"- its simulator ({name})": partial(
                lambda simulator: square(simulator(leaf, ear)), loss.simulator
            ),
            f"whole step ({name})": partial(
                lambda loss: loss(compensator(clean, ear), clean), loss
            ),
        }
    return rows_by_turns(parts, place, repeats)


@one_thread()
def metric_rows(*, device: str = "cpu", repeats: int = 5) -> tuple[list[dict[str, Any]], list[str]]:
    """One pair of 3 s at 16 kHz and 65 dB SPL, ear N3, on one thread: pyclarity's score, hlsim's, the same with the clean
    signal prepared, and that with the noise that pyclarity draws.

    Returns: rows as ``training_step``'s, with ``speedup``, pyclarity's forward median over the row's; and what failed.
    """
    place, ear = torch.device(device), Audiogram.standard("N3")
    clean = clip(NEURO_RATE, METRIC_SECONDS, 1)[0]
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    given = clean + 0.3 * clean.square().mean().sqrt() * noise
    theirs: dict[str, Callable[[], Tensor]] = {
        f"{name.upper()} (pyclarity)": partial(_pyclarity, name, clean, given, ear)
        for name in ("haspi", "hasqi")
    }
    clean, given = clean.to(place), given.to(place).requires_grad_()
    against = HaspiReference(clean)
    ours: dict[str, Callable[[], Tensor]] = {
        "HASPI": partial(haspi, given, clean, ear),
        "HASPI, clean signal prepared": partial(against.score, given, ear),
        "HASPI, the same, noise seeded": partial(against.score, given, ear, noise="seeded"),
        "HASQI": partial(hasqi, given, clean, ear),
        "HASQI, clean signal prepared": partial(HasqiReference(clean, ear).score, given),
        "HASQI, the same, noise seeded": partial(
            HasqiReference(clean, ear).score, given, noise="seeded"
        ),
    }
    rows, skipped = rows_by_turns(theirs | ours, place, repeats, forward_only=theirs)
    medians = {row["name"]: row["forward"]["median_ms"] for row in rows if row["forward"]}
    for row in rows:
        reference = medians.get(f"{row['name'][:5]} (pyclarity)")
        row["speedup"] = (
            reference / medians[row["name"]] if reference and row["name"] in medians else None
        )
    return rows, skipped


def _pyclarity(name: str, clean: Tensor, given: Tensor, ear: Audiogram) -> Tensor:
    return torch.tensor(pyclarity_score(name, clean, given, ear, NEURO_RATE))
