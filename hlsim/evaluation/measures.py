"""Measures of a study: scores of speech for an ear, levels, loudness errors, and your own.

A measure is a function of an ``Item`` and of the output of a condition. It returns a dict from
columns of the study's table to values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import Audiogram
from hlsim.calibration import PASCAL_SPL, level_spl
from hlsim.checks import check_names, loud_outputs
from hlsim.dsp.fft import correlate
from hlsim.evaluation.running.fingerprint import fingerprint, value_hash
from hlsim.evaluation.study import Item, Measure, Values
from hlsim.extras import require
from hlsim.metrics import fidelity
from hlsim.metrics.band_levels import (
    audibility_threshold,
    audibility_weights,
    band_level_loss,
    band_levels,
)
from hlsim.metrics.haaqi_score import HaaqiReference
from hlsim.metrics.haspi_score import HaspiReference
from hlsim.metrics.hasqi_score import HasqiReference
from hlsim.plugins import load_plugin
from hlsim.simulators import EXACT, load_simulator
from hlsim.torchtools import compute_once

CORRELATION_FLOOR = 0.2
"""Largest magnitude of the correlation coefficient at which the lag of an output is unknown."""

NORMAL = Audiogram.standard("NH")
"""The normal ear, whose perception is the goal of an aid."""

PRECISIONS = {32: torch.float32, 64: torch.float64}
"""Number types in which HASPI, HASQI and HAAQI can be computed, by their number of bits.

64 bits take twice the time, and give the digits of pyclarity.
"""


@dataclass(frozen=True)
class _CleanSignal:
    """Clean signal that is hashable, so that it can be an argument of ``compute_once``.

    Two clean signals are equal if their digests are.

    Attributes:
        digest: Hash of the samples and of their number type.
        samples: The samples. Shape: (time,).
    """

    digest: str
    samples: Tensor = field(compare=False)


REFERENCES: dict[str, Callable[..., Any]] = {
    "haspi": HaspiReference,
    "hasqi": HasqiReference,
    "haaqi": HaaqiReference,
}
"""Classes that prepare a clean signal for the scores of its outputs, by the name of the score."""


@compute_once
def _prepare(
    score: str, clean: _CleanSignal, sample_rate: int, full_scale_spl: float, *ear: Audiogram
) -> Any:
    """Prepare a clean signal once for all conditions, and for HASPI also for all ears.

    Args:
        score: Name of the score, one of ``REFERENCES``.
        clean: Clean signal.
        sample_rate: Sample rate in Hz.
        full_scale_spl: Level in dB SPL of a signal whose RMS is 1.0.
        ear: The ear of the item for HASQI and HAAQI; nothing for HASPI.

    Returns: An object of the class in ``REFERENCES``, whose method ``score`` scores an output.
    """
    settings = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl, "whole_khz": True}
    return REFERENCES[score](clean.samples, *ear, **settings)


def _score_for_ear(name: str, precision: torch.dtype, item: Item, output: Tensor) -> Values:
    """Compute HASPI, HASQI or HAAQI of an output, (time,), as a dict with the one column ``name``.

    As in pyclarity, the ear's internal noise is drawn, with the seed of the item, and the sample
    rate is rounded to whole kHz. ``precision`` is the number type of the computation.
    """
    samples = item.clean.to(precision)
    clean = _CleanSignal(value_hash(samples), samples)
    # HASPI compares with the clean signal in a normal ear, the others with that in the item's ear.
    prepared_ear, scored_ear = ([], [item.ear]) if name == "haspi" else ([item.ear], [])
    reference = _prepare(name, clean, item.sample_rate, item.full_scale_spl, *prepared_ear)
    score = reference.score(output.to(precision), *scored_ear, noise="seeded", seed=item.seed)
    return {name: float(score)}


def _score_signal(name: str, score: Callable[..., Any], item: Item, output: Tensor) -> Values:
    """Compute STOI or PESQ of an output, (time,), as a dict with the one column ``name``.

    ``score`` is the function of output, clean speech and sample rate in Hz. It ignores the ear.
    """
    return {name: score(output, item.clean, item.sample_rate)}


def _ear_measure(name: str, bits: int = 32) -> Measure:
    """Return the measure that computes HASPI, HASQI or HAAQI with 32 or 64 bits.

    The number of bits is part of the key of stored scores.
    """
    compute = partial(_score_for_ear, name, PRECISIONS[bits])
    packages = ["numpy"]  # NumPy draws the ear's noise.
    return Measure(name, compute, packages, f"{bits} bits", uses_facts=False, scores=[name])


MEASURES = {
    **{name: _ear_measure(name) for name in REFERENCES},
    "stoi": Measure(
        "stoi",
        partial(_score_signal, "stoi", fidelity.stoi),
        ["pystoi", "scipy"],
        uses_facts=False,
        scores=["stoi"],
    ),
    "pesq": Measure(
        "pesq",
        partial(_score_signal, "pesq", fidelity.pesq_wb),
        ["pesq"],
        uses_facts=False,
        scores=["pesq"],
        may_crash=True,
    ),
}
"""The scores of the option ``--measures``, each under its name. Higher is better for all of them.

