"""What a comparison of compensators comes to: summaries of each group of items, and the paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.haspi_report import HaspiReport
from hlsim.evaluation.items import Item
from hlsim.evaluation.judging import SIMULATORS, Judged
from hlsim.evaluation.scores import ItemScore
from hlsim.neuro.config import NEURO_RATE

HARD = 0.6
"""Unaided HASPI under which an item belongs to those that need help most."""

Rows = Sequence[Mapping[str, Any]]


def compensator_result(
    items: Sequence[Item],
    judged: Sequence[Mapping[str, Judged]],
    *,
    limits: Mapping[str, float | None],
    settings: Mapping[str, Any],
) -> tuple[dict[str, Any], dict[str, HaspiReport]]:
    """Summaries of what ``judge`` made, for JSON, and the reports of the groups that there are.

    An item counts where every condition has figures, so that all rows are of the same items.

    Args:
        judged: figures of each item by condition.
        limits: the conditions in order, unaided first, and the peak in dB SPL that each keeps to, or None.

    Raises:
        ValueError: no item has figures of every condition.
    """
    conditions = [*limits]
    failures, rows = [], []
    for number, (item, results) in enumerate(zip(items, judged, strict=True)):
        bad = {name: results[name].reason for name in conditions if results[name].figures is None}
        failures += [{"item": number, **item.about, "compensator": name, "reason": bad[name]} for name in bad]
        if not bad:
            figures = {name: results[name].figures for name in conditions}
            about = {**item.about, "audiogram": list(item.ear.thresholds)}
            rows.append({"item": number, **about, "figures": figures})
    if not rows:
        raise ValueError(f"none of {len(items)} items could be judged; the first: {failures[0]['reason']}")
    groups: dict[str, Rows] = {
        name: [row for row in rows if row["condition"] == name] for name in ("clean", "noisy")
    }
    groups["hard"] = [row for row in rows if row["figures"][conditions[0]]["haspi"] < HARD]
    groups = {name: group for name, group in groups.items() if group}
    reports = {name: _report(group, items, settings) for name, group in groups.items()}
    result = {
        **settings,
        "limits": dict(limits),
        "groups": {
            name: {
                "n": len(group),
                "conditions": {condition: _summary(group, condition) for condition in conditions},
                "comparisons": [c.to_dict() for c in reports[name].comparisons],
            }
            for name, group in groups.items()
        },
        "gap": {
            name: {condition: _gap(groups[name], condition) for condition in conditions}
            for name in ("clean", "noisy")
            if name in groups
        },
        "peaks": {name: _peaks(rows, name, limit) for name, limit in limits.items()},
        "versions": next(iter(reports.values())).versions,
        "failures": failures,
        "rows": rows,
    }
    return result, reports


def gap(group: Mapping[str, float], one: str, other: str) -> float | None:
    """Relative difference of one simulator's loss from another's; None where the other's is 0.

    It is where nothing is lost: clean speech as it is, in an ear without a loss.
    """
    least = group[f"loss_{other}"]
    return group[f"loss_{one}"] / least - 1.0 if least else None


def _report(rows: Rows, items: Sequence[Item], settings: Mapping[str, Any]) -> HaspiReport:
    scores = [
        ItemScore(
            file=f"item {row['item']}",
            audiogram=items[row["item"]].ear,
            clean_level=row["level"],
            levels={name: figures["level"] for name, figures in row["figures"].items()},
            scores={
                measure: {name: figures[measure] for name, figures in row["figures"].items()}
                for measure in ("haspi", "hasqi")
            },
            sample_rate=NEURO_RATE,
            seconds=settings["seconds"],
            seed=(settings["seed"] + row["item"]) % 2**32,
            listener=row["name"],  # utterances are nested in ears
            snr=row["snr"],
        )
        for row in rows
    ]
    return HaspiReport(scores, measures=("haspi", "hasqi"), seed=settings["seed"], unit="ears")


def _summary(rows: Rows, condition: str) -> dict[str, Any]:
    """Means over all, by input level and by degree of loss."""
    by_level = {
        f"{level:g}": [row for row in rows if row["level"] == level]
        for level in sorted({row["level"] for row in rows})
    }
    by_severity = {severity: [row for row in rows if row["severity"] == severity] for severity in SEVERITIES}
    return {
        **_means(rows, condition),
        "by_level": {level: _means(part, condition) for level, part in by_level.items()},
        "by_severity": {severity: _means(part, condition) for severity, part in by_severity.items() if part},
    }


def _means(rows: Rows, condition: str) -> dict[str, Any]:
    """Means and, of the scores, deviations with n - 1; levels in dB SPL.

    ``heard_off`` is the level heard less a normal ear's of the same input, ``heard_off_clean`` less its of the clean
    speech; ``_abs`` is the mean of the absolute differences.
    """
    figures = _columns(rows, condition)
    means: dict[str, Any] = {"n": len(rows)}
    for name in ("haspi", "hasqi"):
        means[f"{name}_mean"] = float(figures[name].mean())
        means[f"{name}_std"] = float(figures[name].std(ddof=1)) if len(rows) > 1 else None
    for name, normal in (("heard_off", "normal"), ("heard_off_clean", "normal_clean")):
        off = figures["heard"] - figures[normal]
        means |= {name: float(off.mean()), f"{name}_abs": float(np.abs(off).mean())}
    return means | {
        "level_mean": float(figures["level"].mean()),
        "peak_max": float(figures["peak"].max()),
        "band_error_mean": float(figures["band_error"].mean()),
    }


def _gap(rows: Rows, condition: str) -> dict[str, float | None]:
    """Mean loss under each simulator, and the median over items of the network's relative distance from pyclarity's."""
    figures = _columns(rows, condition)
    losses = {f"loss_{name}": float(figures[f"loss_{name}"].mean()) for name in SIMULATORS}
    apart = [gap(row["figures"][condition], "neuro", "pyclarity") for row in rows]
    known = [abs(value) for value in apart if value is not None]
    return {
        **losses,
        "neuro_to_msbg": gap(losses, "neuro", "msbg"),
        "neuro_to_pyclarity": gap(losses, "neuro", "pyclarity"),
        "msbg_to_pyclarity": gap(losses, "msbg", "pyclarity"),
        "item_median": float(np.median(known)) if known else None,
    }


def _peaks(rows: Rows, condition: str, limit: float | None) -> dict[str, Any]:
    peaks = _columns(rows, condition)["peak"]
    # float32 rounds the limit itself by as little
    over = None if limit is None else int((peaks > limit + 1e-4).sum())
    return {"n": len(peaks), "limit": limit, "highest": float(peaks.max()), "over": over}


def _columns(rows: Rows, condition: str) -> dict[str, np.ndarray]:
    figures = [row["figures"][condition] for row in rows]
    return {name: np.array([row[name] for row in figures]) for name in figures[0]}
