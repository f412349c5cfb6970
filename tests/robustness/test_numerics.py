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


class Case:
    """A batch, its reference, an ear and the module that processes them."""

    def __init__(self, draw: Random, names: tuple[str, ...]) -> None:
        self.name, self.ear, items = draw.choice(names), draw.choice(EARS), draw.choice((1, 1, 3))
        is_score = self.name in ("haspi", "hasqi")
        shortest = draw.choice((1, 11200, 11200, 11200)) if is_score else 1  # Scores need 0.7 s.
        longest = max(4000, shortest + 800)
        lengths = (shortest, draw.randint(shortest, longest), draw.randint(shortest, longest))
        samples = draw.choice(lengths)
        kind = draw.choice((torch.float32, torch.float32, torch.float64))
        self.signal, self.clean = (
            torch.stack([draw_signal(draw, samples) for _ in range(items)]).to(kind)
            for _ in range(2)
        )
        if shortest > 1 and draw.random() < 0.7:  # Audible noise has a score.
            noise = torch.randn(self.clean.shape, generator=torch.Generator().manual_seed(0))
            self.clean = 0.05 * noise.to(kind)


@cache
def module(name: str) -> Any:
    if name == "msbg":
        return MSBG(sample_rate=16000)
    if " of " in name:
        criterion, simulator = name.split(" of ")
        return HearingLossLoss(criterion=criterion, simulator=simulator)
    metrics = {"haspi": haspi, "hasqi": hasqi}
    return metrics.get(name) or (load_pretrained if "neuro" in name else load_compensator)(name)


def check(case: Case) -> None:
    paired = " of " in case.name or case.name in ("haspi", "hasqi")
    signal, ear = case.signal.clone().requires_grad_(), Audiogram.standard(case.ear)
    out = module(case.name)(signal, *([case.clean] if paired else []), ear)
    assert bool(torch.isfinite(out).all()), "not finite"
    assert paired or out.shape == signal.shape, "another shape"
    out.sum().backward()
    assert signal.grad is not None and bool(torch.isfinite(signal.grad).all()), "gradient"


@pytest.mark.parametrize("kind", KINDS)
def test_outputs_and_gradients_are_finite_or_a_value_error_is_raised(kind: str) -> None:
    for seed in range(25):
        with suppress(ValueError):
            check(Case(Random(f"{kind}:{seed}"), KINDS[kind]))


@pytest.mark.parametrize(
    ("name", "pascals"), [("msbg", 1e9), ("neuro-msbg", 1e6), ("neuro-msbg", 1e9)]
)
@pytest.mark.parametrize("ear", ["N1", "N4", "S3"])
def test_a_constant_beside_which_all_other_frequencies_are_silent(
    name: str, pascals: float, ear: str
) -> None:
    case = Case(Random(0), (name,))
    case.signal, case.ear = torch.full((1, 2000), pascals), ear
    check(case)
