"""Odd signals, from silence to 1e9 Pa and from one sample up: finite sound and finite gradients, or a refusal."""

from collections.abc import Callable
from functools import cache
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained
from hlsim.metrics import haspi, hasqi

EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "N6", "N7", "S1", "S2", "S3")
SHAPES = ("silence", "impulse", "constant", "noise", "tone", "step", "bursts")
LEVELS = (1e-40, 1e-20, 1e-9, 1e-5, 0.02, 1.0, 1e3, 1e6, 1e9)


def signal(draw: Random, samples: int) -> Tensor:
    """A signal of random shape and level. Shape: -> (samples,)."""
    shape, generator = draw.choice(SHAPES), np.random.default_rng(draw.randrange(2**32))
    time, at = np.arange(samples), draw.randrange(samples)
    wave = {
        "silence": lambda: np.zeros(samples),
        "impulse": lambda: (time == at).astype(float),
        "constant": lambda: np.ones(samples),
        "noise": lambda: generator.standard_normal(samples).clip(-1, 1),
        "tone": lambda: np.sin(time * draw.choice((1e-4, 0.1, 1.0, 3.1))),
        "step": lambda: (time >= at).astype(float),
        "bursts": lambda: generator.standard_normal(samples).clip(-1, 1) * (np.sin(time / 300.0) > 0),
    }[shape]()
    return torch.from_numpy(draw.choice((1.0, 1.0, -1.0)) * draw.choice(LEVELS) * wave)


class Case:
    """A batch, its reference and an ear."""

    def __init__(self, draw: Random, longest: int, shortest: int = 1) -> None:
        self.samples = draw.choice(
            (shortest, draw.randint(shortest, longest), draw.randint(shortest, longest))
        )
        self.kind = draw.choice((torch.float32, torch.float32, torch.float64))
        items = draw.choice((1, 1, 3))
        self.given, self.clean = (
            torch.stack([signal(draw, self.samples) for _ in range(items)]).to(self.kind) for _ in range(2)
        )
        self.ear, self.choice = draw.choice(EARS), draw.random()

    def __repr__(self) -> str:
        peaks = [f"{float(one.abs().max()):.3g}" for one in (*self.given, *self.clean)]
        return f"{self.samples} samples, {self.kind}, {self.ear}, choice {self.choice:.4f}, peaks {', '.join(peaks)}"


@cache
def module(name: str) -> Callable[..., Tensor]:
    if name == "msbg":
        return MSBG(sample_rate=16000)
    if name in ("nalr", "wdrc", "hearing-aid", "compensator-general"):
        return load_compensator(name)
    if name.startswith("neuro"):
        return load_pretrained(name)
    criterion, simulator = name.split(" of ")
    return HearingLossLoss(criterion=criterion, simulator=simulator)


def check(name: str, case: Case) -> None:
    model, ear = module(name), Audiogram.standard(case.ear)
    given = case.given.clone().requires_grad_()
    if name == "hearing-aid":  # it takes the kind of its weights alone
        given = case.given.float().requires_grad_()
    out = model(given, case.clean, ear) if " of " in name else model(given, ear)
    assert bool(torch.isfinite(out).all()), "not finite"
    assert " of " in name or out.shape == given.shape, "another shape"
    if out.requires_grad:  # an ear without loss may get what there was
        (out.sum() if out.ndim else out).backward()
        assert given.grad is not None and bool(torch.isfinite(given.grad).all()), "gradient not finite"


def run(bench: Any, kind: str, names: tuple[str, ...], share: float) -> None:
    def attempt(given: tuple[str, Case]) -> None:
        check(*given)

    bench.run(kind, lambda draw: (draw.choice(names), Case(draw, 4000)), attempt, share=share)


def test_simulators(bench: Any) -> None:
    run(bench, "numerics of simulators", ("msbg", "neuro-msbg", "neuro-msbg-lstm"), 1.0)


def test_compensators(bench: Any) -> None:
    run(bench, "numerics of compensators", ("nalr", "wdrc", "hearing-aid", "compensator-general"), 1.0)


def test_losses(bench: Any) -> None:
    pairs = [(c, s) for c in ("coherent-bands", "bands", "paper") for s in ("msbg", "neuro-msbg")]
    run(bench, "numerics of losses", tuple(f"{c} of {s}" for c, s in pairs), 1.0)


def test_metrics(bench: Any) -> None:
    def attempt(case: Case) -> None:
        measure = haspi if case.choice < 0.5 else hasqi
        given = case.given.clone().requires_grad_()
        score = measure(given, case.clean, Audiogram.standard(case.ear))
        assert (
            bool(torch.isfinite(score).all()) and bool((score >= -1e-3).all()) and bool((score <= 1.1).all())
        )
        score.sum().backward()
        assert given.grad is not None and bool(torch.isfinite(given.grad).all()), "gradient not finite"

    def make(draw: Random) -> Case:
        shortest = draw.choice((1, 11200, 11200, 11200))  # 0.7 s, of which there is a score
        case = Case(draw, 12000, shortest)
        if draw.random() < 0.7:  # speech's place is taken by noise that can be heard
            case.clean = 0.05 * torch.randn(case.clean.shape, generator=torch.Generator().manual_seed(0))
        return case

    bench.run("numerics of metrics", make, attempt, share=0.5)


@pytest.mark.parametrize(("name", "pascals"), [("msbg", 1e9), ("neuro-msbg", 1e6), ("neuro-msbg", 1e9)])
@pytest.mark.parametrize("ear", ["N1", "N4", "S3"])
def test_a_constant_beside_which_all_other_frequencies_are_silent(
    name: str, pascals: float, ear: str
) -> None:
    case = Case(Random(0), 1)
    case.given, case.ear = torch.full((1, 2000), pascals), ear
    check(name, case)
