"""Unusual signals give finite outputs and gradients, or are rejected."""

from contextlib import suppress
from functools import cache
from random import Random
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.metrics import haspi, hasqi

EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "N7", "S1", "S2", "S3")
LEVELS = (0.0, 1e-40, 1e-20, 1e-9, 1e-5, 0.02, 1.0, -1.0, 1e3, 1e6, 1e9, 1e18, 1e38)
KINDS = {
    "numerics of simulators": ("msbg", "neuro-msbg", "neuro-msbg-lstm"),
    "numerics of compensators": ("nalr", "wdrc", "hearing-aid", "compensator-general"),
    "numerics of losses": tuple(
        f"{criterion} of {simulator}"
        for criterion in ("coherent-bands", "bands", "paper")
        for simulator in ("msbg", "neuro-msbg")
    ),
    "numerics of metrics": ("haspi", "hasqi"),
}


def draw_signal(draw: Random, samples: int) -> Tensor:
    """Draw an impulse, a constant, noise, a tone, a step or bursts, at a random level."""
    time, at = torch.arange(samples, dtype=torch.float64), draw.randrange(samples)
    generator = torch.Generator().manual_seed(draw.randrange(2**32))
    noise = torch.randn(samples, generator=generator).clamp(-1.0, 1.0)
    tone = torch.sin(time * draw.choice((1e-4, 0.1, 1.0, 3.1)))
    bursts = noise * (torch.sin(time / 300.0) > 0.0)
    shapes = (time == at, time >= 0, noise, tone, time >= at, bursts)
    return draw.choice(LEVELS) * draw.choice(shapes).double()


def draw_signals(draw: Random, items: int, samples: int, dtype: torch.dtype) -> Tensor:
    return torch.stack([draw_signal(draw, samples) for _ in range(items)]).to(dtype)


@cache
def module(name: str) -> Any:
    if name == "msbg":
        return MSBG(sample_rate=16000)
    if " of " in name:
        criterion, simulator = name.split(" of ")
        return HearingLossLoss(criterion=criterion, simulator=simulator)
    metrics = {"haspi": haspi, "hasqi": hasqi}
    return metrics.get(name) or (load_pretrained if "neuro" in name else load_compensator)(name)


def check(name: str, signal: Tensor, clean: Tensor, ear: str) -> None:
    paired = " of " in name or name in ("haspi", "hasqi")
    signal = signal.clone().requires_grad_()
    out = module(name)(signal, *([clean] if paired else []), Audiogram.standard(ear))
    assert bool(torch.isfinite(out).all()), "not finite"
    assert paired or out.shape == signal.shape, "another shape"
    out.sum().backward()
    assert signal.grad is not None and bool(torch.isfinite(signal.grad).all()), "gradient"


@pytest.mark.parametrize(
    ("kind", "seeds"),
    [
        *((kind, range(8)) for kind in KINDS if "metrics" not in kind),
        ("numerics of metrics", range(3)),
        *(pytest.param(kind, range(3, 25), marks=pytest.mark.slow) for kind in KINDS),
    ],
)
def test_outputs_and_gradients_are_finite_or_a_value_error_is_raised(
    kind: str, seeds: range
) -> None:
    for seed in seeds:
        draw = Random(f"{kind}:{seed}")
        name, ear, items = draw.choice(KINDS[kind]), draw.choice(EARS), draw.choice((1, 1, 3))
        # Scores need 0.7 s.
        shortest = 11200 if name in ("haspi", "hasqi") and draw.random() < 0.75 else 1
        samples = draw.choice((shortest, draw.randint(shortest, max(4000, shortest + 800))))
        dtype = draw.choice((torch.float32, torch.float32, torch.float64))
        signal = draw_signals(draw, items, samples, dtype)
        clean = draw_signals(draw, items, samples, dtype)
        if shortest > 1 and draw.random() < 0.7:  # Audible noise has a score.
            clean = 0.05 * torch.randn(items, samples, dtype=dtype)
        with suppress(ValueError):
            check(name, signal, clean, ear)


@pytest.mark.parametrize("ear", ["N1", "N4", "S3"])
def test_a_constant_beside_which_all_other_frequencies_are_silent(ear: str) -> None:
    for name, pascals in (("msbg", 1e9), ("neuro-msbg", 1e6), ("neuro-msbg", 1e9)):
        signal = torch.full((1, 2000), pascals)
        check(name, signal, signal, ear)
