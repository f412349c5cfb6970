"""What HASPI and HASQI cost, beside pyclarity's and beside the loss."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.benchmark.timing import clip, rows_by_turns
from hlsim.metrics import HaspiReference, HasqiReference, haspi, hasqi
from hlsim.metrics.pyclarity import pyclarity_score
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import one_thread

SECONDS = 3.0


@one_thread()
def metric_rows(*, device: str = "cpu", repeats: int = 5) -> tuple[list[dict[str, Any]], list[str]]:
    """One pair of 3 s at 16 kHz and 65 dB SPL, ear N3, on one thread: pyclarity's score, hlsim's, the same with the clean
    signal prepared, and that with the noise that pyclarity draws.

    Returns: rows as ``training_step``'s, with ``speedup``, pyclarity's forward median over the row's; and what failed.
    """
    place, ear = torch.device(device), Audiogram.standard("N3")
    clean = clip(NEURO_RATE, SECONDS, 1)[0]
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
        "HASQI, the same, noise seeded": partial(HasqiReference(clean, ear).score, given, noise="seeded"),
    }
    rows, skipped = rows_by_turns(theirs | ours, place, repeats, forward_only=theirs)
    medians = {row["name"]: row["forward"]["median_ms"] for row in rows if row["forward"]}
    for row in rows:
        reference = medians.get(f"{row['name'][:5]} (pyclarity)")
        row["speedup"] = reference / medians[row["name"]] if reference and row["name"] in medians else None
    return rows, skipped


def _pyclarity(name: str, clean: Tensor, given: Tensor, ear: Audiogram) -> Tensor:
    return torch.tensor(pyclarity_score(name, clean, given, ear, NEURO_RATE))
