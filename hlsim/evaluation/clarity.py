"""The study of ``clarity``: aids of both ears on scenes of the Clarity enhancement challenges.

As in the challenges' scripts (claritychallenge/clarity, recipes/icassp_2023 and cec3), the
reference is the target without its room, at the level of the target in the room. An RMS of 1.0 in a
file is 100 dB SPL. The score of a listener is that of the ear with the higher score, by each
measure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram.listener import EARS, Listener
from hlsim.audiogram.table import read_listeners
from hlsim.calibration import set_level
from hlsim.evaluation.aid_properties import measure_look_ahead
from hlsim.evaluation.aids import Enhanced, PluginAid, Unaided, load_enhancers
from hlsim.evaluation.fingerprint import value_hash
from hlsim.evaluation.measures import find_measures
from hlsim.evaluation.parallel import describe_error, one_thread, run_parallel
from hlsim.evaluation.recordings import Recording, score_recordings
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.store import content_hash
from hlsim.evaluation.study import DEAD_PROCESS, Condition
from hlsim.files import write_atomically
from hlsim.metrics.pair import common_length

FULL_SCALE_SPL = 100.0
"""Level in dB SPL of RMS 1.0 in the challenges' files."""

RULE_MS = 5.0
"""Look-ahead in ms that the challenges allow."""

UNAIDED, NAL_R = "unaided", "NAL-R"
"""Conditions with which every pair of aids is compared."""

_MIX_ENDINGS = ("_mix_CH1.wav", "_mixed_CH1.wav")
"""Ends of the names of files with the signals of the front microphones."""

_REFERENCE_ENDINGS = ("_target_anechoic_CH1.wav", "_target_anechoic.wav", "_reference.wav")
"""Ends of the names of references. The last one already has the target's level in the room."""

_IN_ROOM_ENDING = "_target_CH1.wav"
"""End of the names of files with the target in the room."""

_CHANGES = 8
"""Number of positions at which the scene becomes another sound, to measure the look-ahead."""

_LOOK_AHEAD_SECONDS = 4.0
"""Length of the part of a scene on which the look-ahead is measured."""


class _Scene(NamedTuple):
    """Files of a scene.

    Attributes:
        mix: File with the signals of the front microphones.
        reference: File with the target without its room.
        in_room: File with the target in the room, whose level the reference gets; None if the
            reference has this level.
    """

    mix: Path
    reference: Path
    in_room: Path | None


class _Pair(NamedTuple):
    """A scene for a listener.

    Attributes:
        scene: Name of the scene.
        files: Files of the scene.
        name: Name of the listener.
        listener: Both ears of the listener.
    """

    scene: str
    files: _Scene
    name: str
    listener: Listener

    def output_file(self, folder: Path) -> Path:
        """Return the path of the aid's output in ``folder``, which holds those of one condition."""
        return folder / f"{self.scene}_{self.name}_HA-output.wav"


