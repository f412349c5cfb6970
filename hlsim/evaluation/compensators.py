"""Compensators judged beside no aid and NAL-R, on the same speech, ears, levels and noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from torch import nn

from compensators.nalr import NALR
from hlsim.audiogram import Audiogram, as_thresholds
from hlsim.evaluation.compensator_result import compensator_result
from hlsim.evaluation.gain_curves import gain_curves
from hlsim.evaluation.haspi_report import HaspiReport
from hlsim.evaluation.items import Item
from hlsim.evaluation.judging import (
    INPUT_LEVELS,
    OF_NETWORK,
    Judged,
    Task,
    Unaided,
    draw_judged_items,
    judge,
    read_ears,
)
from hlsim.evaluation.simulators import samples_hash, weights_hash
from hlsim.evaluation.steadiness import shift_differences, steady_tones
from hlsim.evaluation.store import ScoreStore, key_of
from hlsim.extras import require
from hlsim.metrics.pyclarity import Progress, check_seed
from hlsim.metrics.registry import version_of, versions_of
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import check_parallel, run_parallel
from hlsim.pretrained import load_pretrained

UNAIDED, PRESCRIBED = "unaided", "NAL-R"
"""The conditions that every compensator is compared with."""

_SHIFTED = 6  # items, of which every condition has figures

_REVISION = 2  # of what ``judge`` measures and how it is kept: raise it where that changes


@dataclass(frozen=True)
class CompensatorEvaluation:
    """What a comparison of compensators comes to.

    Attributes:
        result: what ``compensators.json`` holds: ``compensator_result``'s, and ``gain_curves``, ``steady_tones``,
            ``shifts`` and ``notes``.
        reports: of each group of items that there is, ``clean``, ``noisy`` and ``hard``.
    """

    result: dict[str, Any]
    reports: Mapping[str, HaspiReport]


def evaluate_compensators(
    compensators: Mapping[str, nn.Module],
    *,
    speech: str | Path,
    store: str | Path | None = None,
    audiograms: str | Path | None = None,
    audiogram: Audiogram | None = None,
    noise: str | Path | None = None,
    simulator: str | Path = "neuro-msbg",
    items: int = 400,
    seconds: float = 3.0,
    levels: Sequence[float] = INPUT_LEVELS,
    gain_ears: Sequence[str] = ("N3", "S2"),
    notes: Sequence[str] = (),
    seed: int = 0,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> CompensatorEvaluation:
    """Judge compensators beside no aid and NAL-R.

    Figures are stored as they are made, by the samples, the ear and the weights that they are of: a
    run that was stopped goes on where it was, one with a compensator more scores that one alone, and one with another
    simulator computes the surrogate gap alone.

    Args:
        compensators: by name, modules at 16 kHz and 94 dB SPL full scale, called with a waveform and an ear. One with a
            ``config.limit_spl`` is held to it.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy, at 2.5 to 17.5 dB.
        store: file of figures, there or not; None keeps nothing.
        audiograms: CSV file of ears that join Bisgaard's N2 to N6 and S1 to S3.
        audiogram: one ear in place of all, for a compensator that was trained for it.
        simulator: the Neuro-MSBG of the surrogate gap, by name or folder.
        items: how many in all. 400 give each main row 200 pairs.
        seconds: length of an item; HASPI is not to be trusted much under 3.
        levels: of the clean speech in dB SPL, in turn.
        gain_ears: standard ears of the gain curves and the steady tones; with ``audiogram``, that ear in their place.
        notes: sentences that the report begins with.
        jobs: processes; None takes all cores. The figures do not depend on it.
        progress: called with the number of outputs judged and of all.

    Returns: an evaluation. Items that failed are listed in its result with the reason, under ``failures``.

    Raises:
        ValueError: data or settings that cannot be used, or no item could be judged.
        MissingExtraError: pyclarity or joblib is not installed.
    """
    require("clarity", "eval")
    check_parallel(jobs, "loky", None)
    check_seed(seed)
    if items < 1 or not compensators or not levels:
        raise ValueError(
            f"{items} items at {len(levels)} levels for {len(compensators)} compensators; allowed: 1 or more of each"
        )
    if taken := sorted({UNAIDED, PRESCRIBED} & set(compensators)):
        raise ValueError(f"a compensator named {taken[0]!r}; allowed: other names, that one is there anyway")
    if (audiograms is None) == (audiogram is None):
        raise ValueError("give either audiograms, a CSV file of ears, or audiogram, one ear in place of all")
    if audiogram is None:
        ears, shown = read_ears(audiograms), {name: Audiogram.standard(name) for name in gain_ears}
    else:
        shown = {f"{' '.join(f'{level:g}' for level in audiogram.levels)} dB HL": audiogram}
        ears = [*shown.items()]
    for ear in shown.values():
        as_thresholds(ear)  # to be known before hours of judging
    conditions = {UNAIDED: Unaided(), PRESCRIBED: NALR(sample_rate=NEURO_RATE), **compensators}
    conditions = {name: module.eval() for name, module in conditions.items()}
    drawn = draw_judged_items(speech, noise, ears, items=items, seconds=seconds, seed=seed, levels=levels)
    aided = {name: module for name, module in conditions.items() if name != UNAIDED}
    curves = gain_curves(aided, shown, speech, levels, seed)  # first: what cannot be used shows at once
    steady = steady_tones(conditions, shown, levels)
    judged = _judge_all(
        _Panel(drawn, conditions, load_pretrained(simulator), seed),
        ScoreStore(store),
        jobs,
        progress,
    )
    result, reports = compensator_result(
        drawn,
        judged,
        limits={name: _limit(module) for name, module in conditions.items()},
        settings={
            "items": items,
            "seconds": seconds,
            "seed": seed,
            "levels": [*levels],
            "ears": [name for name, _ in ears],
            "simulator": str(simulator),
        },
    )
    shifted = sorted(result["rows"], key=lambda row: row["condition"] != "clean")[:_SHIFTED]
    shifts = shift_differences(aided, {row["item"]: drawn[row["item"]] for row in shifted})
    result |= {"gain_curves": curves, "steady_tones": steady, "shifts": shifts, "notes": [*notes]}
    return CompensatorEvaluation(result, reports)


class _Keys(NamedTuple):
    """Under which figures are stored: all but ``OF_NETWORK``, which hangs on more, and that one."""

    most: str
    of_network: str


@dataclass(frozen=True)
class _Panel:
    """All that is to be judged."""

    items: Sequence[Item]
    conditions: Mapping[str, nn.Module]
    simulator: nn.Module
    seed: int

    def keys(self) -> Iterator[dict[str, _Keys]]:
        """What each item's figures are stored under, by condition."""
        weights = {name: weights_hash(module) for name, module in self.conditions.items()}
        about = {
            "revision": _REVISION,
            "versions": {**versions_of(["haspi", "hasqi"]), "hlsim": version_of("hlsim")},
        }
        network = weights_hash(self.simulator)
        for number, item in enumerate(self.items):
            own = about | {
                "signal": samples_hash(item.clean, item.signal),
                "ear": list(item.ear.thresholds),
                "seed": self.item_seed(number),
            }
            of = {name: {**own, "weights": weights[name]} for name in self.conditions}
            yield {
                name: _Keys(key_of(settings), key_of({**settings, "simulator": network}))
                for name, settings in of.items()
            }

    def item_seed(self, number: int) -> int:
        return (self.seed + number) % 2**32


