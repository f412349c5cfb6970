"""Simulators compared with the exact MSBG, or another teacher, on the same items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import SEVERITIES, Audiogram
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.fingerprint import fingerprint
from hlsim.evaluation.items import SIMULATOR_LEVELS, Treatment, draw_items, treat
from hlsim.evaluation.measures import load_measure, perceive
from hlsim.evaluation.result import Evaluation, check_scored
from hlsim.evaluation.store import ScoreStore
from hlsim.evaluation.study import Condition, Item, Measure, Values, run_study
from hlsim.extras import is_installed, require
from hlsim.metrics import fidelity
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Progress
from hlsim.training.teacher import PluginTeacher, find_teacher

if TYPE_CHECKING:
    from pandas import DataFrame

_SHORTEST = 0.02  # s: a window of the spectrograms


def evaluate_simulators(
    simulators: Mapping[str, nn.Module],
    *,
    speech: str | Path,
    audiograms: str | Path,
    store: str | Path | None = None,
    noise: str | Path | None = None,
    teacher: str = "msbg",
    measures: Sequence[str] = (),
    items: int = 240,
    seconds: float = 3.0,
    levels: Sequence[float] = SIMULATOR_LEVELS,
    inputs: Sequence[Treatment] = ("as-is",),
    compensator: nn.Module | None = None,
    seed: int = 0,
    jobs: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Compare simulators with the exact MSBG, or another teacher, side by side.

    Values are stored as they become known: a run that was stopped continues where it was, and one with a
    further simulator computes that one alone.

    Args:
        simulators: modules by name, at 16 kHz and 94 dB SPL full scale.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy.
        audiograms: CSV file of ears, see ``draw_items``.
        store: file of values, which is created if it does not exist; None stores nothing.
        teacher: the simulator to compare with: ``"msbg"``, the exact one, or ``package.module:name``.
        measures: further measures, ``package.module:name``.
        items: number of items; each is measured for each of ``inputs``.
        seconds: length of an item; PESQ and STOI need 2 or more.
        levels: levels in dB SPL that the items take in turn.
        inputs: treatments of the signal before the simulator gets it.
        compensator: the module of the treatment ``compensated``.
        jobs, dask, progress: as in ``run_study``.

    Returns: the evaluation with one group per treatment, in which each simulator is compared with the
        first by its SNR.

    Raises:
        ValueError: data or settings that cannot be used, or no item has a value.
        MissingExtraError: pandas or pystoi is not installed. Without pesq that measure is left out.
    """
    require("pandas", "eval")
    require("pystoi", "eval")
    if items < 1 or not simulators or not inputs or not levels:
        raise ValueError("an evaluation needs at least one simulator, item, level and input")
    if len(set(inputs)) < len(inputs):
        raise ValueError(f"one of the inputs {', '.join(inputs)} is named twice")
    if seconds < _SHORTEST:
        raise ValueError(f"items of {seconds:g} s are too short; PESQ and STOI need 2 s")
    reference = Reference(find_teacher(teacher))
    drawn = draw_items(
        speech, noise, audiograms, items=items, seconds=seconds, seed=seed, levels=levels
    )
    treated = treat(drawn, inputs, compensator)
    conditions = [Condition(name, module, "simulator") for name, module in simulators.items()]
    chosen = [*reference.measures(), *map(load_measure, measures)]
    table = run_study(
        treated,
        conditions,
        chosen,
        store=ScoreStore(store),
        jobs=jobs,
        dask=dask,
        progress=progress,
    )
    check_scored(table, ["snr"])
    evaluation = Evaluation(
        items=treated,
        conditions=conditions,
        measures=chosen,
        table=table,
        settings={
            "teacher": teacher,
            "items": items,
            "seconds": seconds,
            "seed": seed,
            "levels": list(levels),
            "inputs": list(inputs),
        },
    )
    return replace(evaluation, groups=_groups(evaluation, inputs))


def _groups(evaluation: Evaluation, inputs: Sequence[str]) -> dict[str, Evaluation]:
    groups = {}
    for treatment in inputs:
        part = evaluation.table[evaluation.table["treatment"] == treatment]
        comparisons = compare(part, ["snr"], baseline=evaluation.names[0])
        groups[treatment] = replace(evaluation, table=part, comparisons=comparisons)
    return groups


