"""Compensators judged beside what a user would pick, on the same speech, ears, levels and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from compensators.nalr import NALR
from compensators.wdrc import WDRC
from hlsim.audiogram import Audiogram
from hlsim.audiogram.thresholds import as_thresholds
from hlsim.evaluation.enhancers import load_enhancers
from hlsim.evaluation.previous.compensator_result import MEASURES, compensator_result
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.items import INPUT_LEVELS, Item, draw_judged_items, read_ears
from hlsim.evaluation.previous.judging import (
    AtLevelOf,
    Enhanced,
    Equaliser,
    Keys,
    Trial,
    Unaided,
    judge,
    limit_of,
)
from hlsim.evaluation.previous.keys import weights_hash
from hlsim.evaluation.previous.measurements import (
    draw_utterances,
    gain_curves,
    insertion_gain,
    steady_tones,
    wearing,
)
from hlsim.evaluation.store import ScoreStore, key_of
from hlsim.extras import require
from hlsim.losses.band_levels import BANDS
from hlsim.metrics.pair import check_seed
from hlsim.metrics.registry import MEASURES as REGISTRY
from hlsim.metrics.registry import check_measures, version_of, versions_of
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Failed, Progress, check_parallel, make_missing
from hlsim.pretrained import load_pretrained

UNAIDED, PRESCRIBED, COMPRESSED = "unaided", "NAL-R", "WDRC"
"""The conditions that every compensator is compared with."""

_EQUALISED = "equaliser at {}'s level"

_REVISION = 3  # of what ``judge`` measures and how it is kept: raise it where that changes


@dataclass(frozen=True)
class CompensatorEvaluation:
    """What ``compensators.json`` holds: ``compensator_result``'s, and ``gain_curves``, ``steady_tones``, ``wearing``,
    ``notes`` and ``beside``, the conditions that a compensator is compared with beside those that all are;
    and the reports of each group of items that there is, ``clean``, ``noisy`` and ``hard``.
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
    enhancers: Sequence[str] = (),
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
    """Judge compensators beside no aid, NAL-R and WDRC, and each beside NAL-R and an equaliser at its own output level.

    The equaliser is for each ear a fixed filter with the compensator's mean gain on speech at ``levels``. An enhancer is
    judged before each aid, under conditions such as ``gtcrn + NAL-R``.

    Figures are stored as they are made, by the samples, the ear and the weights that they are of: a run that was
    stopped goes on where it was, one with a compensator more scores that one alone, and one with another simulator
    computes the surrogate gap alone. What fails is listed with the reason under ``failures`` of the result.

    Args:
        compensators: by name, modules at 16 kHz and 94 dB SPL full scale, called with a waveform and an ear. One with a
            ``config.limit_spl``, or ``limit_spl``, is held to it.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy, at 2.5 to 17.5 dB.
        store: file of figures, there or not; None keeps nothing.
        enhancers: names of plug-ins that remove noise before an aid, see ``load_enhancer``.
        audiograms: CSV file of ears that join Bisgaard's N2 to N6 and S1 to S3.
        audiogram: one ear in place of all, also of the gain curves, for a compensator that was trained for it.
        simulator: the Neuro-MSBG of the surrogate gap, by name or folder.
        items: how many in all. 400 give each main row 200 pairs.
        seconds: length of an item; HASPI is not to be trusted much under 3.
        levels: of the clean speech in dB SPL, in turn.
        gain_ears: standard ears of the gain curves and the steady tones.
        notes: sentences that the report begins with.
        jobs: processes; None takes all cores. The figures do not depend on it.
        progress: called with the number of outputs judged and of all.

    Raises:
        ValueError: data or settings that cannot be used, or no item could be judged.
        MissingExtraError: pandas or joblib is not installed.
    """
    require("pandas", "eval")
    check_measures(MEASURES)
    check_parallel(jobs, "loky", None)
    check_seed(seed)
    if items < 1 or not compensators or not levels:
        raise ValueError(
            f"{items} items at {len(levels)} levels for {len(compensators)} compensators; allowed: 1 or more of each"
        )
    if wrong := [level for level in levels if not 0.0 <= level <= 120.0]:
        raise ValueError(f"speech at {wrong[0]:g} dB SPL; allowed: 0 to 120")
    if taken := sorted({UNAIDED, PRESCRIBED, COMPRESSED} & set(compensators)):
        raise ValueError(
            f"a compensator named {taken[0]!r}; allowed: other names, that one is there anyway"
        )
    for name, aid in compensators.items():
        if not isinstance(aid, nn.Module):
            raise ValueError(
                f"compensator {name!r} is {type(aid).__name__}; allowed: a torch.nn.Module"
            )
    if (audiograms is None) == (audiogram is None):
        raise ValueError(
            "give either audiograms, a CSV file of ears, or audiogram, one ear in place of all"
        )
    if audiogram is None:
        ears, shown = read_ears(audiograms), {name: Audiogram.standard(name) for name in gain_ears}
    elif not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; allowed: an Audiogram, Audiogram.standard('N3')"
        )
    else:
        shown = {f"{' '.join(f'{level:g}' for level in audiogram.levels)} dB HL": audiogram}
        ears = [*shown.items()]
    for ear in shown.values():
        as_thresholds(ear)  # to be known before hours of judging
    before = load_enhancers(enhancers)
    aids = {
        PRESCRIBED: NALR(sample_rate=NEURO_RATE),
        COMPRESSED: WDRC(sample_rate=NEURO_RATE),
        **compensators,
    }
    aids = {name: module.eval() for name, module in aids.items()}
    enhanced = {
        name: {
            f"{prefix} + {name}": Enhanced(enhancer, aid).eval()
            for prefix, enhancer in before.items()
        }
        for name, aid in aids.items()
    }
    drawn = draw_judged_items(
        speech, noise, ears, items=items, seconds=seconds, seed=seed, levels=levels
    )
    utterances = draw_utterances(speech, seed)
    curves = gain_curves(
        aids, shown, utterances, levels
    )  # first: what cannot be used shows at once
    whole = {**aids, **dict(chain.from_iterable(own.items() for own in enhanced.values()))}
    steady = steady_tones({UNAIDED: Unaided(), **whole}, shown, levels)
    worn = wearing(whole, shown, utterances[0])
    conditions, beside = _conditions(aids, compensators, enhanced)
    by_ear = {}
    for ear in dict.fromkeys(item.ear for item in drawn):
        gains = {
            name: _mean_gains(aid, ear, utterances, levels) for name, aid in compensators.items()
        }
        own = {
            _EQUALISED.format(name): AtLevelOf(Equaliser(gains[name]), aid)
            for name, aid in compensators.items()
        }
        by_ear[ear] = conditions | own
    network = load_pretrained(simulator)
    judged = _judge_all(
        drawn, by_ear, network, seed, ScoreStore(store), jobs=jobs, progress=progress
    )
    settings: dict[str, Any] = {
        "items": items,
        "seconds": seconds,
        "seed": seed,
        "levels": [*levels],
    }
    settings |= {"ears": [name for name, _ in ears], "simulator": str(simulator)}
    settings |= {"enhancers": [str(enhancer) for enhancer in before.values()]}
    limits = {name: limit_of(module) for name, module in conditions.items()}
    result, reports = compensator_result(drawn, judged, limits=limits, settings=settings)
    result |= {"gain_curves": curves, "steady_tones": steady, "wearing": worn}
    result |= {"beside": beside, "notes": [*notes]}
    return CompensatorEvaluation(result, reports)


