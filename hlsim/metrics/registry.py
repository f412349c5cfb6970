"""The measures of a report: HASPI and HASQI version 2, STOI and PESQ."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from importlib import metadata
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.checks import check_names
from hlsim.extras import require
from hlsim.metrics import fidelity
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import Signal, check_pair
from hlsim.version import __version__


class Measure(NamedTuple):
    """Name, properties and function of a measure.

    Attributes:
        title: Name in tables.
        needs: Module that must be installed, and the extra that installs it.
        packages: Packages whose versions scores depend on.
        of_an_ear: Whether a score depends on audiogram, level and seed. STOI and PESQ compare the
            output with clean speech, whatever the ear.
        rewards_gain: Whether a higher level alone raises the score.
        score: Function of (clean, processed, audiogram, sample rate in Hz, full_scale_spl, seed),
            which raises ValueError if there is no score.
        revision: Version of the computation, to be raised when scores change.
    """

    title: str
    needs: tuple[str, str] | None
    packages: tuple[str, ...]
    of_an_ear: bool
    rewards_gain: bool
    score: Callable[[Signal, Signal, Audiogram, int, float, int], float]
    revision: int = 1


def _score_for_ear(
    score: Callable[..., Tensor],
    clean: Signal,
    processed: Signal,
    ear: Audiogram,
    rate: int,
    full_scale_spl: float,
    seed: int,
) -> float:
    """Compute HASPI or HASQI with pyclarity's noise and its rates in whole kHz.

    In double precision: single precision takes half the time, but may align a channel by another
    sample.
    """
    reference, output = map(torch.from_numpy, check_pair(clean, processed, rate, full_scale_spl))
    options: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl, "seed": seed}
    with torch.no_grad():
        return float(score(output, reference, ear, **options, noise="seeded", whole_khz=True))


def _score_of_signal(
    name: str, clean: Signal, processed: Signal, ear: Audiogram, rate: int, *level_and_seed: float
) -> float:
    """Compute ``stoi`` or ``pesq_wb`` of ``fidelity``."""
    value, reason = getattr(fidelity, name)(clean, processed, rate)
    if value is None:
        raise ValueError(reason)
    return float(value)


MeasureName = Literal["haspi", "hasqi", "stoi", "pesq"]

MEASURES: dict[str, Measure] = {
    "haspi": Measure("HASPI", None, ("numpy",), True, True, partial(_score_for_ear, haspi)),
    "hasqi": Measure("HASQI", None, ("numpy",), True, False, partial(_score_for_ear, hasqi)),
    "stoi": Measure(
        "STOI",
        ("pystoi", "eval"),
        ("pystoi", "numpy", "scipy"),
        False,
        False,
        partial(_score_of_signal, "stoi"),
    ),
    "pesq": Measure(
        "PESQ",
        ("pesq", "pesq"),
        ("pesq", "numpy"),
        False,
        False,
        partial(_score_of_signal, "pesq_wb"),
    ),
}
"""Measures by the names that options and files use. Higher is better; the best PESQ is 4.64, of all others 1."""


def check_measures(names: Iterable[MeasureName]) -> tuple[MeasureName, ...]:
    """Return the names without repetitions.

    Raises:
        ValueError: A name is unknown, or there is none.
        MissingExtraError: A package that a measure needs is not installed.
    """
    chosen = tuple(dict.fromkeys(names))
    check_names(chosen, MEASURES, "measures")
    if not chosen:
        raise ValueError(f"no measure given, expected one or more of {', '.join(MEASURES)}")
    for name in chosen:
        needs = MEASURES[name].needs
        if needs is not None:
            require(*needs)
    return chosen


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Versions of the packages that scores of these measures depend on."""
    packages = dict.fromkeys(package for name in names for package in MEASURES[name].packages)
    return {package: version_of(package) for package in packages}


def version_of(package: str) -> str:
    """Version of a package, or ``not installed``."""
    if package == "hlsim":
        return __version__  # also when it runs from a source tree
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
