"""The measures that a report can hold: HASPI v2 and HASQI v2, by hlsim or by pyclarity, and STOI and PESQ."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from importlib import metadata
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.checks import check_choice, refuse_unknown
from hlsim.extras import require
from hlsim.metrics import fidelity
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import Signal, check_pair
from hlsim.metrics.pyclarity import pyclarity_score
from hlsim.version import __version__

Engine = Literal["hlsim", "pyclarity"]
"""What computes HASPI and HASQI: hlsim in torch, with pyclarity's figures, or pyclarity itself."""


class Measure(NamedTuple):
    """How a measure is named and computed.

    ``needs``, a module and its extra, must be installed, and scores depend on the versions of ``packages`` and on the
    ``revision`` of hlsim's part: to be raised where that changes a score. Whether audiogram, level and seed change it is
    ``of_an_ear``: STOI and PESQ compare the signal at the ear with the clean speech, and do not say what is heard.
    ``rewards_gain``: more level alone brings a higher score. ``score`` is of (clean, processed, audiogram, rate in Hz,
    full_scale_spl, seed), and raises ValueError where there is none. ``engine`` is the ``Engine`` that computes
    it, empty where there is no choice.
    """

    title: str
    needs: tuple[str, str] | None
    packages: tuple[str, ...]
    of_an_ear: bool
    rewards_gain: bool
    score: Callable[[Signal, Signal, Audiogram, int, float, int], float]
    engine: Engine | Literal[""] = ""
    revision: int = 1


def _of_ear(
    score: Callable[..., Tensor],
    clean: Signal,
    processed: Signal,
    ear: Audiogram,
    rate: int,
    full_scale_spl: float,
    seed: int,
) -> float:
    """``haspi`` or ``hasqi`` with pyclarity's noise and its rates in whole kHz.

    In double precision: single precision takes half the time, but may align a channel by another sample.
    """
    reference, given = map(torch.from_numpy, check_pair(clean, processed, rate, full_scale_spl))
    options: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl, "seed": seed}
    with torch.no_grad():
        return float(score(given, reference, ear, **options, noise="seeded", whole_khz=True))


def _of_signals(
    name: str, clean: Signal, processed: Signal, ear: Audiogram, rate: int, *level_and_seed: float
) -> float:
    """``stoi`` or ``pesq_wb`` of ``fidelity``, of the signal at the ear."""
    value, reason = getattr(fidelity, name)(clean, processed, rate)
    if value is None:
        raise ValueError(reason)
    return float(value)


# numpy draws the noise
_HASPI = Measure("HASPI", None, ("numpy",), True, True, partial(_of_ear, haspi), "hlsim")
_HASQI = Measure("HASQI", None, ("numpy",), True, False, partial(_of_ear, hasqi), "hlsim")
_STOI, _PESQ = ("pystoi", "numpy", "scipy"), ("pesq", "numpy")

MeasureName = Literal["haspi", "hasqi", "stoi", "pesq"]

MEASURES: dict[str, Measure] = {
    "haspi": _HASPI,
    "hasqi": _HASQI,
    "stoi": Measure("STOI", ("pystoi", "eval"), _STOI, False, False, partial(_of_signals, "stoi")),
    "pesq": Measure("PESQ", ("pesq", "pesq"), _PESQ, False, False, partial(_of_signals, "pesq_wb")),
}
"""By the names that options and files use. Higher is better in all: HASPI, HASQI and STOI end at 1, PESQ at 4.64."""

_PYCLARITYS = {
    name: measure._replace(
        needs=("clarity", "pyclarity"),
        packages=("pyclarity", "numpy", "scipy"),
        score=partial(pyclarity_score, name),
        engine="pyclarity",
    )
    for name, measure in (("haspi", _HASPI), ("hasqi", _HASQI))
}


def measure_by(engine: Engine, name: str) -> Measure:
    """A measure of ``MEASURES``; HASPI and HASQI by this engine."""
    return _PYCLARITYS.get(name, MEASURES[name]) if engine == "pyclarity" else MEASURES[name]


def check_measures(
    names: Iterable[MeasureName], engine: Engine = "hlsim"
) -> tuple[MeasureName, ...]:
    """The names, each once, or ValueError with those that are allowed; MissingExtraError where a package lacks."""
    chosen = tuple(dict.fromkeys(names))
    refuse_unknown(chosen, MEASURES, "measures")
    if not chosen:
        raise ValueError(f"no measure; allowed: {', '.join(MEASURES)}")
    check_choice("engine", engine, Engine)
    for name in chosen:
        if needs := measure_by(engine, name).needs:
            require(*needs)
    return chosen


def versions_of(names: Iterable[str], engine: Engine = "hlsim") -> dict[str, str]:
    """Versions of the packages that the scores of these measures depend on."""
    packages = dict.fromkeys(
        package for name in names for package in measure_by(engine, name).packages
    )
    return {package: version_of(package) for package in packages}


def version_of(package: str) -> str:
    """An installed package's version, or that it is not installed; hlsim's own also where it runs from its sources."""
    if package == "hlsim":
        return __version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