HASPI, HASQI and HAAQI are computed with 32 bits.
"""


def find_measures(names: Sequence[str], precision: int = 32) -> list[Measure]:
    """Return the measures with the listed names, without duplicates.

    Args:
        names: Names in ``MEASURES``, or ``package.module:name`` of your own functions, see
            ``load_measure``.
        precision: Number of bits of the numbers with which HASPI, HASQI and HAAQI are computed, 32
            or 64.

    Raises:
        ValueError: There is no such measure or precision, or your function cannot be loaded.
        MissingExtraError: The package of STOI or PESQ is needed, and is not installed.

    >>> [measure.name for measure in find_measures(["haspi", "hasqi"])]
    ['haspi', 'hasqi']
    """
    check_names([name for name in names if ":" not in name], MEASURES, "measures")
    if precision not in PRECISIONS:
        raise ValueError(f"expected precision 32 or 64 (bits), got {precision!r}; pass one of them")
    for name, package, extra in (("stoi", "pystoi", "eval"), ("pesq", "pesq", "pesq")):
        if name in names:
            require(package, extra)
    known = MEASURES | {name: _ear_measure(name, precision) for name in REFERENCES}
    return [known.get(name) or load_measure(name) for name in dict.fromkeys(names)]


class _PluginMeasure:
    """Measure that a user has written, ``(item, output) -> dict from column to number``.

    It is pickled by its name, so that another process imports the function again.

    Raises:
        ValueError: The function cannot be loaded, or a call of it returns no dict.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.function = load_plugin(name, "measure")
        if isinstance(self.function, nn.Module):
            self.function.eval()

    def __reduce__(self) -> Any:
        return _PluginMeasure, (self.name,)

    def __call__(self, item: Item, output: Tensor) -> Values:
        # A function that changes its arguments in place must not change those of other measures.
        copy = replace(item, clean=item.clean.clone(), signal=item.signal.clone())
        values = self.function(copy, output)
        if not isinstance(values, Mapping):
            raise ValueError(
                f"measure {self.name} returned {values!r}; expected a dict of numbers by the name "
                "of the column"
            )
        return {str(column): float(value) for column, value in values.items()}


def load_measure(name: str) -> Measure:
    """Load a measure of your own, a function ``(item, output) -> dict from column to number``.

    The function is not tried: one that returns something else fails in the study. Its values are
    stored only if it has the attribute ``fingerprint``, such as a version, which you change with
    its code. A module (``nn.Module``) is set to evaluation mode. The values of one with tensors or
    an attribute ``config`` are stored without ``fingerprint`` if its attributes can be hashed.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name``.

    Raises:
        ValueError: The function cannot be loaded.

    >>> load_measure("builtins:max").name
    'builtins:max'
    """
    plugin = _PluginMeasure(name)
    return Measure(name, plugin, settings=fingerprint(plugin.function))


def column_title(column: str) -> str:
    """Return the title of a column of scores, as tables and plots show it.

    >>> column_title("haspi"), column_title("crest factor")
    ('HASPI', 'crest factor')
    """
    if column in MEASURES:
        return column.upper()
    return "SNR (dB)" if column == "snr" else column


def _measure_levels(item: Item, output: Tensor) -> Values:
    return {
        "level": float(level_spl(output, item.full_scale_spl)),
        "clean_level": float(level_spl(item.clean, item.full_scale_spl)),
        "full_scale_spl": item.full_scale_spl,
    }


def _measure_lag(item: Item, output: Tensor) -> Values:
    lag = find_lag(output, item.clean)
    return {} if lag is None else {"lag_ms": 1000.0 * lag / item.sample_rate}


ALIGNMENT = Measure("alignment", _measure_lag, uses_facts=False, scores=())
"""Column ``lag_ms``: lag of an output behind the clean speech in ms, see ``find_lag``.

The column is left out if output and clean speech are not similar enough to find the lag.
"""

LEVELS = Measure("levels", _measure_levels, uses_facts=False, scores=())
"""Columns ``level`` and ``clean_level``: RMS levels of output and clean speech in dB SPL.

The column ``full_scale_spl`` has the level in dB SPL of a signal whose RMS is 1.0.
"""


