"""The measures: scores of speech for an ear, levels, what an ear perceives, and closeness to a teacher.

A measure is a function of an item and an output that returns numbers. ``--measure package.module:name`` adds
anyone's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL, level_spl
from hlsim.evaluation.fingerprint import fingerprint
from hlsim.evaluation.study import Item, Measure, Values
from hlsim.extras import require
from hlsim.losses.band_levels import audibility, band_level_loss, band_levels, least_audible
from hlsim.metrics import fidelity
from hlsim.metrics.haaqi_score import haaqi
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.metrics.pair import check_pair
from hlsim.msbg import MSBG
from hlsim.plugins import load_plugin

NORMAL = Audiogram.standard("NH")


def _score_for_ear(name: str, score: Callable[..., Tensor], item: Item, output: Tensor) -> Values:
    """Compute HASPI, HASQI or HAAQI with the noise and the whole kHz of pyclarity.

    In double precision: single precision takes half the time, but may align a channel by another sample.
    """
    samples = check_pair(item.clean, output, item.sample_rate, item.full_scale_spl)
    clean, processed = map(torch.from_numpy, samples)
    options: dict[str, Any] = {"sample_rate": item.sample_rate, "seed": item.seed}
    options |= {"full_scale_spl": item.full_scale_spl, "noise": "seeded", "whole_khz": True}
    return {name: float(score(processed, clean, item.ear, **options))}


def _score_of_signal(name: str, function: str, item: Item, output: Tensor) -> Values:
    """Compute STOI or PESQ of the output, whatever the ear."""
    value, reason = getattr(fidelity, function)(item.clean, output, item.sample_rate)
    if value is None:
        raise ValueError(reason)
    return {name: value}


MEASURES = {
    measure.name: measure
    for measure in (
        Measure(
            "haspi",
            partial(_score_for_ear, "haspi", haspi),
            title="HASPI",
            packages=["numpy"],  # draws the noise
            knows_hearing=True,
            rewards_gain=True,
            ends=(0.0, 1.0),
        ),
        Measure(
            "hasqi",
            partial(_score_for_ear, "hasqi", hasqi),
            title="HASQI",
            packages=["numpy"],
            knows_hearing=True,
            ends=(0.0, 1.0),
        ),
        Measure(
            "haaqi",
            partial(_score_for_ear, "haaqi", haaqi),
            title="HAAQI",
            packages=["numpy"],
            knows_hearing=True,
            ends=(0.0, 1.0),
        ),
        Measure(
            "stoi",
            partial(_score_of_signal, "stoi", "stoi"),
            title="STOI",
            packages=["pystoi", "numpy", "scipy"],
            ends=(0.0, 1.0),
        ),
        Measure(
            "pesq",
            partial(_score_of_signal, "pesq", "pesq_wb"),
            title="PESQ",
            packages=["pesq", "numpy"],
            ends=(1.0, 4.64),
        ),
    )
}
"""The scores of ``--measures`` by name. More is better in all of them."""

_NEEDS = {"stoi": ("pystoi", "eval"), "pesq": ("pesq", "pesq")}


def find_measures(names: Iterable[str]) -> list[Measure]:
    """Return measures by name: those of ``MEASURES`` and ``package.module:name``, each once.

    Raises:
        ValueError: there is no such measure, or no name at all.
        MissingExtraError: the package of a measure is not installed.
    """
    chosen = list(dict.fromkeys(names))
    if not chosen:
        raise ValueError(f"no measure is named; name one or more of {', '.join(MEASURES)}")
    for name in chosen:
        if name in _NEEDS:
            require(*_NEEDS[name])
    return [load_measure(name) if ":" in name else _built_in(name) for name in chosen]


class PluginMeasure:
    """A measure of anyone's, ``package.module:name``: a function ``(item, output) -> numbers``.

    It is pickled by its name, so that other processes import it as this one did.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.function = load_plugin(name, "measure")
        if not callable(self.function):
            raise ValueError(f"measure {name} is not callable; expected (item, output) -> dict")

    def __reduce__(self) -> Any:
        return PluginMeasure, (self.name,)

    def __call__(self, item: Item, output: Tensor) -> Values:
        values = self.function(item, output)
        if not isinstance(values, Mapping):
            raise ValueError(f"measure {self.name} returned {values!r}; expected a dict of numbers")
        return {str(column): float(value) for column, value in values.items()}


def load_measure(name: str) -> Measure:
    """Return the measure ``package.module:name``; ValueError if it cannot be loaded."""
    plugin = PluginMeasure(name)
    return Measure(name, plugin, settings=fingerprint(plugin.function))


