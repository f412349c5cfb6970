"""Simulators compared with the exact MSBG, or another teacher, on the same items."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hlsim.evaluation.comparison import compare
from hlsim.evaluation.fingerprint import fingerprint
from hlsim.evaluation.items import SIMULATOR_LEVELS, draw_items, treat
from hlsim.evaluation.measures import load_measure, perceive
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition, Item, Measure, Values
from hlsim.extras import is_installed, require
from hlsim.metrics import fidelity
from hlsim.neuro.config import NEURO_RATE
from hlsim.training.teacher import PluginTeacher, find_teacher

if TYPE_CHECKING:
    from pandas import DataFrame

SHORTEST_SECONDS = 0.02
"""Shortest item in seconds, which is one window of the spectrograms."""


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
    inputs: Sequence[str] = ("as-is",),
    compensator: nn.Module | None = None,
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Compare simulators with the exact MSBG, or another teacher.

    Values are stored as they become known. An interrupted run can be continued, and a run with one
    more simulator computes only its values.

    Args:
        simulators: Modules by name, at 16 kHz and 94 dB SPL full scale.
        speech, noise: Folders of recordings. With ``noise``, every second item is noisy.
        audiograms: CSV file of ears, see ``draw_items``.
        store: File of values, which is created if it does not exist; None stores nothing.
        teacher: The simulator to compare with: ``"msbg"``, the exact one, or
            ``package.module:name``.
        measures: Further measures, ``package.module:name``.
        items: Number of items; each is measured for each of ``inputs``.
        seconds: Length of an item; PESQ and STOI need 2 or more.
        levels: Levels in dB SPL that the items have in turn.
        inputs: Treatments of the signal before the simulator, see ``TREATMENTS``.
        compensator: Module of the treatment ``compensated``.
        seed: Seed of all random draws.
        running: ``jobs``, ``dask`` and ``progress``, as in ``run_study``.

    Returns:
        The evaluation with one group per treatment. The SNR of a simulator is that of the teacher's
        output relative to the simulator's error. In each group, the SNR of every simulator is
        compared with that of the first one in ``simulators``.

    Raises:
        ValueError: Data or settings are not valid, or no item has a value.
        MissingExtraError: pandas or pystoi is not installed. Without pesq, that measure is left
            out.
    """
    require("pandas", "eval")
    require("pystoi", "eval")
    if items < 1 or not simulators or not inputs or not levels:
        raise ValueError("an evaluation needs at least one simulator, item, level and input")
    if len(set(inputs)) < len(inputs):
        raise ValueError(f"one of the inputs {', '.join(inputs)} is named twice")
    if seconds < SHORTEST_SECONDS:
        raise ValueError(f"items of {seconds:g} s are too short; PESQ and STOI need 2 s")
    drawn = draw_items(
        speech, noise, audiograms, items=items, seconds=seconds, seed=seed, levels=levels
    )
    evaluation = Evaluation.run(
        treat(drawn, inputs, compensator),
        [Condition(name, module, "simulator") for name, module in simulators.items()],
        [fidelity_to(teacher), *map(load_measure, measures)],
        store=store,
        settings={
            "teacher": teacher,
            "items": items,
            "seconds": seconds,
            "seed": seed,
            "levels": list(levels),
            "inputs": list(inputs),
        },
        **running,
    )
    groups: dict[str, Evaluation] = {}
    for treatment in inputs:
        part = evaluation.table[evaluation.table["treatment"] == treatment]
        comparisons = compare(part, ["snr"], baseline=evaluation.names[0])
        groups[treatment] = replace(evaluation, table=part, comparisons=comparisons)
    return replace(evaluation, groups=groups)


def teacher_output(teacher: PluginTeacher | None, item: Item) -> Tensor:
    """Return the teacher's output for an item, which is computed once per item.

    Args:
        teacher: The teacher; None is the exact MSBG.
        item: The item.

    >>> from hlsim import Audiogram
    >>> clean = torch.ones(1600)
    >>> teacher_output(None, Item("item 1", clean, clean, Audiogram.standard("N3"))).shape
    torch.Size([1600])
    """

    def compute() -> Tensor:
        if teacher is None:
            return perceive(item.signal, item.ear, item.sample_rate)
        return teacher(item.signal[None], torch.tensor([item.ear.thresholds]), NEURO_RATE)[0]

    output: Tensor = item.once("teacher", compute)
    return output


def fidelity_to(name: str) -> Measure:
    """Return the measure of a simulator's fidelity to a teacher.

    Its values are the SNR, the scaled mean squared error, the error of third-octave bands, and STOI
    and PESQ of teacher and simulator against the clean speech, if they are defined. PESQ is left
    out if pesq is not installed.

    >>> fidelity_to("msbg").name
    'fidelity'
    """
    teacher = find_teacher(name)
    scores = {"stoi": fidelity.stoi}
    if is_installed("pesq"):
        scores["pesq"] = fidelity.pesq_wb

    def compute(item: Item, output: Tensor) -> Values:
        expected = teacher_output(teacher, item)
        values = {
            "snr": fidelity.snr_db(expected, output),
            "raw_mse": fidelity.raw_mse(expected, output),
            "band_error": fidelity.third_octave_error_db(expected, output, item.sample_rate),
        }
        for score, function in scores.items():
            score_teacher = partial(function, item.clean, expected, NEURO_RATE)
            of_teacher = item.once(score, score_teacher).value
            of_simulator = function(item.clean, output, NEURO_RATE).value
            if of_teacher is not None and of_simulator is not None:
                values |= {f"{score}_teacher": of_teacher, f"{score}_simulator": of_simulator}
        return values

    settings = "msbg" if teacher is None else fingerprint(teacher.plugin)
    packages = ["hlsim", "pystoi", "pesq"]
    return Measure("fidelity", compute, packages=packages, settings=settings)


def agreement(rows: DataFrame, score: str) -> dict[str, float | None]:
    """Compute the agreement of simulator and teacher in a score.

    Args:
        rows: Rows of the table.
        score: ``"stoi"`` or ``"pesq"``.

    Returns:
        Linear and rank correlation (``lcc``, ``srcc``) and the mean squared difference (``mse``);
        None where they are not defined.

    >>> import pandas
    >>> rows = pandas.DataFrame({"stoi_teacher": [0.1, 0.5], "stoi_simulator": [0.2, 0.6]})
    >>> round(agreement(rows, "stoi")["srcc"], 3)
    1.0
    """
    columns = [f"{score}_teacher", f"{score}_simulator"]
    pairs = rows.reindex(columns=columns).astype(float).dropna().to_numpy().T
    return {
        "lcc": fidelity.linear_correlation(*pairs),
        "srcc": fidelity.rank_correlation(*pairs),
        "mse": fidelity.mean_squared_error(*pairs),
    }


def example_item(evaluation: Evaluation) -> tuple[Item, Tensor]:
    """Return an item to show, and the teacher's output for it.

    It has the first treatment and, if there are such items, a moderate loss and loud, clean speech:
    much of it is lost, and much is still perceived.
    """
    rows = evaluation.table.dropna(subset="snr")
    rows = rows[rows["treatment"] == rows["treatment"].iloc[0]]
    rows = rows.assign(is_other_loss=rows["severity"] != "moderate")
    columns = ["is_other_loss", "input_level", "speech"]
    order = rows.sort_values(columns, ascending=[True, False, True])
    item = evaluation.items[order["item"].iloc[0]].load()
    return item, teacher_output(find_teacher(evaluation.settings["teacher"]), item)