def find_lag(output: Tensor, clean: Tensor) -> int | None:
    """Return by how many samples an output is later than the clean speech.

    It is the lag at which the magnitude of the cross-correlation of both, without their means, is
    largest.

    Args:
        output: The output, on the CPU and without a gradient. Shape: (time,).
        clean: Clean speech, likewise. Shape: (other time,).

    Returns:
        The lag, negative if the output is early, or None if the magnitude of the correlation
        coefficient at this lag is not above 0.2.

    >>> speech = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    >>> find_lag(torch.nn.functional.pad(speech, (32, 0)), speech)
    32
    """
    lag, coefficient = correlate(output, clean)
    return lag if coefficient > CORRELATION_FLOOR else None


def perceive(signal: Tensor, ear: Audiogram, sample_rate: int) -> Tensor:
    """Simulate what an ear perceives of a signal, by the exact MSBG, without a gradient.

    Args:
        signal: Signals in pascals. Shape: (..., time).
        ear: Audiogram of the ear.
        sample_rate: Sample rate in Hz, 16000 to 48000.

    Returns:
        The perceived signals in pascals. Shape: (..., time).

    Raises:
        ValueError: A threshold is above 100 dB HL, or a signal or the rate is not valid.

    >>> perceive(torch.ones(1600), Audiogram.standard("N3"), 16000).shape
    torch.Size([1600])
    """
    with torch.no_grad(), loud_outputs():
        return load_simulator(EXACT, sample_rate=sample_rate)(signal, ear)


def _measure_perception(item: Item, output: Tensor) -> Values:
    rate = item.sample_rate
    reference = item.once("normal clean", lambda: perceive(item.clean, NORMAL, rate))
    normal_input = item.once("normal input", lambda: perceive(item.reference_signal, NORMAL, rate))
    perceived = perceive(output, item.ear, rate)
    peak = 20.0 * output.abs().max().clamp_min(1e-10).log10()
    return {
        "peak": float(peak) + PASCAL_SPL,
        "loudness_error": float(level_spl(perceived)) - float(level_spl(normal_input)),
        "band_error": _band_error_db(perceived, reference, rate),
        "loss_msbg": float(band_level_loss(perceived, reference, rate)),
    }


PERCEPTION = Measure("perception", _measure_perception, uses_facts=False, scores=())
"""Errors in dB of what an ear perceives of an output, by the exact MSBG, and the output's peak.

Items must be in pascals. ``loudness_error`` is the level that the ear perceives of the output,
minus the level that a normal ear perceives of the input with its noise. ``band_error`` and
``loss_msbg`` compare the perceived output with clean speech as a normal ear perceives it:
``band_error`` is the median absolute difference in level over those frames and bands (of 24) in
which the normal ear hears the clean speech, ``loss_msbg`` the value of
``HearingLossLoss(simulator="msbg", criterion="bands")``. ``peak`` is the largest magnitude of the
output in dB relative to 20 micropascals.
"""


def network_loss(simulator: nn.Module) -> Measure:
    """Return the measure of the column ``loss_neuro``, the training loss of an aid in dB.

    The loss is that of ``HearingLossLoss(criterion="bands")`` with a network as the simulator: it
    compares what the ear perceives of the output with what a normal ear perceives of the clean
    speech. The column ``loss_msbg`` of the measure ``PERCEPTION`` is the same loss with the exact
    MSBG, so that both show whether an aid exploits errors of the network. For an ear that was
    measured at other frequencies than the eight of the network, they differ by MSBG's
    interpolation, too.

    Args:
        simulator: The network, a Neuro-MSBG for the sample rate of the items and signals in
            pascals.

    >>> network_loss(nn.Identity()).name
    'network loss'
    """

    def compute(item: Item, output: Tensor) -> Values:
        reference = item.once("normal by network", lambda: simulator(item.clean, NORMAL))
        perceived = simulator(output, item.ear)
        return {"loss_neuro": float(band_level_loss(perceived, reference, item.sample_rate))}

    settings = fingerprint(simulator)
    return Measure("network loss", compute, settings=settings, uses_facts=False, scores=())


def _band_error_db(perceived: Tensor, reference: Tensor, sample_rate: int) -> float:
    """Compute the median absolute difference between the levels of two signals in 24 bands, in dB.

    The median is over all bands and frames of ``band_levels`` in which a normal ear finds the
    reference audible.

    Args:
        perceived: Output as the impaired ear perceives it, in pascals. Shape: (time,).
        reference: Clean speech as a normal ear perceives it, in pascals. Shape: (time,).
        sample_rate: Sample rate in Hz.

    Raises:
        ValueError: Nothing of the reference is audible.
    """
    levels = band_levels(perceived, sample_rate)
    reference_levels = band_levels(reference, sample_rate)
    audible = audibility_weights(reference_levels, audibility_threshold(reference_levels)) > 0.0
    if not bool(audible.any()):
        raise ValueError(
            "expected clean speech that is audible for a normal ear, got none; raise its level"
        )
    return float((levels - reference_levels).abs()[audible].double().quantile(0.5))