def evaluate_scenes(
    aids: Mapping[str, str],
    *,
    scenes: str | Path,
    listeners: str | Path,
    out: str | Path,
    scenes_listeners: str | Path | None = None,
    stride: int = 1,
    enhancers: Sequence[str] = (),
    measures: Sequence[str] = (),
    linked: bool = False,
    full_scale_spl: float = FULL_SCALE_SPL,
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Compare aids of both ears with no aid and NAL-R on binaural scenes, by HASPI and HASQI.

    The outputs are written to ``out/signals/CONDITION/SCENE_LISTENER_HA-output.wav`` (the
    challenges' names), the references to ``out/reference``, and the scores to
    ``out/scores.jsonl``. An interrupted run can be continued. The score of a scene is that of the
    better ear. The comparison of each aid with NAL-R by HASPI is planned, so that its p values
    are not adjusted for the number of comparisons.

    Args:
        aids: Compensators (name or folder) and aids of your own, by their label in tables. An aid
            is ``package.module:name`` of a function ``(waveform, listener, sample_rate) ->
            waveform`` for signals with shape (2, time) at the scale of the files.
        scenes: Folder with ``SCENE_mix_CH1.wav`` (or ``_mixed_CH1``) with two channels, and
            ``SCENE_target_anechoic_CH1.wav`` (or ``_target_anechoic``, ``_reference``) with one or
            two. If there is a ``SCENE_target_CH1.wav``, the target in the room, each channel of the
            reference gets the level of that file, unless the reference is ``_reference``.
        listeners: Clarity's ``listeners.json``, or a CSV file, see ``read_listeners``. Only
            listeners that are used are validated.
        out: Folder of the results.
        scenes_listeners: JSON file with the names of the listeners of each scene; by default all
            scenes and listeners are combined.
        stride: Use every n-th pair of scene and listener. 15 gives the challenges' small test.
        enhancers: ``package.module:name`` of functions that reduce noise before each aid.
        measures: Measures in addition to HASPI and HASQI.
        linked: Whether one level sets the gains of both ears, in compensators that support it.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        seed: Seed of the noise that HASPI and HASQI add.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation of all conditions, ``unaided`` first. Its ``details["look_ahead_ms"]`` has
        the measured look-ahead by condition, and None for an aid that fails on the first pair.

    Raises:
        ValueError: A file is missing, broken or contradicts another, a listener lacks an ear, or
            nothing could be scored.
        MissingExtraError: A package is not installed.
    """
    names = ["haspi", "hasqi", *measures]
    find_measures(names)
    files_by_scene, folder = _read_scenes(Path(scenes)), Path(out)
    pairs = _read_pairs(files_by_scene, listeners, scenes_listeners, stride)
    first = pairs[0]
    rate = read_audio(first.files.mix)[1]
    conditions = _make_conditions(aids, enhancers, linked, rate, full_scale_spl)
    folders = _signal_folders(conditions, folder / "signals")
    look_ahead_ms = _measure_look_ahead(conditions, first)
    _remove_outdated(conditions, folders, files_by_scene.values())
    write = partial(_write_signals, rate=rate, conditions=conditions, folders=folders, out=folder)
    parallel = {name: running[name] for name in ("jobs", "dask") if name in running}
    recordings = []
    for pair, written in run_parallel(write, pairs, **parallel):
        problems = dict.fromkeys(folders, DEAD_PROCESS) if written is None else written
        files = {name: pair.output_file(signals) for name, signals in folders.items()}
        for ear in EARS:
            recording = Recording(
                pair.scene,
                _reference_file(folder, pair.scene),
                {name: path for name, path in files.items() if name not in problems},
                getattr(pair.listener, ear),
                listener=pair.name,
                ear=ear,
                full_scale_spl=full_scale_spl,
                seed=seed,
                problems=problems,
            )
            recordings.append(recording)
    evaluation = score_recordings(
        recordings,
        [replace(condition, process=None) for condition in conditions],
        names,
        better_ear=True,
        planned=[("haspi", NAL_R, c.name) for c in conditions if c.kind == "aid"],
        store=folder / "scores.jsonl",
        **running,
    )
    return replace(evaluation, details={"look_ahead_ms": look_ahead_ms})


def _read_scenes(folder: Path) -> dict[str, _Scene]:
    """Return the scenes of a folder, each under its name.

    Raises:
        ValueError: There is no scene, or a scene lacks its reference.
    """
    scenes = {}
    for ending in _MIX_ENDINGS:
        for mix in folder.glob(f"*{ending}"):
            name = mix.name.removesuffix(ending)
            candidates = [folder / f"{name}{end}" for end in _REFERENCE_ENDINGS]
            reference = next(filter(Path.is_file, candidates), None)
            if reference is None:
                expected = " or ".join(path.name for path in candidates)
                raise ValueError(f"{mix} has no reference; put {expected} beside it")
            in_room = folder / f"{name}{_IN_ROOM_ENDING}"
            has_level = reference == candidates[-1] or not in_room.is_file()
            scenes[name] = _Scene(mix, reference, None if has_level else in_room)
    if not scenes:
        raise ValueError(
            f"{folder}: expected a folder with files that end with {' or '.join(_MIX_ENDINGS)}"
        )
    return dict(sorted(scenes.items()))


def _read_pairs(
    scenes: Mapping[str, _Scene],
    listeners: str | Path,
    scenes_listeners: str | Path | None,
    stride: int,
) -> list[_Pair]:
    """Return every n-th pair of scene and listener, see ``evaluate_scenes``.

    Raises:
        ValueError: A file is broken or names an unknown scene or listener, or a listener who is
            used lacks an ear or has a name that no file can have.
    """
    if stride < 1:
        raise ValueError(f"expected a stride (--every) of 1 or more, got {stride}; change it")
    if scenes_listeners is None:
        people = read_listeners(listeners)
        names = list(product(scenes, people))[::stride]
    else:
        names = _read_names(Path(scenes_listeners))[::stride]
        people = read_listeners(listeners, {name for _, name in names})
    for scene, name in names:
        if scene not in scenes:
            raise ValueError(
                f"{scenes_listeners}: there are no files of scene {scene!r}; correct its name, or "
                "add its files to the folder of the scenes"
            )
        for ear in EARS:
            if getattr(people[name], ear) is None:
                raise ValueError(
                    f"{listeners}: listener {name!r} has no {ear} ear; add its audiogram, or leave "
                    "the listener out"
                )
        if Path(name).name != name:
            raise ValueError(
                f"{listeners}: expected a name that a file can have, got listener {name!r}; "
                "rename the listener"
            )
    if not names:
        raise ValueError(
            f"{scenes_listeners or listeners}: no scene has a listener; add one to the file"
        )
    return [_Pair(scene, scenes[scene], name, people[name]) for scene, name in names]


def _read_names(path: Path) -> list[tuple[str, str]]:
    """Return the names of scenes and listeners in ``scenes_listeners.json``."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        names = [(scene, name) for scene, listeners in entries.items() for name in listeners]
        return list(dict.fromkeys(names))
    except (OSError, ValueError, RecursionError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); expected an object with a list of listeners for "
            "each scene"
        ) from error


def _make_conditions(
    aids: Mapping[str, str],
    enhancers: Sequence[str],
    linked: bool,
    rate: int,
    full_scale_spl: float,
) -> list[Condition]:
    """Return no aid, NAL-R and all aids, each of them also after every enhancer."""
    levels: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl}
    loaded: dict[str, nn.Module] = {NAL_R: load_compensator("nalr", **levels)}
    for label, name in aids.items():
        if label in (UNAIDED, NAL_R):
            raise ValueError(f"{label} is always evaluated; give the aid another label")
        if ":" in name and not Path(name).exists():
            loaded[label] = PluginAid(name, rate)
        else:
            loaded[label] = load_compensator(name, **levels, linked=linked)
    plugins = load_enhancers(enhancers)
    conditions = [Condition(UNAIDED, Unaided(), "unaided")]
    for label, aid in loaded.items():
        for prefix, enhancer in plugins.items():
            process = Enhanced(enhancer, aid, **levels)
            conditions.append(Condition(f"{prefix} + {label}", process, "enhanced", label))
        kind = "prescription" if label == NAL_R else "aid"
        conditions.append(Condition(label, aid, kind))
    return conditions