class Reference:
    """What simulators are compared with: the teacher's output, computed once per item."""

    def __init__(self, teacher: PluginTeacher | None) -> None:
        self.teacher = teacher

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of the teacher; None if it is unknown."""
        return "msbg" if self.teacher is None else fingerprint(self.teacher.plugin)

    def output(self, item: Item) -> Tensor:
        """Return what the teacher makes of an item."""
        output: Tensor = item.once("teacher", lambda: self._compute(item))
        return output

    def _compute(self, item: Item) -> Tensor:
        if self.teacher is None:
            return perceive(item.signal, item.ear, item.sample_rate)
        assert isinstance(item.ear, Audiogram)
        thresholds = torch.tensor([item.ear.thresholds])
        return self.teacher(item.signal[None], thresholds, NEURO_RATE)[0]

    def measures(self) -> list[Measure]:
        """Return closeness of waveforms and bands, and STOI and PESQ of teacher and simulator."""
        settings = self.fingerprint
        measures = [
            Measure("fidelity", self.fidelity, packages=["hlsim", "numpy"], settings=settings),
            Measure("stoi agreement", self.stoi, packages=["hlsim", "pystoi"], settings=settings),
        ]
        if is_installed("pesq"):
            packages = ["hlsim", "pesq"]
            measures.append(
                Measure("pesq agreement", self.pesq, packages=packages, settings=settings)
            )
        return measures

    def fidelity(self, item: Item, output: Tensor) -> Values:
        """Return SNR, scaled mean squared error, and error of third-octave bands."""
        expected = self.output(item)
        return {
            "snr": fidelity.snr_db(expected, output),
            "raw_mse": fidelity.raw_mse(expected, output),
            "band_error": fidelity.third_octave_error_db(expected, output, item.sample_rate),
        }

    def stoi(self, item: Item, output: Tensor) -> Values:
        """Return STOI of teacher and simulator against the clean speech."""
        return self._scores("stoi", item, output)

    def pesq(self, item: Item, output: Tensor) -> Values:
        """Return PESQ of teacher and simulator against the clean speech."""
        return self._scores("pesq", item, output)

    def _scores(self, name: str, item: Item, output: Tensor) -> Values:
        score = fidelity.stoi if name == "stoi" else fidelity.pesq_wb

        def of(signal: Tensor, whose: str) -> float:
            value, reason = score(item.clean, signal, item.sample_rate)
            if value is None:
                raise ValueError(f"the {whose} has no score: {reason}")
            return value

        expected = item.once(f"{name} of teacher", lambda: of(self.output(item), "teacher"))
        return {f"{name}_teacher": expected, f"{name}_simulator": of(output, "simulator")}


GROUPINGS = ("severity", "input_level", "speech")
"""Facts that simulators are summarised by."""


def summary(part: DataFrame) -> dict[str, float | int | None]:
    """Summarise one simulator on some items.

    Returns: ``n``; ``snr_n``, the number of items with an SNR, their median ``snr_median`` and 10th percentile
        ``snr_worst_tenth``; the mean ``raw_mse`` and the median ``band_error_median``; and for stoi and pesq
        the number of pairs ``_n``, correlations ``_lcc`` and ``_srcc`` and mean squared difference
        ``_mse``. A value that is not defined is None.
    """
    known = part.dropna(subset=["snr"])
    values: dict[str, float | int | None] = {"n": len(part), "snr_n": len(known)}
    values |= dict.fromkeys(("snr_median", "snr_worst_tenth", "raw_mse", "band_error_median"))
    if len(known):
        values["snr_median"] = float(known["snr"].median())
        values["snr_worst_tenth"] = float(known["snr"].quantile(0.1))
        values["raw_mse"] = float(known["raw_mse"].mean())
        values["band_error_median"] = float(known["band_error"].median())
    for name in ("stoi", "pesq"):
        columns = [f"{name}_teacher", f"{name}_simulator"]
        pairs = part.reindex(columns=columns).astype(float).dropna().to_numpy().T
        values[f"{name}_n"] = pairs.shape[1]
        values[f"{name}_lcc"] = fidelity.linear_correlation(*pairs)
        values[f"{name}_srcc"] = fidelity.rank_correlation(*pairs)
        values[f"{name}_mse"] = fidelity.mean_squared_error(*pairs)
    return values


def summaries(part: DataFrame, by: str) -> dict[str, dict[str, float | int | None]]:
    """Summarise one simulator by a fact of the items, in the order of degrees of loss, numbers or names."""
    groups = dict(list(part.groupby(by)))
    order = sorted(groups, key=lambda g: (SEVERITIES.index(g) if g in SEVERITIES else 0, g))
    return {g if isinstance(g, str) else f"{g:g}": summary(groups[g]) for g in order}


def example_item(evaluation: Evaluation) -> tuple[Item, Tensor]:
    """Return an item to show, and what the teacher makes of it.

    It has the first treatment and, as far as there are such items, a moderate loss, loud and clean speech: much
    of it is lost, and much still perceived.

    Raises:
        ValueError: the teacher fails on every item.
    """
    reference = Reference(find_teacher(evaluation.settings["teacher"]))
    degrees = ("moderate", "mild", "severe", "none")

    def rank(item: Any) -> tuple[Any, ...]:
        facts = item.facts
        place = evaluation.settings["inputs"].index(facts["treatment"])
        return place, degrees.index(facts["severity"]), -facts["input_level"], facts["speech"]

    reasons = []
    for item in sorted(evaluation.items, key=rank):
        try:
            loaded = item.load()
            return loaded, reference.output(loaded)
        except Exception as error:
            reasons.append(error)
    raise ValueError(f"the teacher fails on every item: {reasons[0]}")