def _conditions(
    aids: Mapping[str, nn.Module],
    compensators: Mapping[str, nn.Module],
    enhanced: Mapping[str, Mapping[str, nn.Module]],
) -> tuple[dict[str, nn.Module], dict[str, list[str]]]:
    """All conditions, each after those that it is compared with, and the names of these; equalisers are flat as yet."""
    conditions: dict[str, nn.Module] = {UNAIDED: Unaided().eval()}
    beside: dict[str, list[str]] = {}
    for name, aid in aids.items():
        if name in compensators:
            as_loud = {
                f"{PRESCRIBED} at {name}'s level": AtLevelOf(aids[PRESCRIBED], aid),
                _EQUALISED.format(name): AtLevelOf(Unaided(), aid),
            }
            rivals = [
                UNAIDED,
                PRESCRIBED,
                COMPRESSED,
                *enhanced[PRESCRIBED],
                *as_loud,
                *enhanced[name],
            ]
            conditions |= {**as_loud, **enhanced[name], name: aid}
        else:
            rivals = [UNAIDED] if name == PRESCRIBED else [UNAIDED, PRESCRIBED]
            conditions |= {name: aid, **enhanced[name]}
            beside |= {own: [name] for own in enhanced[name]}
        beside[name] = rivals
    return conditions, beside


def _mean_gains(
    aid: nn.Module, ear: Audiogram, utterances: Tensor, levels: Sequence[float]
) -> list[float]:
    """Insertion gain in dB by band, the mean over the levels; NaN where there is none, and no score then."""
    try:
        gains = np.mean(insertion_gain(aid, ear, utterances, levels), 0).clip(-100.0, None)
    except Exception:  # whatever it is, it is told of the aid's own items
        return [math.nan] * BANDS
    return [
        round(gain, 1) for gain in gains.tolist()
    ]  # the same from machine to machine, for it is in keys


def _judge_all(
    items: Sequence[Item],
    conditions: Mapping[Audiogram, Mapping[str, nn.Module]],
    simulator: nn.Module,
    seed: int,
    store: ScoreStore,
    *,
    progress: Progress | None,
    **parallel: Any,
) -> list[dict[str, dict[str, float] | Failed]]:
    """Each item's figures by condition, those from the store among them; the conditions are by ear."""
    hashed = cache(weights_hash)
    weights = {
        ear: {name: hashed(module) for name, module in own.items()}
        for ear, own in conditions.items()
    }
    network = weights_hash(simulator)
    versions = {**versions_of(MEASURES), "hlsim": version_of("hlsim")}
    revisions = {name: REGISTRY[name].revision for name in MEASURES}
    trials = []
    by = {"revision": _REVISION, "versions": versions, "revisions": revisions}
    for number, item in enumerate(items):
        trial_seed = (seed + number) % 2**32
        about = {**by, "seed": trial_seed, **item.settings()}
        of = {name: {**about, "weights": found} for name, found in weights[item.ear].items()}
        keys = {
            name: Keys(key_of(it), key_of({**it, "simulator": network})) for name, it in of.items()
        }
        trials.append(Trial(item, conditions[item.ear], simulator, trial_seed, keys))
    if progress is not None:
        parallel["progress"] = lambda done, total: progress(
            done // 2, total // 2
        )  # both of an output
    failed = make_missing(
        judge, trials, lambda trial: [*chain.from_iterable(trial.keys.values())], store, **parallel
    )

    def judged(keys: Keys) -> dict[str, float] | Failed:
        if reasons := [failed[key] for key in keys if key in failed]:
            return Failed(reasons[0])
        return store.records[keys.most] | store.records[keys.of_network]

    return [{name: judged(keys) for name, keys in trial.keys.items()} for trial in trials]
