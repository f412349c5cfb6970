"""A report of items from folders or a manifest: scored, put together, written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from hlsim.audiogram import Audiogram
from hlsim.calibration import check_full_scale
from hlsim.evaluation.inputs import read_folders, read_manifest
from hlsim.evaluation.scores import Failure, HaspiReport, ItemScore
from hlsim.evaluation.scoring import FileItem, Result, score_items
from hlsim.evaluation.store import ScoreStore
from hlsim.extras import require
from hlsim.metrics.pyclarity import check_seed
from hlsim.metrics.registry import check_measures
from hlsim.parallel import Progress, check_parallel
from hlsim.report.haspi import check_out, write_report

SCORES_FILE = "scores.jsonl"


def haspi_report(
    clean: str | Path | None = None,
    before: str | Path | None = None,
    after: str | Path | None = None,
    audiogram: Audiogram | None = None,
    *,
    audiograms: str | Path | None = None,
    manifest: str | Path | None = None,
    root: str | Path | None = None,
    measures: Iterable[str] = ("haspi",),
    baseline: str | None = None,
    out: str | Path | None = None,
    store: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
    seed: int = 0,
    jobs: int | None = None,
    backend: str = "loky",
    scheduler: str | None = None,
    listen: int = 3,
    progress: Progress | None = None,
) -> HaspiReport:
    """HASPI v2 (and HASQI, STOI, PESQ) of speech under two conditions or more, with paired tests and levels.

    Files are taken as they are: one channel for one ear, no change of level, delay or length. Each score is stored as
    it is made, and a run that was stopped goes on where it was. A score that cannot be made (a broken, silent or short
    file) is listed in the report with its reason, and the rest go on.

    Args:
        clean, before, after: folders of wav, flac or ogg files whose names below the folder, but for the extension, are
            the same. Of one name, the three files have one rate and one length.
        audiogram: the ear, of all files, or of a manifest's rows that bring none; or else
        audiograms: for folders a CSV file with columns ``file`` and ``hl_250``,
            ``hl_500``, ... in dB HL, one row a file; for a manifest with ``listener`` and ``ear`` in place of ``file``.
        manifest: in place of the folders, a CSV file with a row a file, see ``hlsim.evaluation.inputs``.
        root: the folder that the manifest's paths are relative to; by default the manifest's own.
        measures: of ``haspi``, ``hasqi``, ``stoi``, ``pesq``; the first is the headline's.
        baseline: the condition that comes first and that all others are compared with; by default the manifest's first
            comes first, and all are compared with each other.
        out: folder for ``report.json``, ``.md``, ``.tex``, ``.html`` and ``before-after.png``; None writes nothing.
        store: file of scores; by default ``scores.jsonl`` in ``out``, or none.
        full_scale_spl: level in dB SPL of a file with RMS 1.0.
        spl: or else the level in dB SPL of every clean file, or of a manifest's rows that bring none; the processed ones
            are on the same scale.
        seed: of the noise that HASPI and HASQI add; each item has its own from it.
        jobs: processes; None takes all cores. The scores do not depend on it.
        backend, scheduler: ``"loky"``, or ``"dask"`` with the address of a Dask scheduler.
        listen: how many items the page shows with spectrograms and players, as heard.
        progress: called with the number of scores there and the number of all.

    Raises:
        ValueError: names differ between the folders, a manifest's row is wrong, a file has no audiogram, settings
            contradict each other, no item could be scored, or ``out`` is no folder. No report is written then.
        MissingExtraError: a measure's package, joblib, distributed or (with ``out``) matplotlib is not installed.
    """
    names = check_measures(measures)
    for module in ("matplotlib",) if out is not None else ():
        require(module, "eval")
    check_parallel(jobs, backend, scheduler)
    if out is not None:
        check_out(out)
        store = Path(out) / SCORES_FILE if store is None else store
    check_full_scale(full_scale_spl if spl is None else spl)
    check_seed(seed)
    if audiogram is not None and not isinstance(audiogram, Audiogram):
        raise ValueError(
            f"audiogram is {type(audiogram).__name__}; allowed: an Audiogram, one ear of all files"
        )
    folders = (clean, before, after)
    if manifest is not None and all(folder is None for folder in folders):
        items = read_manifest(
            manifest, root, audiogram=audiogram, audiograms=audiograms, full_scale_spl=full_scale_spl, spl=spl
        )
    elif manifest is None and root is None and clean is not None and before is not None and after is not None:
        items = read_folders(
            clean, before, after, audiogram, audiograms=audiograms, full_scale_spl=full_scale_spl, spl=spl
        )
    else:
        raise ValueError("give either the folders clean, before and after, or a manifest (and its root)")
    conditions = _conditions(items, baseline)
    scored = score_items(
        items,
        names,
        store=ScoreStore(store),
        seed=seed,
        jobs=jobs,
        backend=backend,
        scheduler=scheduler,
        progress=progress,
    )
    scores, failures = _gather(items, scored, conditions, names)
    if not scores:
        reasons = f"; the first, {failures[0].file}: {failures[0].reason}" if failures else ""
        raise ValueError(f"none of {len(items)} items could be scored{reasons}")
    report = HaspiReport(scores, measures=names, seed=seed, failures=failures, baseline=baseline)
    if out is not None:
        write_report(report, out, listen=listen)
    return report


def _conditions(items: Sequence[FileItem], baseline: str | None) -> list[str]:
    found = list(dict.fromkeys(condition for item in items for condition in item.processed))
    if len(found) < 2:
        raise ValueError(f"one condition only, {found[0]}; allowed: two or more to compare")
    if baseline is not None and baseline not in found:
        raise ValueError(f"no condition {baseline!r}; allowed: {', '.join(found)}")
    return found if baseline is None else [baseline, *(name for name in found if name != baseline)]


def _gather(
    items: Sequence[FileItem],
    scored: Sequence[dict[tuple[str, str], Result]],
    conditions: Sequence[str],
    measures: Sequence[str],
) -> tuple[list[ItemScore], list[Failure]]:
    scores, failures = [], []
    for item, results in zip(items, scored, strict=True):
        for (measure, condition), result in results.items():
            if result.score is None:
                failures.append(Failure(item.name, condition, measure, str(result.reason)))
        good = {key: result for key, result in results.items() if result.score is not None}
        if not good:
            continue
        fact = next(iter(good.values()))
        full_scale = item.full_scale(fact.clean_dbfs)
        by_condition = {condition: result for (_, condition), result in good.items()}
        scores.append(
            ItemScore(
                file=item.name,
                audiogram=item.audiogram,
                clean_level=fact.clean_dbfs + full_scale,
                levels={
                    name: by_condition[name].dbfs + full_scale if name in by_condition else None
                    for name in conditions
                },
                scores={
                    measure: {
                        name: float(score)
                        for name in conditions
                        if (measure, name) in good and (score := good[measure, name].score) is not None
                    }
                    for measure in measures
                },
                sample_rate=fact.sample_rate,
                seconds=fact.seconds,
                seed=fact.seed,
                full_scale_spl=full_scale,
                listener=item.listener,
                ear=item.ear,
                snr=item.snr,
                clean=item.clean,
                processed=item.processed,
            )
        )
    return scores, failures
