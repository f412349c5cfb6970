"""Compensators judged beside no aid and NAL-R, on the same speech, ears, levels and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

from torch import nn

from compensators.nalr import NALR
from hlsim.audiogram import Audiogram, as_thresholds
from hlsim.evaluation.compensator_result import MEASURES, compensator_result
from hlsim.evaluation.gain_curves import gain_curves
from hlsim.evaluation.haspi_report import HaspiReport
from hlsim.evaluation.items import INPUT_LEVELS, Item, draw_judged_items, read_ears
from hlsim.evaluation.judging import EXACT, Judged, Keys, Trial, Unaided, judge
from hlsim.evaluation.steadiness import shift_differences, steady_tones
from hlsim.evaluation.store import ScoreStore, key_of, weights_hash
from hlsim.extras import require
from hlsim.metrics.pair import check_seed
from hlsim.metrics.registry import check_measures, measure_by, version_of, versions_of
from hlsim.neuro.config import NEURO_RATE
from hlsim.parallel import Progress, check_parallel, make_missing
from hlsim.pretrained import load_pretrained

UNAIDED, PRESCRIBED = "unaided", "NAL-R"
"""The conditions that every compensator is compared with."""

_SHIFTED = 6  # items, of which every condition has figures

_REVISION = 2  # of what ``judge`` measures and how it is kept: raise it where that changes


@dataclass(frozen=True)
class CompensatorEvaluation:
    """What ``compensators.json`` holds: ``compensator_result``'s, and ``gain_curves``, ``steady_tones``, ``shifts`` and
    ``notes``; and the reports of each group of items that there is, ``clean``, ``noisy`` and ``hard``.
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
    engine: str = "hlsim",
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

    Figures are stored as they are made, by the samples, the ear and the weights that they are of: a run that was
    stopped goes on where it was, one with a compensator more scores that one alone, and one with another simulator
    computes the surrogate gap alone. Without pyclarity installed the gap under its
    MSBG is left out. What fails is listed with the reason under ``failures`` of the result.

    Args:
        compensators: by name, modules at 16 kHz and 94 dB SPL full scale, called with a waveform and an ear. One with a
            ``config.limit_spl``, or ``limit_spl``, is held to it.
        speech, noise: folders of recordings; with ``noise`` every second item is noisy, at 2.5 to 17.5 dB.
        store: file of figures, there or not; None keeps nothing.
        audiograms: CSV file of ears that join Bisgaard's N2 to N6 and S1 to S3.
        audiogram: one ear in place of all, also of the gain curves, for a compensator that was trained for it.
        simulator: the Neuro-MSBG of the surrogate gap, by name or folder.
        engine: of HASPI and HASQI, see ``haspi_report``.
        items: how many in all. 400 give each main row 200 pairs.
        seconds: length of an item; HASPI is not to be trusted much under 3.
        levels: of the clean speech in dB SPL, in turn.
        gain_ears: standard ears of the gain curves and the steady tones.
        notes: sentences that the report begins with.
        jobs: processes; None takes all cores. The figures do not depend on it.
        progress: called with the number of outputs judged and of all.

    Raises:
        ValueError: data or settings that cannot be used, or no item could be judged.
        MissingExtraError: pandas, joblib or, for its engine, pyclarity is not installed.
    """
    require("pandas", "eval")
    check_measures(MEASURES, engine)
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
    network = load_pretrained(simulator)
    judged = _judge_all(
        drawn, conditions, network, engine, seed, ScoreStore(store), jobs=jobs, progress=progress
    )
    settings = {"items": items, "seconds": seconds, "seed": seed, "engine": engine, "levels": [*levels]}
    settings |= {"ears": [name for name, _ in ears], "simulator": str(simulator)}
    # the peak in dB SPL that a compensator promises not to pass
    limits = {
        name: getattr(getattr(module, "config", module), "limit_spl", None)
        for name, module in conditions.items()
    }
    result, reports = compensator_result(drawn, judged, limits=limits, settings=settings)
    shifted = sorted(result["rows"], key=lambda row: row["condition"] != "clean")[:_SHIFTED]
    shifts = shift_differences(aided, {row["item"]: drawn[row["item"]] for row in shifted})
    result |= {"gain_curves": curves, "steady_tones": steady, "shifts": shifts, "notes": [*notes]}
    return CompensatorEvaluation(result, reports)


def _judge_all(
    items: Sequence[Item],
    conditions: Mapping[str, nn.Module],
    simulator: nn.Module,
    engine: str,
    seed: int,
    store: ScoreStore,
    *,
    progress: Progress | None,
    **parallel: Any,
) -> list[dict[str, Judged]]:
    """Each item's figures by condition, those from the store among them."""
    weights = {name: weights_hash(module) for name, module in conditions.items()}
    network = weights_hash(simulator)
    # of pyclarity's MSBG, too
    versions = {**versions_of(MEASURES, "pyclarity"), "hlsim": version_of("hlsim")}
    # figures by pyclarity were stored when there was no other engine
    revisions = {name: measure_by(engine, name).revision for name in MEASURES}
    by = {} if engine == "pyclarity" else {"engine": engine, "revisions": revisions}
    exact = EXACT if find_spec("clarity") else EXACT[:1]
    trials = []
    for number, item in enumerate(items):
        trial_seed = (seed + number) % 2**32
        about = {"revision": _REVISION, "versions": versions, "seed": trial_seed, **item.settings(), **by}
        of = {name: {**about, "weights": weights[name]} for name in conditions}
        keys = {name: Keys(key_of(it), key_of({**it, "simulator": network})) for name, it in of.items()}
        trials.append(Trial(item, conditions, simulator, trial_seed, keys, engine, exact))
    if progress is not None:
        parallel["progress"] = lambda done, total: progress(done // 2, total // 2)  # both of an output
    failed = make_missing(
        judge, trials, lambda trial: [*chain.from_iterable(trial.keys.values())], store, **parallel
    )

    def judged(keys: Keys) -> Judged:
        if reasons := [failed[key] for key in keys if key in failed]:
            return Judged(None, reasons[0])
        figures = store.records[keys.most] | store.records[keys.of_network]
        return Judged({name: value for name, value in figures.items() if name != "engine"})

    return [{name: judged(keys) for name, keys in trial.keys.items()} for trial in trials]
