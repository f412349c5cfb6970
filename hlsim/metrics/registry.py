"""The measures that a report can hold: HASPI v2, HASQI v2, STOI and PESQ, each by the library that defines it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from importlib import metadata
from typing import NamedTuple

import numpy as np

import hlsim
from hlsim.audiogram import Audiogram
from hlsim.checks import refuse_unknown
from hlsim.extras import require
from hlsim.metrics import fidelity
from hlsim.metrics.pyclarity import pyclarity_score


class Measure(NamedTuple):
    """How a measure is named and computed.

    ``module`` must be installed (extra ``eval``), and scores depend on the versions of ``packages``. Whether audiogram,
    level and seed change the score is ``of_an_ear``: STOI and PESQ compare the signal at the ear with the clean speech,
    and do not say what is heard. ``rewards_gain``: more level alone brings a higher score. ``score`` is of (clean,
    processed, audiogram, rate in Hz, full_scale_spl, seed), and raises ValueError where there is none.
    """

    title: str
    module: str
    packages: tuple[str, ...]
    of_an_ear: bool
    rewards_gain: bool
    score: Callable[[np.ndarray, np.ndarray, Audiogram, int, float, int], float]


def _of_signals(
    name: str, clean: np.ndarray, processed: np.ndarray, ear: Audiogram, rate: int, *level_and_seed: float
) -> float:
    """``stoi`` or ``pesq_wb`` of ``fidelity``, of the signal at the ear."""
    value, reason = getattr(fidelity, name)(clean, processed, rate)
    if value is None:
        raise ValueError(reason)
    return float(value)


_CLARITY = ("pyclarity", "numpy", "scipy")

MEASURES = {
    "haspi": Measure("HASPI", "clarity", _CLARITY, True, True, partial(pyclarity_score, "haspi")),
    "hasqi": Measure("HASQI", "clarity", _CLARITY, True, False, partial(pyclarity_score, "hasqi")),
    "stoi": Measure(
        "STOI", "pystoi", ("pystoi", "numpy", "scipy"), False, False, partial(_of_signals, "stoi")
    ),
    "pesq": Measure(
        "PESQ", "pesq", ("pesq", "numpy", "torchaudio"), False, False, partial(_of_signals, "pesq_wb")
    ),
}
"""By the names that options and files use. Higher is better in all: HASPI, HASQI and STOI end at 1, PESQ at 4.64."""


def check_measures(names: Iterable[str]) -> tuple[str, ...]:
    """The names, each once, or ValueError with those that are allowed; MissingExtraError where a package lacks."""
    chosen = tuple(dict.fromkeys(names))
    refuse_unknown(chosen, MEASURES, "measures")
    if not chosen:
        raise ValueError(f"no measure; allowed: {', '.join(MEASURES)}")
    for name in chosen:
        require(MEASURES[name].module, "eval")
    return chosen


def versions_of(names: Iterable[str]) -> dict[str, str]:
    """Versions of the packages that the scores of these measures depend on."""
    packages = dict.fromkeys(package for name in names for package in MEASURES[name].packages)
    return {package: version_of(package) for package in packages}


def version_of(package: str) -> str:
    """An installed package's version, or that it is not installed; hlsim's own also where it runs from its sources."""
    if package == "hlsim":
        return hlsim.__version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
