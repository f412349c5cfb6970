"""The study of ``haspi-report``: it scores and compares outputs that were recorded in files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hlsim.audiogram import as_audiogram
from hlsim.audiogram.scale import EARS
from hlsim.audiogram.value import EarLike
from hlsim.evaluation.comparison import PlannedComparison, compare
from hlsim.evaluation.conditions import AFTER, BEFORE
from hlsim.evaluation.measures import ALIGNMENT, CORRELATION_FLOOR, LEVELS, find_lag, find_measures
from hlsim.evaluation.recorded_items import (
    RecordedItem,
    join_name,
    read_folders,
    read_named_ears,
    read_recordings,
)
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.parallel import check_scheduler
from hlsim.evaluation.sounds import perceive_items
from hlsim.evaluation.study import Condition

if TYPE_CHECKING:
    from pandas import DataFrame

LATE_MS = 4.0
"""Lag of an output in ms, late or early, above which a report has a note."""

_INTERAURAL_SECONDS = 0.002
"""Largest lag in seconds between the clean files of both ears if they contain the same sound."""

_EAR_FACTS = ("source", "ear", "severity", "audiogram", "full_scale_spl", "clean_level")
"""Columns of the table that describe the item of one ear of a listener."""


def haspi_report(
    clean: str | Path | None = None,
    before: str | Path | None = None,
    after: str | Path | None = None,
    audiogram: EarLike | None = None,
    *,
    conditions: Mapping[str, str | Path] | None = None,
    audiograms: str | Path | DataFrame | None = None,
    manifest: str | Path | DataFrame | None = None,
    root: str | Path | None = None,
    measures: Sequence[str] = ("haspi",),
    precision: int = 32,
    baseline: str | None = None,
    better_ear: bool = False,
    store: str | Path | None = None,
    full_scale_spl: float = 94.0,
    spl: float | None = None,
    seed: int = 0,
    listen: int = 0,
    **running: Any,
) -> Evaluation:
    """Score recorded speech by HASPI v2 and other measures, and compare its conditions.

    With ``store``, an interrupted run can be continued. A file that cannot be scored is listed with
    the reason.

    Args:
        clean: Folder of clean speech.
        before, after: Folders of the speech before and after a treatment, such as an aid, with
            files of the same names. Without ``before``, there are scores and no comparison.
        audiogram: The ear of all files, or of those rows of the manifest that have no audiogram.
        conditions: Folder of the outputs of each condition, instead of ``before`` and ``after``,
            such as ``{"noisy": "noisy", "A": "system-a", "B": "system-b"}``.
        audiograms: Table of ears. With folders, each file is scored for each of these ears, see
            ``read_audiograms``; with a manifest, they are those of its listeners, see
            ``read_listeners``.
        manifest: CSV file or DataFrame instead of the folders, with one row per output file and the
            columns ``condition``, ``clean`` and ``processed``, and optionally ``listener``,
            ``ear``, ``item``, ``snr`` (dB), and ``hl_250``, ... or ``audiogram``.
        root: Folder to which the paths in the manifest are relative; by default the manifest's, or
            the current folder for a DataFrame.
        measures: Names of measures, the most important first: ``haspi``, ``hasqi``, ``haaqi``,
            ``stoi``, ``pesq`` or ``package.module:name``.
        precision: Number of bits with which HASPI, HASQI and HAAQI are computed, 32 or 64.
        baseline: Condition with which all other conditions are compared. By default, all
            conditions are compared with each other.
        better_ear: Whether to use the better ear's score of each utterance. An utterance that
            lacks the score of one ear is left out of the condition, and listed with the reason.
        store: File of scores, which is created if it does not exist; None stores nothing.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        spl: Level of every clean file in dB SPL over all its channels, which have one gain; it
            replaces ``full_scale_spl``.
        seed: Seed of the noise that HASPI, HASQI and HAAQI add.
        listen: Number of items with sounds for the players of a page, as the ear perceives them.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation. The comparison of the first condition, or ``baseline``, with the last of the
        others by the first measure counts as planned before the scores were known, so its p values
        are not adjusted.

    Raises:
        ValueError: Folders, manifest and ears do not go together, files do not match, a row of
            the manifest is not valid, ``better_ear`` is set and an utterance lacks an ear or has
            other speech at it, there is no such measure, precision or baseline, no scheduler
            answers, the store cannot be written, or nothing could be scored.
        MissingExtraError: A package is not installed.
        OSError: The store of scores cannot be read.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> folder = EXAMPLE_FILE.parent
    >>> report = haspi_report(folder, after=folder, audiogram="N3", measures=["stoi"], jobs=1)
    >>> round(float(report.table["stoi"].mean()), 3)
    1.0
    """
    check_scheduler(running.get("dask"))
    settings: dict[str, Any] = {"full_scale_spl": full_scale_spl, "spl": spl, "seed": seed}
    if conditions and (before is not None or after is not None):
        raise ValueError(
            "expected either the folders before and after or named conditions, got both; name all "
            "folders as conditions"
        )
    ear = None if audiogram is None else as_audiogram(audiogram)
    folders = {BEFORE: before, AFTER: after, **(conditions or {})}
    outputs = {name: folder for name, folder in folders.items() if folder is not None}
    if manifest is None and clean is not None and outputs:
        if root is not None:
            raise ValueError(
                "root (--root) has no effect on folders; leave it out, or pass a manifest"
            )
        if (ear is None) == (audiograms is None):
            raise ValueError(
                "expected the ear of the files in folders (audiogram, --audiogram) or a table of "
                f"ears (audiograms, --audiograms), got {'none' if ear is None else 'both'}; pass "
                "one of the two"
            )
        ears = read_named_ears(audiograms) if ear is None else [("", "", ear)]
        recordings, names = read_folders(clean, outputs, ears, **settings), list(outputs)
    elif manifest is not None and clean is None and not outputs:
        recordings, names = read_recordings(manifest, root, ear, audiograms, **settings)
    else:
        raise ValueError(
            "expected either a manifest, or the folder clean with the folder after (and before) or "
            "with named conditions; pass one of the two"
        )
    if baseline is not None:
        if baseline not in names:
            raise ValueError(
                f"there is no condition {baseline!r} for the baseline; pass one of "
                f"{', '.join(names)}"
            )
        names.sort(key=lambda name: name != baseline)
    return score_recordings(
        recordings,
        [Condition(name, kind="recorded") for name in names],
        measures,
        precision=precision,
        baseline=baseline,
        better_ear=better_ear,
        store=store,
        listen=listen,
        **running,
    )


def score_recordings(
    recordings: Sequence[RecordedItem],
    conditions: Sequence[Condition],
    measures: Sequence[str],
    *,
    precision: int = 32,
    baseline: str | None = None,
    better_ear: bool = False,
    planned: Sequence[PlannedComparison] = (),
    listen: int = 0,
    played: Sequence[str] = (),
    **running: Any,
) -> Evaluation:
    """Score recordings and compare their conditions.

    Args:
        recordings: One recording per utterance and ear.
        conditions: Conditions under which outputs were recorded.
        measures: Names of measures, the most important first.
        precision: Number of bits with which HASPI, HASQI and HAAQI are computed, 32 or 64.
        baseline: Condition with which all others are compared; by default, all pairs are compared.
        better_ear: Whether to use the better ear's score of each utterance.
        planned: Planned comparisons; by default that of the first with the last condition by the
            first measure.
        listen: Number of items with sounds for the players of a page.
        played: Names of the conditions with sounds, by default all.
        running: Argument ``store``, a file of scores or None, and the arguments ``jobs``, ``dask``
            and ``progress`` of ``run_study``.

    Returns:
        The evaluation. With ``better_ear``, its table has one row per utterance and condition.

    Raises:
        ValueError: There is no such measure or precision, nothing could be scored, or
            ``better_ear`` is set and an utterance lacks an ear or has different speech for both
            ears.
        MissingExtraError: A package is not installed.
        OSError: The store of scores cannot be read.

    >>> from hlsim import Audiogram
    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> outputs = {"unaided": EXAMPLE_FILE}
    >>> recording = RecordedItem("s01", EXAMPLE_FILE, outputs, Audiogram.standard("N3"))
    >>> evaluation = score_recordings(
    ...     [recording], [Condition("unaided")], ["stoi"], store=None, jobs=1
    ... )
    >>> evaluation.names
    ['unaided']
    """
    utterances = _pair_ears(recordings) if better_ear else []
    settings = {
        "seed": recordings[0].seed,
        "precision": precision,
        "baseline": baseline,
        "better_ear": better_ear,
    }
    columns = [*find_measures(measures, precision), LEVELS, ALIGNMENT]
    evaluation = Evaluation.run(recordings, conditions, columns, settings=settings, **running)
    scores, names = evaluation.scores, evaluation.names
    notes = [*_describe_unrelated(evaluation.table), *_describe_lags(evaluation.table)]
    if better_ear:
        table = _better_ears(evaluation.table, utterances, scores)
        evaluation = replace(evaluation, table=table)
        evaluation.check_values(scores)
    planned = planned or [(scores[0], names[0], names[-1])]
    comparisons = compare(evaluation.table, scores, baseline=baseline, planned=planned)
    evaluation = replace(evaluation, notes=notes, comparisons=comparisons)
    return replace(evaluation, sounds=perceive_items(evaluation, listen, played))


def _pair_ears(recordings: Sequence[RecordedItem]) -> list[int]:
    """Find the two recordings, one for each ear, of every utterance.

    Recordings with the same listener, utterance and SNR belong together. If these are more than
    two, those of them with the same clean file belong together.

    Returns:
        For each recording, the number of its utterance, from 0, which both ears share.

    Raises:
        ValueError: Recordings that belong together are not one left and one right ear, or their
            clean files differ in speech or are shifted by more than 2 ms.
    """
    counts = Counter(recording.utterance_key for recording in recordings)
    utterances: dict[tuple[Any, ...], list[RecordedItem]] = {}
    for recording in recordings:
        is_pair = counts[recording.utterance_key] <= len(EARS)
        key = recording.utterance_key, None if is_pair else recording.clean
        utterances.setdefault(key, []).append(recording)
    numbers: dict[int, int] = {}
    for number, pair in enumerate(utterances.values()):
        if sorted(recording.ear for recording in pair) != sorted(EARS):
            ears = ", ".join(recording.ear or "unknown" for recording in pair)
            raise ValueError(
                "expected one left and one right ear of each utterance for the better ear, but "
                f"{pair[0].both_ears_name} has the ears {ears}; add the missing rows to the "
                "manifest or the table of ears, give different utterances different values in the "
                "column item, or leave out better_ear (--better-ear)"
            )
        _check_same_speech(*pair)
        numbers |= {id(recording): number for recording in pair}
    return [numbers[id(recording)] for recording in recordings]


def _check_same_speech(first: RecordedItem, second: RecordedItem) -> None:
    """Raise ValueError if the two ears of an utterance have clean files with different speech.

    The same speech with more than 2 ms between the ears is different speech, too.

    Nothing is raised if both share one file, or if a file cannot be read, because its item then
    becomes a failure of the study.
    """
    if first.clean == second.clean:
        return
    try:
        items = first.load(), second.load()
    except ValueError:
        return
    lag = find_lag(items[0].clean, items[1].clean)
    if lag is None or abs(lag) > _INTERAURAL_SECONDS * items[0].sample_rate:
        raise ValueError(
            f"expected the same speech for both ears of {first.both_ears_name}, but {first.clean} "
            f"and {second.clean} are not similar or not aligned; give different utterances "
            "different values in the column item, or write both ears to the channels of one file"
        )


def _better_ears(table: DataFrame, utterances: Sequence[int], scores: Sequence[str]) -> DataFrame:
    """Merge the rows of both ears of each utterance and condition to one with the better scores.

    Each score is the higher one of both ears, so different scores may come from different ears. A
    score is missing if one ear lacks it, because the other one may be the worse ear; the column
    ``failure`` then has the reasons of both ears. Other values of the row that depend on the
    condition come from one ear: the better one by the first score that both ears have, or the left
    one if this score is equal or there is none.

    Args:
        table: Table of ``run_study`` for recordings of both ears of each utterance.
        utterances: Number of the utterance of each recording.
        scores: Columns of scores.

    Returns:
        The table with one row per utterance and condition; ``item`` is the number of the utterance.
        Facts of the ear, such as ``audiogram``, are the same in all rows of an utterance: those of
        the better ear under the last condition that has all scores, or under the last one. Its
        number in ``table`` is in the column ``source``.
    """
    rows = table.assign(source=table["item"], item=[utterances[i] for i in table["item"]])
    left, right = (
        rows[rows["ear"] == side].set_index(["item", "condition"], drop=False) for side in EARS
    )
    right = right.reindex(left.index)
    changes = (right[scores] - left[scores]).bfill(axis=1).iloc[:, 0]
    better = left.where(changes.isna() | (changes <= 0.0), right)
    better[scores] = np.maximum(left[scores], right[scores])  # NaN if one of them is
    # A new column of texts would have NaN for None.
    better.loc[:, "failure"] = [
        "; ".join(
            f"{side} ear: {reason}"
            for side, reason in zip(EARS, reasons, strict=True)
            if isinstance(reason, str)
        )
        or None
        for reasons in zip(left["failure"], right["failure"], strict=True)
    ]
    parts = better[["listener", "utterance", "snr"]].itertuples(index=False)
    better["name"] = [join_name(*part) for part in parts]
    better = better.reset_index(drop=True).sort_values("item", kind="stable", ignore_index=True)
    is_complete = better[scores].notna().all(axis=1)
    last = better.loc[is_complete.sort_values(kind="stable").index]
    last = last.drop_duplicates("item", keep="last").set_index("item")
    for fact in last.columns.intersection(_EAR_FACTS):
        better[fact] = better["item"].map(last[fact])
    return better


def _describe_unrelated(table: DataFrame) -> list[str]:
    """Return a list with a note about outputs unlike their clean speech, or an empty list.

    These are the rows of the table that have a ``level`` but no ``lag_ms``.
    """
    values = table.reindex(columns=["level", "lag_ms"])
    unrelated = table[values["level"].notna() & values["lag_ms"].isna()]
    if unrelated.empty:
        return []
    counts = unrelated["condition"].value_counts(sort=False)
    return [
        f"{len(unrelated)} of {len(table)} outputs are not similar to their clean speech "
        f"(correlation of at most {CORRELATION_FLOOR} at every lag): "
        f"{', '.join(f'{count} under {name}' for name, count in counts.items())}. Check that "
        "these files have the same sentence as their clean file. Noise that is much louder than "
        "the speech, and a resynthesised waveform, have the same effect."
    ]


def _describe_lags(table: DataFrame) -> list[str]:
    """Return a list with a note about outputs late or early by more than ``LATE_MS``, or []."""
    late = table[table.reindex(columns=["lag_ms"])["lag_ms"].abs() > LATE_MS]
    if late.empty:
        return []
    counts = [
        f"{len(rows)} under {name} (median {rows['lag_ms'].median():+.1f} ms)"
        for name, rows in late.groupby("condition", sort=False)
    ]
    return [
        f"{len(late)} of {len(table)} outputs are later (+) or earlier (-) than their clean speech "
        f"by more than {LATE_MS:g} ms: {', '.join(counts)}. STOI and MBSTOI fall with such a lag, "
        "and losses rise; HASPI, HASQI and HAAQI align the signals themselves. Shift the files "
        "before scores are compared. The lag is that of the largest cross-correlation."
    ]
