"""Measures: scores of speech for an ear, levels, perceived sound, and measures of your own.

A measure is a function of an item and an output that returns numbers by column.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL, level_spl
from hlsim.checks import loud_outputs
from hlsim.evaluation.fingerprint import fingerprint
from hlsim.evaluation.study import Item, Measure, Values
from hlsim.extras import require
from hlsim.losses.band_levels import (
    audibility_threshold,
    audibility_weights,
    band_level_loss,
    band_levels,
)
from hlsim.metrics import fidelity
from hlsim.metrics.haaqi_score import haaqi
from hlsim.metrics.haspi_score import haspi
from hlsim.metrics.hasqi_score import hasqi
from hlsim.msbg import MSBG
from hlsim.plugins import load_plugin

NORMAL = Audiogram.standard("NH")
"""The normal ear."""


def _ear_measure(name: str, score: Callable[..., Tensor], rewards_gain: bool = False) -> Measure:
    """Return the measure of HASPI, HASQI or HAAQI."""
    return Measure(
        name,
        partial(_score_for_ear, name, score),
        title=name.upper(),
        packages=["numpy"],  # which draws the noise
        knows_hearing=True,
        rewards_gain=rewards_gain,
        ends=(0.0, 1.0),
    )


def _score_for_ear(name: str, score: Callable[..., Tensor], item: Item, output: Tensor) -> Values:
    """Compute a score with the noise and the whole kHz of pyclarity.

    Single precision takes half the time, but may align a channel differently by one sample.
    """
    options: dict[str, Any] = {"sample_rate": item.sample_rate, "seed": item.seed}
    options |= {"full_scale_spl": item.full_scale_spl, "noise": "seeded", "whole_khz": True}
    return {name: float(score(output.double(), item.clean.double(), item.ear, **options))}


def _score_signal(
    name: str, score: Callable[..., fidelity.Score], item: Item, output: Tensor
) -> Values:
    """Compute STOI or PESQ, which do not depend on the ear."""
    value, reason = score(item.clean, output, item.sample_rate)
    if value is None:
        raise ValueError(reason)
    return {name: value}


STOI = Measure(
    "stoi",
    partial(_score_signal, "stoi", fidelity.stoi),
    title="STOI",
    packages=["pystoi", "numpy", "scipy"],
    ends=(0.0, 1.0),
)

PESQ = Measure(
    "pesq",
    partial(_score_signal, "pesq", fidelity.pesq_wb),
    title="PESQ",
    packages=["pesq", "numpy"],
    ends=(1.0, 4.64),
)

MEASURES = {
    "haspi": _ear_measure("haspi", haspi, rewards_gain=True),
    "hasqi": _ear_measure("hasqi", hasqi),
    "haaqi": _ear_measure("haaqi", haaqi),
    "stoi": STOI,
    "pesq": PESQ,
}
"""The scores of ``--measures`` by name. Higher is better for all of them."""

PACKAGES = {"stoi": ("pystoi", "eval"), "pesq": ("pesq", "pesq")}
"""Optional package of a measure, and the extra that installs it."""


def find_measures(names: Iterable[str]) -> list[Measure]:
    """Return measures by name, without duplicates.

    Args:
        names: Names in ``MEASURES``, or ``package.module:name``.

    Raises:
        ValueError: There is no such measure, or no name at all.
        MissingExtraError: The package of a measure is not installed.

    >>> [measure.title for measure in find_measures(["haspi", "hasqi", "haspi"])]
    ['HASPI', 'HASQI']
    """
    unique = list(dict.fromkeys(names))
    if not unique:
        raise ValueError(f"no measure is named; name one or more of {', '.join(MEASURES)}")
    for name in unique:
        if name in PACKAGES:
            require(*PACKAGES[name])
        elif name not in MEASURES and ":" not in name:
            raise ValueError(
                f"there is no measure {name!r}; expected one of {', '.join(MEASURES)} or "
                "package.module:name"
            )
    return [MEASURES[name] if name in MEASURES else load_measure(name) for name in unique]


class PluginMeasure:
    """Function ``(item, output) -> numbers`` of a user, ``package.module:name``.

    It is pickled by its name, so that other processes import it in the same way.

    >>> PluginMeasure("builtins:max").name
    'builtins:max'
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.function = load_plugin(name, "measure")

    def __reduce__(self) -> Any:
        return PluginMeasure, (self.name,)

    def __call__(self, item: Item, output: Tensor) -> Values:
        values = self.function(item, output)
        if not isinstance(values, Mapping):
            raise ValueError(f"measure {self.name} returned {values!r}; expected a dict of numbers")
        return {str(column): float(value) for column, value in values.items()}


def load_measure(name: str) -> Measure:
    """Load the measure ``package.module:name``.

    Raises:
        ValueError: It cannot be loaded.

    >>> load_measure("builtins:max").name
    'builtins:max'
    """
    plugin = PluginMeasure(name)
    return Measure(name, plugin, settings=fingerprint(plugin.function))