def _signal_folders(conditions: Sequence[Condition], root: Path) -> dict[str, Path]:
    """Return the folder of each condition's signals.

    Raises:
        ValueError: Two conditions would have the same folder, or one no folder.
    """
    labels: dict[str, str] = {}
    for condition in conditions:
        name = re.sub(r"[^\w.+-]+", "-", condition.name).strip(".-")
        if not name:
            raise ValueError(
                f"expected a letter or a digit in the label {condition.name!r}, because it names a "
                "folder; rename it"
            )
        if name in labels:
            raise ValueError(
                f"the labels {labels[name]!r} and {condition.name!r} would have the same folder, "
                f"{root / name}; rename one of them"
            )
        labels[name] = condition.name
    return {label: root / name for name, label in labels.items()}


@torch.no_grad()
def _measure_look_ahead(conditions: Sequence[Condition], pair: _Pair) -> dict[str, float | None]:
    """Measure the look-ahead in ms on the beginning of a scene, or None for an aid that fails."""
    scene, rate = read_audio(pair.files.mix)
    scene = scene[:, : int(_LOOK_AHEAD_SECONDS * rate)]
    generator = torch.Generator().manual_seed(0)
    other = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    if scene.any():
        other *= scene.square().mean().sqrt() / other.square().mean().sqrt()
    else:
        scene = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    time = scene.shape[-1]
    positions = range(time // 4, time, max(1, time // (_CHANGES + 3)))[:_CHANGES]
    look_ahead_ms: dict[str, float | None] = {}
    for condition in conditions:
        assert condition.process is not None
        try:
            process = condition.process
            samples = measure_look_ahead(process, pair.listener, scene, other, positions)
            look_ahead_ms[condition.name] = 1000.0 * samples / rate
        except ValueError:
            look_ahead_ms[condition.name] = None
    return look_ahead_ms


def _reference_file(out: Path, scene: str) -> Path:
    return out / "reference" / f"{scene}.wav"


def _remove_outdated(
    conditions: Sequence[Condition], folders: Mapping[str, Path], scenes: Iterable[_Scene]
) -> None:
    """Remove the signals of a condition whose processing or scenes have changed.

    Args:
        conditions: Conditions.
        folders: Folder of the signals, by condition, where a file contains their fingerprint.
        scenes: All scenes.
    """
    mixes = [content_hash(scene.mix) for scene in scenes]
    for condition in conditions:
        folder = folders[condition.name]
        note, state = folder / "fingerprint.txt", value_hash([condition.fingerprint, mixes])
        is_known = condition.fingerprint is not None and note.is_file()
        if not is_known or note.read_text() != state:
            for path in folder.glob("*_HA-output.wav"):
                path.unlink()
            write_atomically(note, state)


@one_thread()
@torch.no_grad()
def _write_signals(
    pair: _Pair,
    rate: int,
    conditions: Sequence[Condition],
    folders: Mapping[str, Path],
    out: Path,
) -> dict[str, str]:
    """Write the reference and the missing outputs of a scene for a listener.

    Returns:
        For each condition without an output, the reason.
    """
    problems: dict[str, str] = {}
    try:
        mix, reference = _read_scene(pair.files, rate)
        write_audio(_reference_file(out, pair.scene), reference, rate)
    except ValueError as error:
        return dict.fromkeys(folders, str(error))
    for condition in conditions:
        path = pair.output_file(folders[condition.name])
        try:
            if not path.is_file() and condition.process is not None:
                output = condition.process(mix, pair.listener)
                lengths = mix.shape[-1], output.shape[-1]
                samples = common_length(lengths, rate, ("the input", "the output"))
                write_audio(path, output[:, :samples], rate)
        except Exception as error:  # A failure must not end the study.
            problems[condition.name] = describe_error(error)
    return problems


def _read_scene(scene: _Scene, rate: int) -> tuple[Tensor, Tensor]:
    """Read the microphones' signals, and the reference at the level of the target in the room.

    Returns: Both signals, for the left and the right ear. Shape: (2, time) each.

    Raises:
        ValueError: A file is broken, or has another rate or length.
    """
    mix = _read_channels(scene.mix, rate, [2])
    reference = _read_channels(scene.reference, rate)
    if scene.in_room is None:
        return mix, reference.expand(2, -1)
    in_room = _read_channels(scene.in_room, rate)
    names = str(scene.reference), str(scene.in_room)
    samples = common_length((reference.shape[-1], in_room.shape[-1]), rate, names)
    reference = reference[:, :samples].expand(2, -1)
    power, wanted = (
        signal[:, :samples].double().square().mean(-1, keepdim=True)
        for signal in (reference, in_room)
    )
    for ear, is_sounding in zip(EARS, power.any(-1).tolist(), strict=True):
        if not is_sounding:
            raise ValueError(
                f"{scene.reference}: the {ear} channel is silent, so it cannot get the level of "
                f"{scene.in_room}; write the target to it"
            )
    return mix, reference * (wanted / power).sqrt()


def _read_channels(path: Path, rate: int, numbers: Sequence[int] = (1, 2)) -> Tensor:
    """Read a file with one of some numbers of channels. Shape: (channels, time)."""
    waveform, file_rate = read_audio(path)
    if file_rate != rate:
        raise ValueError(
            f"{path}: expected the sample rate of the first scene, {rate} Hz, got {file_rate} Hz; "
            "resample the file"
        )
    if len(waveform) not in numbers:
        raise ValueError(
            f"{path}: expected {' or '.join(map(str, numbers))} channels, for a left and a right "
            f"ear, got {len(waveform)}; replace the file"
        )
    return waveform
