"""The study of ``evaluate-simulator``: simulators are compared with a teacher.

The teacher is the simulator whose output others should match: the exact MSBG, or one of your own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hlsim.calibration import NEURO_RATE, level_spl
from hlsim.checks import loud_outputs
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.items import SIMULATOR_LEVELS, apply_treatments, draw_simulator_items
from hlsim.evaluation.measures import load_measure
from hlsim.evaluation.result import Evaluation, ItemSounds
from hlsim.evaluation.running.fingerprint import fingerprint
from hlsim.evaluation.running.parallel import check_scheduler
from hlsim.evaluation.sounds import try_sounds
from hlsim.evaluation.study import Condition, Item, Measure, Values
from hlsim.extras import is_installed, require
from hlsim.metrics import fidelity
from hlsim.simulators import load_simulator

if TYPE_CHECKING:
    from pandas import DataFrame


def evaluate_simulators(
    simulators: Mapping[str, str | Path | nn.Module],
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
    listen: int = 0,
    **running: Any,
) -> Evaluation:
    """Compare simulators with a teacher, whose output they should match: the exact MSBG by default.

    With ``store``, an interrupted run can be continued, and a run with one more simulator computes
    only its values.

    Args:
        simulators: Simulators by their label in tables: names, folders, or modules at 16 kHz and 94
            dB SPL full scale, see ``load_simulator``.
        speech: Folder of recordings of clean speech.
        audiograms: CSV file of ears, see ``draw_simulator_items``.
        store: File of scores, which is created if it does not exist; None stores nothing.
        noise: Folder of recordings of noise. Every second item is then noisy, at signal-to-noise
            ratios of 2.5 to 17.5 dB.
        teacher: Name of the simulator to compare with, ``"msbg"`` or another one that
            ``load_simulator`` accepts.
        measures: Further measures, ``package.module:name``.
        items: Number of items, each of which is measured for each of ``inputs``.
        seconds: Length of an item in seconds. STOI needs 0.4 s of speech without its pauses.
        levels: Levels in dB SPL, before the input is processed, through which the items cycle.
        inputs: Names of ways to process the input before the simulator: ``"as-is"``, ``"louder"``
            (by 20 dB), ``"nalr"`` (amplified by NAL-R for the ear), ``"compressed"`` (3:1) and
            ``"compensated"`` (by ``compensator``).
        compensator: Aid of the treatment ``"compensated"``, which is called with a waveform and an
            ear. It is set to evaluation mode.
        seed: Seed of all random draws.
        listen: Whether (1) or not (0) an item has sounds for the player of a page.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation with one group per name in ``inputs``. The column ``snr`` of its table is the
        power of the teacher's output over that of the simulator's error, in dB. In each group, the
        SNR of every simulator is compared with that of the first one in ``simulators``.

    Raises:
        ValueError: Data or settings are not valid, or no item has an SNR.
        MissingExtraError: pandas, joblib or pystoi is not installed, or distributed for ``dask``.
            Without pesq, PESQ is left out.
        OSError: The store of scores cannot be read.

    >>> from hlsim import MSBG
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> speech, settings = EXAMPLE_FILE.parent, {"items": 1, "seconds": 1.0, "jobs": 1}
    >>> evaluation = evaluate_simulators(
    ...     {"exact": MSBG()}, speech=speech, audiograms="standard", **settings
    ... )
    >>> evaluation.table["snr"].tolist()  # the teacher itself
    [200.0]
    """
    check_scheduler(running.get("dask"))
    inputs = list(dict.fromkeys(inputs))
    settings: dict[str, Any] = {
        "items": items,
        "seconds": seconds,
        "seed": seed,
        "levels": list(levels),
    }
    loaded = {label: load_simulator(simulator) for label, simulator in simulators.items()}
    scores = [_fidelity_to(teacher), *map(load_measure, measures)]
    drawn = draw_simulator_items(speech, noise, audiograms, **settings)
    evaluation = Evaluation.run(
        apply_treatments(drawn, inputs, compensator),
        [Condition(name, module, "simulator") for name, module in loaded.items()],
        scores,
        store=store,
        settings={"teacher": teacher, **settings, "inputs": inputs},
        required=["snr"],
        **running,
    )
    groups: dict[str, Evaluation] = {}
    for treatment in inputs:
        part = evaluation.table[evaluation.table["treatment"] == treatment]
        comparisons = compare(part, ["snr"], baseline=evaluation.names[0])
        groups[treatment] = replace(evaluation, table=part, comparisons=comparisons)
    evaluation = replace(evaluation, groups=groups)
    return replace(evaluation, sounds=[_example_sounds(evaluation)] if listen else [])


def _teacher_output(teacher: nn.Module, item: Item) -> Tensor:
    """Return the output of a teacher for an item, without a gradient. Shape: (time,)."""
    with torch.no_grad(), loud_outputs():
        return teacher(item.signal, item.ear)


def _fidelity_to(teacher_name: str) -> Measure:
    """Return the measure that compares a simulator's output with that of a teacher.

    Its columns are ``snr`` (dB), ``raw_mse`` and ``band_error`` (dB, over third octaves), see
    ``hlsim.metrics.fidelity``, and ``stoi_teacher``, ``stoi_simulator``, ``pesq_teacher`` and
    ``pesq_simulator``: STOI and PESQ of both outputs against the clean speech. STOI and PESQ are
    left out where they are not defined, and PESQ also if pesq is not installed.

    Args:
        teacher_name: Name of the teacher, see ``evaluate_simulators``.

    Raises:
        ValueError: There is no such teacher.
        MissingExtraError: pystoi is not installed.
    """
    require("pystoi", "eval")
    teacher = load_simulator(teacher_name)
    packages = ["pystoi"]
    scores = {"stoi": fidelity.stoi}
    if is_installed("pesq"):
        packages.append("pesq")
        scores["pesq"] = fidelity.pesq_wb

    def compute(item: Item, output: Tensor) -> Values:
        expected = item.once("teacher", partial(_teacher_output, teacher, item))
        values = {
            "snr": fidelity.snr_db(expected, output),
            "raw_mse": fidelity.raw_mse(expected, output),
            "band_error": fidelity.third_octave_error_db(expected, output, item.sample_rate),
        }
        for name, score in scores.items():
            with suppress(ValueError):  # the score of one of the two outputs is not defined
                score_teacher = partial(score, expected, item.clean, NEURO_RATE)
                of_teacher = item.once(name, score_teacher)
                of_simulator = score(output, item.clean, NEURO_RATE)
                values |= {f"{name}_teacher": of_teacher, f"{name}_simulator": of_simulator}
        return values

    settings = fingerprint(teacher)
    always = ("snr", "raw_mse", "band_error")
    return Measure("fidelity", compute, packages, settings, uses_facts=False, scores=always)


def agreement(rows: DataFrame, score: str) -> dict[str, float]:
    """Compute how well scores of a simulator's outputs agree with those of the teacher's outputs.

    Args:
        rows: Rows of the table of ``evaluate_simulators`` for one simulator.
        score: ``"stoi"`` or ``"pesq"``.

    Returns:
        Linear correlation ``lcc``, rank correlation ``srcc`` and mean squared difference ``mse``,
        by name; NaN where they are not defined.

    >>> import pandas
    >>> rows = pandas.DataFrame({"stoi_teacher": [0.1, 0.5], "stoi_simulator": [0.2, 0.6]})
    >>> round(agreement(rows, "stoi")["srcc"], 3)
    1.0
    """
    columns = [f"{score}_teacher", f"{score}_simulator"]
    scores = rows.reindex(columns=columns).astype(float)
    difference = scores[columns[0]] - scores[columns[1]]
    return {
        "lcc": float(scores.corr().iloc[0, 1]),
        "srcc": float(scores.corr(method="spearman").iloc[0, 1]),
        "mse": float((difference**2).mean()),
    }


def _example_sounds(evaluation: Evaluation) -> ItemSounds:
    """Return the sounds of one item: its input, and the outputs of the teacher and all simulators.

    It is the item with the highest level among those of the first treatment with an SNR.
    """
    scored = (group.table.dropna(subset="snr") for group in evaluation.groups.values())
    rows = next(rows for rows in scored if not rows.empty)
    item = evaluation.items[rows["item"][rows["input_level"].idxmax()]].load()
    expected = _teacher_output(load_simulator(evaluation.settings["teacher"]), item)
    outputs, failures = try_sounds({c.name: partial(c.output, item) for c in evaluation.conditions})
    signals = {"input": item.signal, "teacher": expected, **outputs}
    # A short clip is filled up with silence.
    end = int(item.signal.nonzero().max()) + item.sample_rate // 10
    groups = {"": {name: signal[:end] for name, signal in signals.items()}}
    facts = item.facts
    level = float(level_spl(item.signal))  # after the treatment
    name = f"{item.name}: {facts['treatment']}, {facts['speech']}, {level:.0f} dB SPL"
    return ItemSounds(name, item.ear, item.sample_rate, groups, failures)