def title_of(column: str) -> str:
    """Return the title of a score's column.

    >>> title_of("haspi"), title_of("crest factor")
    ('HASPI', 'crest factor')
    """
    if column in MEASURES:
        return MEASURES[column].title
    return "SNR (dB)" if column == "snr" else column


def _measure_levels(item: Item, output: Tensor) -> Values:
    return {
        "level": float(level_spl(output, item.full_scale_spl)),
        "clean_level": float(level_spl(item.clean, item.full_scale_spl)),
        "full_scale_spl": item.full_scale_spl,
        "seconds": item.clean.shape[-1] / item.sample_rate,
        "sample_rate": item.sample_rate,
        "seed": item.seed,
    }


LEVELS = Measure("levels", _measure_levels)
"""RMS levels of output and clean speech in dB SPL, and the settings of the item."""


def perceive(signal: Tensor, ear: Audiogram, sample_rate: int) -> Tensor:
    """Simulate what an ear perceives, by the exact MSBG.

    Shape: (time,) -> (time,), in pascals.

    >>> perceive(torch.ones(1600), Audiogram.standard("N3"), 16000).shape
    torch.Size([1600])
    """
    with torch.no_grad(), loud_outputs():
        perceived: Tensor = MSBG(sample_rate=sample_rate)(signal, ear)
    return perceived


def _measure_perception(item: Item, output: Tensor) -> Values:
    rate = item.sample_rate
    reference = item.once("normal clean", lambda: perceive(item.clean, NORMAL, rate))
    normal_input = item.once("normal input", lambda: perceive(item.signal, NORMAL, rate))
    perceived = perceive(output, item.ear, rate)
    level = float(level_spl(perceived))
    normal_level = float(level_spl(normal_input))
    normal_clean_level = float(level_spl(reference))
    return {
        "peak": peak_spl(output),
        "perceived_level": level,
        "normal_level": normal_level,
        "normal_clean_level": normal_clean_level,
        "loudness_error": level - normal_level,
        "loudness_error_clean": level - normal_clean_level,
        "band_error": band_error_db(perceived, reference, rate),
        "loss_msbg": float(band_level_loss(perceived, reference, rate)),
    }


PERCEPTION = Measure("perception", _measure_perception, packages=["hlsim"])
"""Levels and band levels of an output as perceived through the exact MSBG, in dB SPL or dB.

``peak`` is the largest sample of the output, and ``perceived_level`` the level after MSBG.
``normal_level`` and ``normal_clean_level`` are the levels of the input (with its noise) and of the
clean speech for a normal ear; ``loudness_error`` and ``loudness_error_clean`` are the differences
from them. ``band_error`` and ``loss_msbg`` compare with the clean speech for a normal ear, by
``band_error_db`` and by ``HearingLossLoss(criterion="bands")``.
"""

OTHER_COLUMNS = (
    *("level", "clean_level", "full_scale_spl", "seconds", "sample_rate", "seed"),
    *("peak", "perceived_level", "normal_level", "normal_clean_level", "band_error"),
    *("loss_msbg", "loss_neuro", "loudness_error", "loudness_error_clean"),
    *("beyond_limit", "gap", "source"),
)
"""Columns of measures that are no scores."""


def network_loss(simulator: nn.Module) -> Measure:
    """Return the measure ``loss_neuro``: the loss of ``loss_msbg`` with a network as simulator.

    >>> network_loss(nn.Identity()).name
    'network loss'
    """

    def compute(item: Item, output: Tensor) -> Values:
        reference = item.once("normal by network", lambda: simulator(item.clean, NORMAL))
        perceived = simulator(output, item.ear)
        return {"loss_neuro": float(band_level_loss(perceived, reference, item.sample_rate))}

    return Measure("network loss", compute, packages=["hlsim"], settings=fingerprint(simulator))


def peak_spl(waveform: Tensor) -> float:
    """Compute the level of the largest sample in dB SPL, where a sample of 1.0 is 94.

    >>> peak_spl(torch.tensor([0.0, -10.0]))
    114.0
    """
    return float(20.0 * waveform.abs().max().clamp_min(1e-10).log10()) + PASCAL_SPL


def band_error_db(perceived: Tensor, reference: Tensor, sample_rate: int) -> float:
    """Compute the median absolute difference of band levels in dB.

    Only bands and frames of the reference that are audible for a normal ear count.

    Shape: (time,) and (time,), in pascals.

    Raises:
        ValueError: Nothing is audible.

    >>> noise = torch.randn(16000, generator=torch.Generator().manual_seed(0))
    >>> round(band_error_db(0.1 * noise, noise, 16000))
    20
    """
    levels = band_levels(perceived, sample_rate)
    reference_levels = band_levels(reference, sample_rate)
    audible = audibility_weights(reference_levels, audibility_threshold(reference_levels)) > 0.0
    if not bool(audible.any()):
        raise ValueError("a normal ear finds nothing of the clean speech audible")
    return float((levels - reference_levels).abs()[audible].double().quantile(0.5))
