"""Compensators judged beside what a user would choose, on the same speech, ears, levels and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from compensators.nalr import NALR
from compensators.wdrc import WDRC
from hlsim.audiogram import Audiogram
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.evaluation.aids import (
    AtLevelOf,
    Enhanced,
    EqualiserLike,
    Unaided,
    limit_of,
    load_enhancers,
)
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.items import INPUT_LEVELS, draw_judged_items, read_ears
from hlsim.evaluation.measurements import draw_utterances, gain_curves, steady_tones, wearing
from hlsim.evaluation.measures import LEVELS, PERCEPTION, find_measures, network_loss
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.study import Condition
from hlsim.extras import require
from hlsim.metrics.pair import check_seed
from hlsim.neuro.config import NEURO_RATE
from hlsim.neuro.pretrained import load_pretrained
from hlsim.plugins import WaveformPlugin

UNAIDED, NAL_R, COMPRESSION = "unaided", "NAL-R", "WDRC"
"""Names of the conditions that every compensator is compared with."""

HARD = 0.6
"""Unaided HASPI below which an item belongs to the group ``hard``."""


def evaluate_compensators(
    compensators: Mapping[str, nn.Module],
    *,
    speech: str | Path,
    store: str | Path | None = None,
    audiograms: str | Path | None = None,
    audiogram: Audiogram | None = None,
    noise: str | Path | None = None,
    enhancers: Sequence[str] = (),
    simulator: str | Path = "neuro-msbg",
    measures: Sequence[str] = (),
    items: int = 400,
    seconds: float = 3.0,
    levels: Sequence[float] = INPUT_LEVELS,
    gain_ears: Sequence[str] = ("N3", "S2"),
    notes: Sequence[str] = (),
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Judge compensators beside no aid, NAL-R and WDRC, and beside two rivals at their own output level.

    The rivals are NAL-R and an equaliser: for each ear a fixed filter with the compensator's mean gain for
    speech at ``levels``. The comparison with NAL-R at the compensator's level by HASPI is planned.

    Values are stored as they become known. A run that was stopped continues where it was, one with a further
    compensator computes that one alone, and one with another simulator computes the surrogate gap alone. An
    item counts only if every condition has all its values.

    Args:
        compensators: modules by name, at 16 kHz and 94 dB SPL full scale, called with a waveform and an
            ear. The peaks of one with an attribute ``limit_spl``, or ``config.limit_spl``, are compared with it.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy, at 2.5 to 17.5 dB.
        store: file of values, which is created if it does not exist; None stores nothing.
        audiograms: CSV file of ears that join Bisgaard's N2 to N6 and S1 to S3.
        audiogram: one ear in place of all, also for the gain curves; for a compensator that was trained for it.
        enhancers: names ``package.module:name`` of callables ``(waveform, sample_rate) -> waveform`` that
            reduce noise before each aid, under conditions such as ``gtcrn + NAL-R``.
        simulator: the Neuro-MSBG of the surrogate gap, by name or folder.
        measures: further measures beside HASPI and HASQI.
        items: number of items. 400 give each main row 200 pairs.
        seconds: length of an item; HASPI is not reliable much below 3.
        levels: levels of the clean speech in dB SPL, in turn.
        gain_ears: standard ears of the gain curves and the steady tones.
        notes: sentences that the report begins with.
        running: ``jobs``, ``dask`` and ``progress``, as in ``run_study``.

    Returns: the evaluation with the groups ``clean``, ``noisy`` and ``hard`` as far as they have items, and the
        details ``gain_curves``, ``steady_tones`` and ``wearing``.

    Raises:
        ValueError: data or settings that cannot be used, or no item has all its values.
        MissingExtraError: a package is not installed.
    """
    require("pandas", "eval")
    check_seed(seed)
    _check_arguments(compensators, items, levels)
    ears, shown = _choose_ears(audiograms, audiogram, gain_ears)
    utterances = draw_utterances(speech, seed)
    enhancing = load_enhancers(enhancers)
    prescriptions = {NAL_R: NALR(sample_rate=NEURO_RATE), COMPRESSION: WDRC(sample_rate=NEURO_RATE)}
    aids = {name: aid.eval() for name, aid in {**prescriptions, **compensators}.items()}
    conditions = _conditions(aids, compensators, enhancing, utterances, levels)
    kinds = ("aid", "prescription", "enhanced")
    worn = {c.name: c.process for c in conditions if c.process and c.kind in kinds}
    # these come first: what cannot be used shows at once
    details = {
        "gain_curves": gain_curves(aids, shown, utterances, levels),
        "steady_tones": steady_tones({UNAIDED: Unaided(), **worn}, shown, levels),
        "wearing": wearing(worn, shown, utterances[0]),
    }
    drawn = draw_judged_items(
        speech, noise, ears, items=items, seconds=seconds, seed=seed, levels=levels
    )
    scores = find_measures(["haspi", "hasqi", *measures])
    evaluation = Evaluation.run(
        drawn,
        conditions,
        [*scores, LEVELS, PERCEPTION, network_loss(load_pretrained(simulator))],
        store=store,
        settings={
            "items": items,
            "seconds": seconds,
            "seed": seed,
            "levels": list(levels),
            "simulator": str(simulator),
            "enhancers": list(map(str, enhancing.values())),
        },
        **running,
    )
    limits = {condition.name: limit_of(condition.process) for condition in conditions}
    table = evaluation.table
    # float32 rounds the limit itself by as little
    beyond = table["peak"] > table["condition"].map(limits).astype(float) + 1e-4
    gap = table["loss_neuro"] / table["loss_msbg"].where(table["loss_msbg"] != 0.0) - 1.0
    table = table.assign(beyond_limit=beyond, gap=gap)
    evaluation = replace(evaluation, table=table, notes=notes, details=details)
    return replace(evaluation, groups=_groups(evaluation))