def title_of(column: str) -> str:
    """Return the title of a score's column."""
    if column in MEASURES:
        return MEASURES[column].title
    return "SNR (dB)" if column == "snr" else column


def _built_in(name: str) -> Measure:
    if name not in MEASURES:
        raise ValueError(
            f"there is no measure {name!r}; expected one of {', '.join(MEASURES)} or package.module:name"
        )
    return MEASURES[name]


def _levels(item: Item, output: Tensor) -> Values:
    return {
        "level": float(level_spl(output, item.full_scale_spl)),
        "clean_level": float(level_spl(item.clean, item.full_scale_spl)),
        "full_scale_spl": item.full_scale_spl,
        "seconds": item.clean.shape[-1] / item.sample_rate,
        "sample_rate": item.sample_rate,
        "seed": item.seed,
    }


LEVELS = Measure("levels", _levels)
"""RMS levels of output and clean speech in dB SPL, and the settings of the item."""


def perceive(signal: Tensor, ear: Audiogram, sample_rate: int) -> Tensor:
    """Return what an ear perceives, by the exact MSBG. Shape: (time,) in pascals -> (time,)."""
    with torch.no_grad():
        perceived: Tensor = MSBG(sample_rate=sample_rate)(signal, ear)
    return perceived


def _perception(item: Item, output: Tensor) -> Values:
    rate = item.sample_rate
    reference = item.once("normal clean", lambda: perceive(item.clean, NORMAL, rate))
    normal_input = item.once("normal input", lambda: perceive(item.signal, NORMAL, rate))
    perceived = perceive(output, item.ear, rate)
    level = float(level_spl(perceived))
    normal, normal_clean = float(level_spl(normal_input)), float(level_spl(reference))
    return {
        "peak": peak_spl(output),
        "perceived_level": level,
        "normal_level": normal,
        "normal_clean_level": normal_clean,
        "loudness_error": level - normal,
        "loudness_error_clean": level - normal_clean,
        "band_error": band_error_db(perceived, reference, rate),
        "loss_msbg": float(band_level_loss(perceived, reference, rate)),
    }


PERCEPTION = Measure("perception", _perception, packages=["hlsim"])
"""Levels and band levels of an output as perceived through the exact MSBG, in dB SPL or dB.

``peak`` is the largest sample of the output; ``perceived_level`` the level after MSBG, ``normal_level`` that of
the input for a normal ear, noise included, ``normal_clean_level`` that of the clean speech for a normal ear;
``loudness_error`` and ``loudness_error_clean`` are the differences from them. ``band_error`` compares with the
clean speech for a normal ear by ``band_error_db``, ``loss_msbg`` by ``HearingLossLoss(criterion="bands")``.
"""

OTHER_COLUMNS = (
    *("level", "clean_level", "full_scale_spl", "seconds", "sample_rate", "seed"),
    *("peak", "perceived_level", "normal_level", "normal_clean_level", "band_error"),
    *("loss_msbg", "loss_neuro", "loudness_error", "loudness_error_clean"),
    *("beyond_limit", "gap", "source"),
)
"""Columns of built-in measures that are no scores."""


def network_loss(simulator: nn.Module) -> Measure:
    """Return the measure ``loss_neuro``: the loss of ``loss_msbg`` with a network in MSBG's place."""

    def compute(item: Item, output: Tensor) -> Values:
        reference = item.once("normal by network", lambda: simulator(item.clean, NORMAL))
        perceived = simulator(output, item.ear)
        return {"loss_neuro": float(band_level_loss(perceived, reference, item.sample_rate))}

    return Measure("network loss", compute, packages=["hlsim"], settings=fingerprint(simulator))


def peak_spl(waveform: Tensor) -> float:
    """Return the largest sample in dB SPL, where a sample of 1.0 is 94. Shape: (time,)."""
    return float(20.0 * waveform.abs().max().clamp_min(1e-10).log10()) + PASCAL_SPL


def band_error_db(perceived: Tensor, reference: Tensor, sample_rate: int) -> float:
    """Return the median absolute difference of band levels in dB.

    The bands and frames that a normal ear finds audible count.

    Shape: (time,) and (time,), in pascals. Raises ValueError if nothing is audible.
    """
    levels = band_levels(perceived, sample_rate)
    reference_levels = band_levels(reference, sample_rate)
    audible = audibility(reference_levels, least_audible(reference_levels)) > 0.0
    if not bool(audible.any()):
        raise ValueError("a normal ear finds nothing of the clean speech audible")
    return float((levels - reference_levels).abs()[audible].double().quantile(0.5))
