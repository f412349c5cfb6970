"""What a comparison of compensators comes to: summaries of each group of items, and the paired tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hlsim.audiogram import SEVERITIES
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.items import Item
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.extras import require
from hlsim.metrics.registry import MeasureName
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Failed

HARD = 0.6
"""Unaided HASPI under which an item belongs to those that need help most."""

MEASURES: tuple[MeasureName, ...] = ("haspi", "hasqi")

NOISIER_DB = 8.0
"""SNR under which speech in noise is told apart."""

Rows = Sequence[Mapping[str, Any]]


def compensator_result(
    items: Sequence[Item],
    judged: Sequence[Mapping[str, Mapping[str, float] | Failed]],
    *,
    limits: Mapping[str, float | None],
    settings: Mapping[str, Any],
) -> tuple[dict[str, Any], dict[str, HaspiReport]]:
    """Summaries of what ``judge`` made, for JSON, and the reports of the groups that there are.

    An item counts where every condition has figures, so that all rows are of the same items; ValueError where none has.

    Args:
        judged: figures of each item by condition, or why there are none.
        limits: the conditions in order, unaided first, and the peak in dB SPL that each keeps to, or None.
    """
    conditions = [*limits]
    failures, rows = [], []
    for number, (item, results) in enumerate(zip(items, judged, strict=True)):
        bad = {name: found.reason for name, found in results.items() if isinstance(found, Failed)}
        failures += [
            {"item": number, **item.about, "compensator": name, "reason": bad[name]} for name in bad
        ]
        if not bad:
            about = {**item.about, "audiogram": list(item.ear.thresholds)}
            rows.append({"item": number, **about, "figures": dict(results)})
    if not rows:
        raise ValueError(
            f"none of {len(items)} items could be judged; the first: {failures[0]['reason']}"
        )
    groups: dict[str, Rows] = {
        name: [row for row in rows if row["condition"] == name] for name in ("clean", "noisy")
    }
    groups["hard"] = [row for row in rows if row["figures"][conditions[0]]["haspi"] < HARD]
    groups = {name: group for name, group in groups.items() if group}
    reports = {name: _report(group, items, settings) for name, group in groups.items()}
    frames = {name: {c: _frame(group, c) for c in conditions} for name, group in groups.items()}
    result = {
        **settings,
        "limits": dict(limits),
        "groups": {
            name: {
                "n": len(group),
                "conditions": {c: _summary(frame) for c, frame in frames[name].items()},
                "comparisons": [c.to_dict() for c in reports[name].comparisons],
            }
            for name, group in groups.items()
        },
        "gap": {
            name: {c: _gap(frame) for c, frame in frames[name].items()}
            for name in ("clean", "noisy")
            if name in groups
        },
        "peaks": {name: _peaks(_frame(rows, name).peak, limit) for name, limit in limits.items()},
        "versions": next(iter(reports.values())).versions,
        "failures": failures,
        "rows": rows,
    }
    return result, reports


def _report(rows: Rows, items: Sequence[Item], settings: Mapping[str, Any]) -> HaspiReport:
    def of(row: Mapping[str, Any], figure: str) -> dict[str, float]:
        return {name: figures[figure] for name, figures in row["figures"].items()}

    scores = [
        ItemScore(
            file=f"item {row['item']}",
            audiogram=items[row["item"]].ear,
            clean_level=row["level"],
            levels=of(row, "level"),
            scores={measure: of(row, measure) for measure in MEASURES},
            sample_rate=NEURO_RATE,
            seconds=settings["seconds"],
            seed=(settings["seed"] + row["item"]) % 2**32,
            listener=row["name"],  # utterances are nested in ears
            snr=row["snr"],
        )
        for row in rows
    ]
    return HaspiReport(scores, measures=MEASURES, unit="ears", seed=settings["seed"])


def _frame(rows: Rows, condition: str) -> Any:
    """For pandas: a row an item, with its severity, given level, SNR (NaN without noise) and a condition's figures."""
    names = {"severity": "severity", "level": "given", "snr": "snr"}
    about = [
        {new: row[old] for old, new in names.items()} | row["figures"][condition] for row in rows
    ]
    return require("pandas", "eval").DataFrame(about).astype({"snr": float})


def _summary(frame: Any) -> dict[str, Any]:
    """Means over all, by input level, by degree of loss and, of what is noisy, by SNR."""
    by_severity = dict(list(frame.groupby("severity")))
    by_snr = {"under": frame[frame.snr < NOISIER_DB], "over": frame[frame.snr >= NOISIER_DB]}
    return {
        **_means(frame),
        "by_level": {f"{level:g}": _means(part) for level, part in frame.groupby("given")},
        "by_severity": {
            name: _means(by_severity[name]) for name in SEVERITIES if name in by_severity
        },
        "by_snr": {name: _means(part) for name, part in by_snr.items() if len(part)},
    }


def _means(frame: Any) -> dict[str, Any]:
    """Means and, of the scores, deviations with n - 1; levels in dB SPL.

    ``heard_off`` is the level heard less a normal ear's of the same input, ``heard_off_clean`` less its of the clean
    speech; ``_abs`` is the mean of the absolute differences.
    """
    means: dict[str, Any] = {"n": len(frame)}
    for name in MEASURES:
        means[f"{name}_mean"] = float(frame[name].mean())
        means[f"{name}_std"] = float(frame[name].std()) if len(frame) > 1 else None
    for key, normal in (("heard_off", "normal"), ("heard_off_clean", "normal_clean")):
        off = frame.heard - frame[normal]
        means |= {key: float(off.mean()), f"{key}_abs": float(off.abs().mean())}
    return means | {
        "level_mean": float(frame.level.mean()),
        "peak_max": float(frame.peak.max()),
        "band_error_mean": float(frame.band_error.mean()),
    }


def _gap(frame: Any) -> dict[str, float | None]:
    """Mean loss under each simulator, how far the network's lies from the exact model's, relative, and the items' median.

    None where the exact model's is 0. It is where nothing is lost: clean speech as it is, in an ear without a loss.
    """
    neuro, exact = float(frame.loss_neuro.mean()), float(frame.loss_msbg.mean())
    known = frame[frame.loss_msbg != 0.0]
    median = (known.loss_neuro / known.loss_msbg - 1.0).abs().median()
    return {
        "loss_neuro": neuro,
        "loss_msbg": exact,
        "neuro_to_msbg": neuro / exact - 1.0 if exact else None,
        "item_median": float(median) if len(known) else None,
    }


def _peaks(peaks: Any, limit: float | None) -> dict[str, Any]:
    # float32 rounds the limit itself by as little
    over = None if limit is None else int((peaks > limit + 1e-4).sum())
    return {"n": len(peaks), "limit": limit, "highest": float(peaks.max()), "over": over}