def _check_arguments(
    compensators: Mapping[str, nn.Module], items: int, levels: Sequence[float]
) -> None:
    if items < 1 or not compensators or not levels:
        raise ValueError("an evaluation needs at least one compensator, one item and one level")
    for level in levels:
        if not 0.0 <= level <= 120.0:
            raise ValueError(f"the level is {level:g} dB SPL; expected 0 to 120")
    for name, aid in compensators.items():
        if name in (UNAIDED, NAL_R, COMPRESSION):
            raise ValueError(f"{name} is always evaluated; give the compensator another name")
        if not isinstance(aid, nn.Module):
            raise ValueError(f"compensator {name} is {type(aid).__name__}, not a torch.nn.Module")


def _choose_ears(
    audiograms: str | Path | None, audiogram: Audiogram | None, gain_ears: Sequence[str]
) -> tuple[list[tuple[str, Audiogram]], dict[str, Audiogram]]:
    """Return the ears of the items and those of the gain curves, by name."""
    if (audiograms is None) == (audiogram is None):
        raise ValueError(
            "give either audiograms, a CSV file of ears, or audiogram, one ear for all"
        )
    if audiogram is None:
        ears, shown = read_ears(audiograms), {name: Audiogram.standard(name) for name in gain_ears}
    else:
        thresholds = " ".join(f"{level:g}" for level in audiogram.levels)
        shown = {f"{thresholds} dB HL": audiogram}
        ears = list(shown.items())
    for ear in shown.values():
        as_thresholds(ear)  # rejects what a simulator does not take
    return ears, shown


def _conditions(
    aids: Mapping[str, nn.Module],
    compensators: Mapping[str, nn.Module],
    enhancers: Mapping[str, WaveformPlugin],
    utterances: Tensor,
    levels: Sequence[float],
) -> list[Condition]:
    """Return all conditions, each after those that it is compared with."""
    conditions = [Condition(UNAIDED, Unaided().eval(), kind="unaided")]
    for name, aid in aids.items():
        enhanced = [
            Condition(f"{prefix} + {name}", Enhanced(e, aid).eval(), "enhanced", name, [name])
            for prefix, e in enhancers.items()
        ]
        if name not in compensators:
            rivals = [UNAIDED] if name == NAL_R else [UNAIDED, NAL_R]
            conditions += [Condition(name, aid, "prescription", rivals=rivals), *enhanced]
            continue
        equaliser = EqualiserLike(aid, utterances, levels)
        same_level = [
            Condition(
                f"{NAL_R} at {name}'s level", AtLevelOf(aids[NAL_R], aid), "same level", name
            ),
            Condition(f"equaliser at {name}'s level", AtLevelOf(equaliser, aid), "equaliser", name),
        ]
        own = [condition.name for condition in (*same_level, *enhanced)]
        prescribed = [c.name for c in conditions if c.of == NAL_R]
        rivals = [own[0], own[1], UNAIDED, NAL_R, COMPRESSION, *prescribed, *own[2:]]
        conditions += [*same_level, *enhanced, Condition(name, aid, "aid", rivals=rivals)]
    return conditions


def _groups(evaluation: Evaluation) -> dict[str, Evaluation]:
    """Return the evaluation of clean speech, of speech in noise, and of items that need help most.

    An item that lacks a value under one condition is in no group.
    """
    table = evaluation.table[~evaluation.table["item"].isin(evaluation.failures["item"])]
    if table.empty:
        first = evaluation.failures.iloc[0]
        raise ValueError(f"no item has all its values; the first: {first['failure']}")
    unaided = table[table["condition"] == UNAIDED].set_index("item")
    members = {
        "clean": unaided["speech"] == "clean",
        "noisy": unaided["speech"] == "noisy",
        "hard": unaided["haspi"] < HARD,
    }
    same_level = [c for c in evaluation.conditions if c.kind == "same level"]
    planned = [("haspi", condition.name, condition.of) for condition in same_level]
    groups = {}
    for name, chosen in members.items():
        part = table[table["item"].map(chosen)]
        if not part.empty:
            comparisons = compare(part, evaluation.scores, planned=planned, unit="ear")
            groups[name] = replace(evaluation, table=part, comparisons=comparisons)
    return groups
