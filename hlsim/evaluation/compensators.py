"""The study of ``evaluate-compensator``: compensators are compared with other hearing aids."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from compensators.directional import behind_front_end
from compensators.nalr import NALR
from compensators.wdrc import WDRC
from hlsim.audiogram import Audiogram, as_audiogram
from hlsim.audiogram.value import EarLike
from hlsim.calibration import NEURO_RATE, PASCAL_SPL, Loudness, check_loudness, loudness_at
from hlsim.checks import check_attributes, check_number
from hlsim.data.clips import Clips
from hlsim.data.manifest import read_manifest
from hlsim.data.recorded_scenes import SceneClips, SceneFiles
from hlsim.evaluation.aid_properties import (
    measure_aids,
    measure_gain_curve,
    measure_reception_thresholds,
    measure_steady_tones,
    measure_wearability,
)
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.conditions import (
    COMPRESSION,
    NAL_R,
    UNAIDED,
    AtLevelOf,
    Enhanced,
    EqualiserLike,
    OnMicrophones,
    Rival,
    Unaided,
    load_enhancers,
    load_rival,
    takes_microphones,
)
from hlsim.evaluation.digits import DigitTest
from hlsim.evaluation.items import (
    INPUT_LEVELS,
    draw_aid_items,
    draw_scene_items,
    ear_name,
    read_ears,
)
from hlsim.evaluation.measures import LEVELS, PERCEPTION, find_measures, network_loss
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.parallel import check_scheduler
from hlsim.evaluation.sounds import perceive_items
from hlsim.evaluation.study import Condition
from hlsim.metrics.pair import SHORTEST_SECONDS
from hlsim.neuro import load_pretrained
from hlsim.plugins import WaveformPlugin

UTTERANCES = 6
"""Number of clips of speech, of 3 s each, with which gains are measured."""

_SINGLE_SIGNAL_NOTE = (
    "{name} has several microphones. Gain curves, the equaliser, steady tones and 'Could it be "
    "worn?' are measured with a single signal, which goes to the hearing aid behind a directional "
    "front end, or otherwise to all microphones."
)


def evaluate_compensators(
    compensators: Mapping[str, nn.Module],
    *,
    speech: str | Path | None = None,
    manifest: str | Path | None = None,
    root: str | Path | None = None,
    store: str | Path | None = None,
    audiograms: str | Path | None = None,
    audiogram: EarLike | None = None,
    noise: str | Path | None = None,
    enhancers: Sequence[str] = (),
    simulator: str | Path = "neuro-msbg",
    measures: Sequence[str] = (),
    precision: int = 32,
    items: int = 400,
    seconds: float = 3.0,
    levels: Sequence[float] = INPUT_LEVELS,
    gain_ears: Sequence[str] = ("N3", "S2"),
    srt: bool = False,
    seed: int = 0,
    listen: int = 0,
    rival: Rival = "nalr",
    loudness: Loudness = 0.0,
    **running: Any,
) -> Evaluation:
    """Compare compensators with no aid, NAL-R and WDRC, and with two rivals at their output level.

    The rivals are a prescription, by default NAL-R, and an equaliser, a fixed filter for each ear
    with the compensator's mean gain for speech at ``levels``. The comparison with the prescription
    at the compensator's level by HASPI is planned, so that its p values are not adjusted for the
    number of comparisons.

    With ``store``, an interrupted run can be continued, and a run with one more compensator, or
    with another simulator, computes only the scores that are missing. An item that lacks a value
    under any condition is left out of all comparisons.

    Args:
        compensators: Named modules at 16 kHz and 94 dB SPL full scale, which are called with a
            waveform and an ear. They are set to evaluation mode.
        speech: Folder of recordings of clean speech.
        manifest: Manifest of noisy speech instead of ``speech`` and ``noise``, with one or several
            microphones, see ``read_manifest``. Its split ``test`` is used, or else ``valid``. A
            compensator with the attribute ``takes_microphones`` gets all microphones, the others
            get the reference.
        root: Folder to which the paths of the manifest are relative; by default its folder.
        store: File of scores, which is created if it does not exist; None stores nothing.
        audiograms: CSV file of ears, in addition to Bisgaard's N2 to N6 and S1 to S3.
        audiogram: Single ear for everything, for a compensator that was trained for this ear.
        noise: Folder of recordings of noise. Every second item is then noisy, at signal-to-noise
            ratios of 2.5 to 17.5 dB.
        enhancers: Names ``package.module:name`` of functions ``(waveform, sample_rate) ->
            waveform`` that reduce noise. Each is put before every prescription and compensator, in
            further conditions such as ``gtcrn + NAL-R``.
        simulator: Name or folder of the Neuro-MSBG whose training loss is compared with that of
            the exact MSBG, because an aid may exploit errors of the network.
        measures: Names of measures in addition to HASPI and HASQI.
        precision: Number of bits with which HASPI, HASQI and HAAQI are computed, 32 or 64.
        items: Number of items. With noise, 400 items are 200 of clean and 200 of noisy speech.
        seconds: Length of an item in seconds, 0.7 or more. HASPI is not reliable much below 3.
        levels: Levels of the clean speech in dB SPL, through which the items cycle.
        gain_ears: Names of the standard ears for the measurements in ``details``. If ``audiogram``
            is passed, they use this ear instead.
        srt: Whether to measure speech reception thresholds in noise by the digit test, too, one
            threshold per ear and aid. Each takes about five seconds, without the time of the aid.
        seed: Seed of the random draws.
        listen: Number of items with sounds for the players of a page, as the ear perceives them.
        rival: Prescription for the planned comparison: ``"nalr"``, ``"nalrp"``, ``"camfit"``, or
            ``"for-ear"``, which is NAL-RP for ears with a profound loss at 2 kHz, and otherwise
            NAL-R. One that is not NAL-R is a further condition, which takes time.
        loudness: Loudness at which an output has no loudness error, in dB relative to a normal ear:
            a number from -40 to 20, or numbers by the level of the input in dB SPL, as in
            ``HearingLossLoss``.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation with the groups ``clean`` and ``noisy`` (speech in noise), if they have
        items. The groups have the comparisons. In its table, ``gap`` is the surrogate gap as a
        fraction, ``loudness_error`` is relative to ``loudness``, and ``level_over_nal_r`` is the
        output level minus that of NAL-R in dB. Its ``details`` are ``gain_curves``,
        ``steady_tones`` and ``wearing``: results of ``measure_aids`` with ``measure_gain_curve``,
        ``measure_steady_tones`` (errors relative to ``loudness``, too) and ``measure_wearability``;
        with ``srt``, also ``reception_thresholds``, that of ``measure_reception_thresholds``.

    Raises:
        ValueError: Data or settings are not valid, or no item has all its scores.
        MissingExtraError: A package is not installed.
        OSError: The store of scores cannot be read.

    >>> from hlsim.data.bundled import EXAMPLE_FILE
    >>> speech, settings = EXAMPLE_FILE.parent, {"items": 1, "seconds": 1.0, "levels": [65.0]}
    >>> evaluation = evaluate_compensators(
    ...     {"mine": NALR()}, speech=speech, audiogram=Audiogram.standard("N3"), jobs=1, **settings
    ... )
    >>> evaluation.names[:3], evaluation.names[3:]
    (['unaided', 'NAL-R', 'WDRC'], ["NAL-R at mine's level", "equaliser at mine's level", 'mine'])
    """
    check_scheduler(running.get("dask"))
    loudness = check_loudness(loudness)
    check_number("seconds", seconds, SHORTEST_SECONDS)
    scores = find_measures(["haspi", "hasqi", *measures], precision)
    network = load_pretrained(simulator)
    if (manifest is None) == (speech is None) or (noise is not None and speech is None):
        raise ValueError(
            "expected either speech, with or without noise, or a manifest; pass one of them"
        )
    if root is not None and manifest is None:
        raise ValueError("root (--root) has no effect without a manifest; leave it out")
    if not compensators:
        raise ValueError("expected one or more compensators, got none; pass them by their names")
    for name, aid in compensators.items():
        check_attributes(aid, f"the aid {name}", sample_rate=NEURO_RATE, full_scale_spl=PASCAL_SPL)
        aid.eval()  # before it is called below
    ears_of_aids = {name: Audiogram.standard(name) for name in gain_ears}
    ears = read_ears(audiograms)
    if audiogram is not None:
        if audiograms is not None:
            raise ValueError(
                "audiogram and audiograms (--audiogram, --audiograms) exclude each other; pass one "
                "of them"
            )
        ear = as_audiogram(audiogram)
        ears_of_aids = {ear_name(ear): ear}
        ears = list(ears_of_aids.items())
    rival_name, rival_aid = load_rival(rival, [*ears_of_aids.values(), *dict(ears).values()])
    for name in compensators.keys() & {UNAIDED, NAL_R, COMPRESSION, rival_name}:
        raise ValueError(f"{name} is always evaluated; give the compensator another name")
    scenes = None if manifest is None else _read_scene_clips(manifest, root, seconds)
    aids_of_microphones = [name for name, aid in compensators.items() if takes_microphones(aid)]
    if aids_of_microphones and (scenes is None or srt):
        raise ValueError(
            f"{aids_of_microphones[0]} has several microphones; expected a manifest with a column "
            "'reference' (--manifest), and no digit test (--srt)"
        )
    clean_speech: Any = speech if scenes is None else scenes.clean_files
    # Silence after short recordings would make the speech louder than the levels say.
    clips = Clips(clean_speech, sample_rate=NEURO_RATE, seconds=3.0, repeat=True)
    utterances = clips.draw(UTTERANCES, torch.Generator().manual_seed(seed))
    enhancer_plugins = load_enhancers(enhancers)
    prescriptions = {
        NAL_R: NALR(sample_rate=NEURO_RATE),
        rival_name: rival_aid,
        COMPRESSION: WDRC(sample_rate=NEURO_RATE),
    }
    settings: dict[str, Any] = {
        "items": items,
        "seconds": seconds,
        "seed": seed,
        "levels": list(levels),
    }
    aids = {name: _adapt(aid, scenes) for name, aid in {**prescriptions, **compensators}.items()}
    equalisers = {
        name: _adapt(EqualiserLike(aids[name], utterances, levels), scenes) for name in compensators
    }
    unaided = _adapt(Unaided(), scenes)
    if scenes is None:
        assert speech is not None
        drawn = draw_aid_items(speech, noise, ears, **settings)
    else:
        drawn = draw_scene_items(scenes, ears, **settings)
    notes = []
    for name in aids_of_microphones:
        aids[name](drawn[0].signal, drawn[0].ear)  # rejects another number of microphones
        notes.append(_SINGLE_SIGNAL_NOTE.format(name=name))
    conditions = _make_conditions(unaided, aids, equalisers, enhancer_plugins, rival_name)
    kinds = ("aid", "prescription", "enhanced")
    wearable = {c.name: c.process for c in conditions if c.process and c.kind in kinds}
    with_unaided: dict[str, Any] = {UNAIDED: unaided, **wearable}
    # These measurements come first, because they reject an aid that fails.
    details = {
        "gain_curves": measure_aids(aids, ears_of_aids, measure_gain_curve, utterances, levels),
        "steady_tones": measure_aids(
            with_unaided, ears_of_aids, measure_steady_tones, levels, loudness
        ),
        "wearing": measure_aids(wearable, ears_of_aids, measure_wearability, utterances[0]),
    }
    if srt:
        details["reception_thresholds"] = measure_reception_thresholds(
            with_unaided, ears_of_aids, UNAIDED, DigitTest.draw(seed=seed)
        )
    evaluation = Evaluation.run(
        drawn,
        conditions,
        [*scores, LEVELS, PERCEPTION, network_loss(network)],
        store=store,
        settings={
            **settings,
            "precision": precision,
            "rival": rival_name,
            "loudness": loudness,
            "audiogram": None if audiogram is None else as_audiogram(audiogram).to_dict(),
            "limited_to_ear": [
                name
                for name, aid in compensators.items()
                if getattr(behind_front_end(aid), "limit_to_ear", False)
            ],
            "simulator": str(simulator),
            "enhancers": list(map(str, enhancer_plugins.values())),
        },
        required=["haspi", "hasqi", "level", "loudness_error", "loss_neuro"],
        **running,
    )
    table = evaluation.table
    relative_loss = table["loss_neuro"] / table["loss_msbg"].where(table["loss_msbg"] != 0.0)
    item_targets = loudness_at(loudness, torch.tensor(table["input_level"].to_numpy(float)))
    nal_r_levels = evaluation.wide("level")[NAL_R]
    table = table.assign(
        gap=relative_loss - 1.0,
        loudness_error=table["loudness_error"] - item_targets.numpy(),
        level_over_nal_r=table["level"] - table["item"].map(nal_r_levels),
    )
    notes = [*notes, *evaluation.notes]
    evaluation = replace(evaluation, table=table, details=details, notes=notes)
    groups = _make_groups(evaluation)
    same_level = next(c.name for c in conditions if c.kind == "same level")
    sounds = perceive_items(
        next(iter(groups.values())), listen, [UNAIDED, same_level, *evaluation.aids]
    )
    return replace(evaluation, groups=groups, sounds=sounds)


def _read_scene_clips(manifest: str | Path, root: str | Path | None, seconds: float) -> SceneClips:
    """Return clips of the scenes in the split test of a manifest, or else in its split valid.

    Args:
        manifest: File of the manifest.
        root: Folder to which its paths are relative; None for the folder of the manifest.
        seconds: Duration of the clips, which have 16 kHz, in seconds.

    Raises:
        ValueError: The manifest is not valid or has no scenes in these splits, a scene has no noisy
            recording, the first one is not valid, or scenes differ in their number of ears.
    """
    folder = Path(manifest).parent if root is None else Path(root)
    rows = read_manifest(manifest, root)
    chosen_rows = [row for row in rows if row.split == "test"]
    chosen_rows = chosen_rows or [row for row in rows if row.split == "valid"]
    if not chosen_rows:
        raise ValueError(
            f"{manifest}: expected utterances in the split test or valid, got none; write test in "
            "the column 'split' of those that were not used in training"
        )
    scenes = [SceneFiles.from_utterance(row, folder) for row in chosen_rows]
    return SceneClips(scenes, sample_rate=NEURO_RATE, seconds=seconds)


def _adapt(aid: nn.Module, scenes: SceneClips | None) -> nn.Module:
    """Return the aid, wrapped by ``OnMicrophones`` if the items of the study come from scenes."""
    return aid if scenes is None else OnMicrophones(aid, (scenes.microphones, scenes.ears))


def _make_conditions(
    unaided: nn.Module,
    aids: Mapping[str, nn.Module],
    equalisers: Mapping[str, nn.Module],
    enhancers: Mapping[str, WaveformPlugin],
    rival: str,
) -> list[Condition]:
    """Return the conditions, each of which the study compares with all earlier ones.

    The order is: unaided; each prescription, then this prescription behind each enhancer; and for
    each trained aid, the rival at its level, the equaliser at its level, the aid behind each
    enhancer, and the aid.

    Args:
        unaided: The condition without an aid.
        aids: Prescriptions, the rival among them, and then trained aids, each under its name.
        equalisers: For each trained aid, under its name, an equaliser with its mean gain.
        enhancers: Enhancers, by the part of their names after the colon.
        rival: Name of the prescription at the level of each trained aid.
    """
    conditions = [Condition(UNAIDED, unaided, kind="unaided")]
    for name, aid in aids.items():
        enhanced = [
            Condition(f"{prefix} + {name}", Enhanced(enhancer, aid), "enhanced", name)
            for prefix, enhancer in enhancers.items()
        ]
        if name not in equalisers:
            conditions += [Condition(name, aid, "prescription"), *enhanced]
            continue
        prescription = AtLevelOf(aids[rival], aid)
        equaliser = AtLevelOf(equalisers[name], aid)
        conditions += [
            Condition(f"{rival} at {name}'s level", prescription, "same level", name),
            Condition(f"equaliser at {name}'s level", equaliser, "equaliser", name),
            *enhanced,
            Condition(name, aid),
        ]
    return conditions


def _make_groups(evaluation: Evaluation) -> dict[str, Evaluation]:
    """Return the evaluations of clean speech and of speech in noise, as ``clean`` and ``noisy``.

    Each has comparisons of its own. An item that lacks a value in one condition is in no group. A
    group without items is left out.

    Raises:
        ValueError: No item has all values.
    """
    table = evaluation.table[~evaluation.table["item"].isin(evaluation.failures["item"])]
    if table.empty:
        first = evaluation.failures.iloc[0]
        raise ValueError(
            "every item lacks at least one value, so that nothing can be compared; the first is "
            f"{first['name']} under {first['condition']}: {first['failure']}"
        )
    same_level = [c for c in evaluation.conditions if c.kind == "same level"]
    planned = [("haspi", condition.name, condition.of) for condition in same_level]
    groups = {}
    for name in ("clean", "noisy"):
        part = table[table["speech"] == name]
        if not part.empty:
            comparisons = compare(part, evaluation.scores, planned=planned, unit="ear")
            groups[name] = replace(evaluation, table=part, comparisons=comparisons)
    return groups