def _judge_all(
    panel: _Panel, store: ScoreStore, jobs: int | None, progress: Progress | None
) -> list[dict[str, Judged]]:
    """Each item's figures by condition, those from the store among them."""
    keys = list(panel.keys())
    judged: list[dict[str, Judged]] = []
    tasks = []
    for number, (item, own) in enumerate(zip(panel.items, keys, strict=True)):
        known = {name: record for name, key in own.items() if (record := store.get(key.most)) is not None}
        found = {
            name: known[name] | record
            for name, key in own.items()
            if name in known and (record := store.get(key.of_network)) is not None
        }
        judged.append({name: Judged(record) for name, record in found.items()})
        missing = {name: module for name, module in panel.conditions.items() if name not in found}
        if missing:
            left = {name: known[name] for name in missing if name in known}
            tasks.append(Task(number, item, missing, panel.simulator, panel.item_seed(number), left))
    total = len(panel.items) * len(panel.conditions)
    done = total - sum(len(task.compensators) for task in tasks)
    if progress is not None and done and tasks:
        progress(done, total)
    for task, result in run_parallel(judge, tasks, jobs=jobs) if tasks else ():
        if result is None:
            died = Judged(None, "the process that judged it died (a crash in a measure, or memory ran out)")
            result = dict.fromkeys(task.compensators, died)
        for name, own_result in result.items():
            if own_result.figures is not None:
                most, key = dict(own_result.figures), keys[task.number][name]
                store.append(key.of_network, {OF_NETWORK: most.pop(OF_NETWORK)})
                if name not in task.known:
                    store.append(key.most, most)
        judged[task.number].update(result)
        done += len(result)
        if progress is not None:
            progress(done, total)
    return judged


def _limit(compensator: nn.Module) -> float | None:
    """Peak in dB SPL that a compensator promises not to pass, or None."""
    return getattr(getattr(compensator, "config", None), "limit_spl", None)
