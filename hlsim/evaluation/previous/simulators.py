"""How faithful simulators are to MSBG, or another teacher: the same items through the truth and each of them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.previous.items import LEVELS, Input, Item, draw_items, treat
from hlsim.evaluation.previous.keys import weights_hash
from hlsim.evaluation.statistics import paired_comparison
from hlsim.evaluation.store import ScoreStore, key_of
from hlsim.extras import MissingExtraError, is_installed, require
from hlsim.metrics.fidelity import (
    linear_correlation,
    mean_squared_error,
    pesq_wb,
    rank_correlation,
    raw_mse,
    snr_db,
    stoi,
    third_octave_error_db,
)
from hlsim.metrics.registry import version_of, versions_of
from hlsim.msbg import MSBG
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Failed, Progress, make_missing, reason_of
from hlsim.training.teacher import PluginTeacher, find_teacher

_SCORES = ("snr", "raw_mse", "band_error", "stoi_true", "stoi_sim", "pesq_true", "pesq_sim")
_KINDS = ("severity", "level", "condition")
_AGREEMENT: dict[str, Callable[..., float | None]] = {
    "lcc": linear_correlation,
    "srcc": rank_correlation,
    "mse": mean_squared_error,
}

_SHORTEST = 0.02  # s: a window of the spectrograms

_REVISION = 2  # of what is measured: raise it where that changes a figure


@dataclass(frozen=True)
class SimulatorEvaluation:
    """What ``fidelity.json`` holds: the settings, and of each of ``simulators`` the ``items`` and, by each of ``inputs``,
    their summary and, of all but the first, ``snr_over_first``, a ``PairedComparison``; the item of the spectrograms; and
    what is heard of it by the truth and by each simulator, by name, (time,) in pascals at 16 kHz.
    """

    result: dict[str, Any]
    shown: Item
    heard: Mapping[str, Tensor]


def evaluate_simulators(
    simulators: Mapping[str, nn.Module],
    *,
    speech: str | Path,
    audiograms: str | Path,
    store: str | Path | None = None,
    noise: str | Path | None = None,
    teacher: str = "msbg",
    items: int = 240,
    seconds: float = 3.0,
    levels: Sequence[float] = LEVELS,
    inputs: Sequence[Input] = ("as-is",),
    compensator: nn.Module | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> SimulatorEvaluation:
    """Compare simulators with MSBG, or another teacher, side by side.

    Scores are stored as they are made, by the samples, the ear and the weights that they are of: a run that was stopped
    goes on where it was, and one with a simulator more scores that one alone. An item that a simulator or the truth fails
    on, or that has no STOI or PESQ, is listed with the ``reasons`` and counts in no figure that it has no value for.

    Args:
        simulators: by name, at 16 kHz and 94 dB SPL full scale.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy.
        audiograms: CSV file of ears, half of those used; the milder standard ones (NH, N1, N2, S1) and drawn ones are
            a quarter each.
        store: file of scores, there or not; None keeps nothing.
        teacher: what simulators are compared with: ``"msbg"``, the exact one, or the name of a plug-in, see
            ``PluginTeacher``.
        items: how many; each is scored under each of ``inputs``.
        seconds: length of an item; PESQ and STOI want 2 or more.
        levels: dB SPL that the items take in turn.
        inputs: what is done to the signal before the ear gets it, ``compensated`` with a compensator.
        compensator: called with a waveform and an ear.
        progress: called with what is done and all.

    Raises:
        ValueError: data that cannot be used, an unknown teacher or input, or no item that the truth does not fail on.
        MissingExtraError: pystoi is not installed.
    """
    reference = find_teacher(teacher)
    told = teacher if reference is None else str(reference)
    if items < 1 or not simulators or not inputs or not levels:
        raise ValueError(
            f"{items} items of {len(inputs)} inputs at {len(levels)} levels for {len(simulators)} simulators; allowed: "
            "1 or more of each"
        )
    if len(set(inputs)) < len(inputs):
        raise ValueError(f"inputs {', '.join(inputs)}; allowed: each once")
    if not seconds >= _SHORTEST:
        raise ValueError(
            f"items of {seconds:g} s; allowed: {_SHORTEST:g} or more, and 2 for PESQ and STOI"
        )
    require("pandas", "eval")  # to be known before hours of scoring
    drawn = draw_items(
        speech, noise, audiograms, items=items, seconds=seconds, seed=seed, levels=levels
    )
    scored = ScoreStore(store)
    versions = {**versions_of(["stoi", "pesq"]), "hlsim": version_of("hlsim")}
    settings = {"teacher": told, "revision": _REVISION, "versions": versions}
    weights = {name: weights_hash(simulator) for name, simulator in simulators.items()}
    tasks = []
    for item in treat(drawn, inputs, compensator):
        about = settings | item.settings()
        tasks.append(
            (item, {name: key_of({**about, "weights": weights[name]}) for name in simulators})
        )
    many = len(simulators)
    failed = make_missing(
        partial(_score_item, simulators, reference),
        tasks,
        lambda task: [*task[1].values()],
        scored,
        jobs=1,
        progress=progress and (lambda done, total: progress(done // many, total // many)),
    )

    def row(number: int, item: Item, key: str) -> dict[str, Any]:
        scores = scored.get(key) or {"reasons": [failed[key]]}
        return {"item": number // len(inputs), **item.about, **scores}

    entries: dict[str, dict[str, Any]] = {}
    for name in simulators:
        rows = [row(number, item, keys[name]) for number, (item, keys) in enumerate(tasks)]
        of = {given: [row for row in rows if row["input"] == given] for given in inputs}
        entries[name] = {
            "inputs": {given: summarise(part) for given, part in of.items()},
            "items": rows,
        }
    first, *others = entries.values()
    for entry in others:
        entry["snr_over_first"] = {given: _snr_over(first, entry, given) for given in inputs}
    result = {"teacher": told, "items": items, "seconds": seconds, "seed": seed}
    result |= {"levels": [*levels], "inputs": [*inputs], "simulators": entries}
    shown, truth = _shown([item for item, _ in tasks], reference)
    heard_of = {"truth": truth}
    for name, simulator in simulators.items():
        with contextlib.suppress(Exception), torch.no_grad():  # its failure is in the tables
            heard = simulator(shown.signal, shown.ear)
            heard_of |= {name: heard} if heard.isfinite().all() else {}
    return SimulatorEvaluation(result, shown, heard_of)


def _snr_over(
    first: Mapping[str, Any], other: Mapping[str, Any], given: Input
) -> dict[str, Any] | None:
    """A paired comparison of the SNR of those items of an input that both have one of; None where there is none."""
    rows = zip(first["items"], other["items"], strict=True)
    both = [(one.get("snr"), two.get("snr")) for one, two in rows if one["input"] == given]
    pairs = [pair for pair in both if None not in pair]
    return paired_comparison(*zip(*pairs, strict=True)).to_dict() if pairs else None


def _score_item(
    simulators: Mapping[str, nn.Module],
    reference: PluginTeacher | None,
    task: tuple[Item, Mapping[str, str]],
    missing: Sequence[str],
) -> dict[str, dict[str, Any] | Failed]:
    """The scores of an item by each simulator whose key is missing."""
    item, keys = task
    try:
        truth = _truth(item, reference)
        true = _both(item.clean, truth, "true")
    except MissingExtraError:
        raise
    except Exception as error:  # of this item alone: all simulators go without
        return dict.fromkeys(missing, Failed(f"no truth: {reason_of(error)}"))
    made: dict[str, dict[str, Any] | Failed] = {}
    for name, key in ((name, key) for name, key in keys.items() if key in missing):
        try:
            with torch.no_grad():
                scores = _scores(
                    item.clean, truth, simulators[name](item.signal, item.ear).double()
                )
            made[key] = true | scores | {"reasons": true["reasons"] + scores["reasons"]}
        except Exception as error:  # one simulator's; the others go on
            made[key] = Failed(reason_of(error))
    return made


def _truth(item: Item, reference: PluginTeacher | None) -> Tensor:
    if reference is not None:
        return reference(item.signal[None], torch.tensor([item.ear.thresholds]), NEURO_RATE)[0]
    with torch.no_grad():
        heard: Tensor = MSBG(sample_rate=NEURO_RATE)(item.signal, item.ear)
    return heard


def _scores(clean: Tensor, truth: Tensor, heard: Tensor) -> dict[str, Any]:
    return {
        "snr": snr_db(truth, heard),
        "raw_mse": raw_mse(truth, heard),
        "band_error": third_octave_error_db(truth, heard, NEURO_RATE),
        **_both(clean, heard, "sim"),
    }


def _both(clean: Tensor, heard: Tensor, whose: str) -> dict[str, Any]:
    """STOI, and PESQ where its package is installed, of the truth or the simulator; and the reasons for missing ones."""
    scores = {f"stoi_{whose}": stoi(clean, heard, NEURO_RATE)}
    if is_installed("pesq"):
        scores[f"pesq_{whose}"] = pesq_wb(clean, heard, NEURO_RATE)
    reasons = [
        f"no {name}: {score.reason}" for name, score in scores.items() if score.value is None
    ]
    return {name: score.value for name, score in scores.items()} | {"reasons": reasons}


def _shown(items: Sequence[Item], reference: PluginTeacher | None) -> tuple[Item, Tensor]:
    """The item of the spectrograms and its truth: of the first input, a moderate loss, loud and clean where there is one,
    for much is lost of it and much still heard."""
    first, reason = items[0].about["input"], None

    def rank(item: Item) -> tuple[Any, ...]:
        about = item.about
        degree = ("moderate", "mild", "severe", "none").index(about["severity"])
        return about["input"] != first, degree, -about["level"], about["condition"]

    for item in sorted(items, key=rank):
        try:
            return item, _truth(item, reference)
        except Exception as error:
            reason = reason or error
    raise ValueError(f"no item has a truth: {reason}")


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Fidelity over many items: overall, and by each of severity, level (dB SPL) and condition that rows have.

    Args:
        rows: one an item, with any of ``snr``, ``raw_mse``, ``band_error``, ``stoi_true``, ``stoi_sim``, ``pesq_true``,
            ``pesq_sim``: finite, or ValueError, or None, and then it, or its pair, is left out.

    Returns: ``{"overall": figures, "severity": {"mild": figures, ...}, "level": {"65": figures, ...}, "condition":
        {...}}``, for JSON. Figures are ``n``, ``snr_n`` (how many have one), ``snr_median``, ``snr_worst_tenth`` (10th
        percentile), ``raw_mse`` (mean), ``band_error_median`` and, for stoi and pesq, ``_n`` (pairs used), ``_lcc``,
        ``_srcc``, ``_mse``; None where undefined.
    """
    if not rows:
        raise ValueError("no items to summarise")
    for key in _SCORES:
        if not all(math.isfinite(row[key]) for row in rows if row.get(key) is not None):
            raise ValueError(
                f"{key} holds NaN or infinity; allowed: finite numbers, or None where there is none"
            )
    pandas = require("pandas", "eval")
    # None becomes NaN
    frame = pandas.DataFrame(rows, columns=[*_SCORES, *_KINDS]).astype(
        dict.fromkeys(_SCORES, float)
    )
    summary: dict[str, Any] = {"overall": _figures(frame)}
    for key in _KINDS:
        # degrees of loss in their order, levels as numbers, conditions by name
        groups = dict(list(frame.groupby(key)))
        order = sorted(groups, key=lambda g: (SEVERITIES.index(g) if g in SEVERITIES else 0, g))
        summary[key] = {g if isinstance(g, str) else f"{g:g}": _figures(groups[g]) for g in order}
    return summary


def _figures(frame: Any) -> dict[str, float | int | None]:
    def over(measure: str, key: str, *options: float) -> float | None:
        values = frame[key].dropna()
        return float(getattr(values, measure)(*options)) if len(values) else None

    figures: dict[str, float | int | None] = {
        "n": len(frame),
        "snr_n": int(frame.snr.count()),
        "snr_median": over("median", "snr"),
        "snr_worst_tenth": over("quantile", "snr", 0.1),
        "raw_mse": over("mean", "raw_mse"),
        "band_error_median": over("median", "band_error"),
    }
    for name in ("stoi", "pesq"):
        pairs = frame[[f"{name}_true", f"{name}_sim"]].dropna()
        figures[f"{name}_n"] = len(pairs)
        figures |= {
            f"{name}_{key}": agree(*pairs.to_numpy().T) for key, agree in _AGREEMENT.items()
        }
    return figures
