"""Scenes of the Clarity enhancement challenges: aids of both ears, scored by the better ear.

As in the challenges' own scripts (claritychallenge/clarity, recipes/icassp_2023 and cec3), the reference is the
target without its room, at the level that the target has in the room; a file's RMS of 1.0 is 100 dB SPL; and the
score of a listener is that of the ear which scores higher, by each measure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram.listener import EARS, Listener
from hlsim.audiogram.table import read_listeners
from hlsim.calibration import check_full_scale, gain_to_pascals, set_level
from hlsim.evaluation.aids import load_enhancers
from hlsim.evaluation.fingerprint import combined_fingerprint, fingerprint
from hlsim.evaluation.measurements import samples_ahead
from hlsim.evaluation.measures import find_measures
from hlsim.evaluation.recordings import Recording, score_recordings
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.store import content_hash, key_of
from hlsim.evaluation.study import Condition
from hlsim.files import write_atomically
from hlsim.metrics.pair import check_seed, common_length
from hlsim.parallel import one_thread, reason_of, run_parallel
from hlsim.plugins import WaveformPlugin

FULL_SCALE_SPL = 100.0
"""Level in dB SPL of RMS 1.0 in the challenges' files."""

RULE_MS = 5.0
"""Look-ahead in ms that the challenges allow."""

UNAIDED, NAL_R = "unaided", "NAL-R"
"""Conditions that every pair of aids is compared with."""

_MIX = ("_mix_CH1.wav", "_mixed_CH1.wav")
_REFERENCE = ("_target_anechoic_CH1.wav", "_target_anechoic.wav", "_reference.wav")
_IN_ROOM = "_target_CH1.wav"

_PLACES = 8  # of a scene, where it becomes another sound
_LONGEST_SECONDS = 4.0  # of that scene


class Scene(NamedTuple):
    """Files of a scene: the front microphones, the target without its room, and in the room, if known."""

    mix: Path
    reference: Path
    in_room: Path | None


@dataclass(frozen=True)
class Aids:
    """The aids of both ears, after an enhancer if there is one; without ``aid`` the output is the input."""

    aid: nn.Module | WaveformPlugin | None
    enhancer: WaveformPlugin | None
    sample_rate: int
    full_scale_spl: float

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of aid, enhancer, rate and level; None if one is unknown."""
        parts = [part for part in (self.aid, self.enhancer) if part is not None]
        settings = [self.aid is None, self.enhancer is None, self.sample_rate, self.full_scale_spl]
        return combined_fingerprint(str(settings), *map(fingerprint, parts))

    @torch.no_grad()
    def __call__(self, waveform: Tensor, listener: Listener) -> Tensor:
        """Process both channels. Shape: (2, time) -> (2, time)."""
        if self.enhancer is not None:
            gain = gain_to_pascals(self.full_scale_spl)
            waveform = self.enhancer(waveform * gain, self.sample_rate) / gain
        if isinstance(self.aid, WaveformPlugin):
            return self.aid(waveform, listener, self.sample_rate)
        if self.aid is None:
            return waveform
        aided: Tensor = self.aid(waveform, listener)
        return aided


def evaluate_scenes(
    aids: Mapping[str, str],
    *,
    scenes: str | Path,
    listeners: str | Path,
    out: str | Path,
    scenes_listeners: str | Path | None = None,
    every: int = 1,
    enhancers: Sequence[str] = (),
    measures: Sequence[str] = (),
    linked: bool = False,
    full_scale_spl: float = FULL_SCALE_SPL,
    seed: int = 0,
    **running: Any,
) -> Evaluation:
    """Judge pairs of aids beside no aid and NAL-R on binaural scenes, by the better ear's HASPI and HASQI.

    The outputs are written to ``out/signals/CONDITION/SCENE_LISTENER_HA-output.wav``, the challenges' names, the
    references to ``out/reference``, and the scores to ``out/scores.jsonl``. A run that was stopped continues
    where it was. The comparison of each pair of aids with NAL-R by HASPI is planned.

    Args:
        aids: by label, the name or folder of a compensator, or ``package.module:name`` of a callable
            ``(waveform, listener, sample_rate) -> waveform`` for (2, time) at the files' scale.
        scenes: folder with ``SCENE_mix_CH1.wav`` (or ``_mixed_CH1``) with two channels, and
            ``SCENE_target_anechoic_CH1.wav`` (or ``_target_anechoic``, ``_reference``) with one or two. If there
            is a ``SCENE_target_CH1.wav``, each channel of the former gets its level.
        listeners: Clarity's ``listeners.json``, or a CSV file, see ``read_listeners``.
        scenes_listeners: JSON file with the names of each scene's listeners; None combines all.
        every: take the first of the pairs of scene and listener and then each one so many further; the challenges'
            small test has 15.
        enhancers: ``package.module:name`` of callables that reduce noise before each aid.
        measures: further measures beside HASPI and HASQI; the better ear has the higher value.
        linked: whether one level sets the gains of both ears, in compensators that can.
        full_scale_spl: level in dB SPL of RMS 1.0.
        running: ``jobs``, ``dask`` and ``progress``, as in ``run_study``.

    Returns: the evaluation of all conditions, ``unaided`` first; its detail ``look_ahead_ms`` is by condition, None
        where an aid fails on the first pair.

    Raises:
        ValueError: a file is missing, broken or contradicts another, a listener lacks an ear, or nothing
            could be scored.
        MissingExtraError: a package is not installed.
    """
    names = ["haspi", "hasqi", *measures]
    find_measures(names)
    check_seed(seed)
    check_full_scale(full_scale_spl)
    if every < 1:
        raise ValueError(f"every is {every}; expected 1 or more")
    known, people, folder = read_scenes(scenes), read_listeners(listeners), Path(out)
    pairs = read_pairs(scenes_listeners, known, people)[::every]
    rate = read_audio(known[pairs[0][0]].mix)[1]
    conditions = _conditions(aids, enhancers, linked, rate, full_scale_spl)
    folders = _folders(conditions, folder / "signals")
    ahead = _look_ahead(conditions, known[pairs[0][0]].mix, people[pairs[0][1]])
    _remove_outdated(conditions, folders, known)
    tasks = [_Pair(name, person, known[name], people[person]) for name, person in pairs]
    write = partial(_write_signals, rate=rate, conditions=conditions, folders=folders, out=folder)
    parallel = {name: running[name] for name in ("jobs", "dask") if name in running}
    written = dict(run_parallel(write, tasks, **parallel))
    recordings = []
    for task in tasks:
        problems = written[task]
        if problems is None:
            problems = dict.fromkeys(folders, "the process that computed it ended")
        outputs = {name: task.file(own) for name, own in folders.items() if name not in problems}
        for ear in EARS:
            recording = Recording(
                task.scene,
                _reference_file(folder, task.scene),
                outputs,
                getattr(task.listener, ear),
                listener=task.person,
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
    return replace(evaluation, details={"look_ahead_ms": ahead})


def read_scenes(folder: str | Path) -> dict[str, Scene]:
    """Return the scenes of a folder by name, sorted; ValueError if there is none, or one lacks its reference."""
    folder, scenes = Path(folder), {}
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    for path in sorted(folder.iterdir()):
        ending = next((ending for ending in _MIX if path.name.endswith(ending)), None)
        if ending is None:
            continue
        name = path.name.removesuffix(ending)
        references = [folder / (name + ending) for ending in _REFERENCE]
        found = [reference for reference in references if reference.is_file()]
        if not found:
            expected = " or ".join(reference.name for reference in references)
            raise ValueError(f"{path} has no reference; put {expected} beside it")
        in_room = folder / (name + _IN_ROOM)
        # a reference of the third challenge has its level
        levelled = found[0] == references[-1] or not in_room.is_file()
        scenes[name] = Scene(path, found[0], None if levelled else in_room)
    if not scenes:
        raise ValueError(f"{folder} has no files that end with {' or '.join(_MIX)}")
    return scenes


def read_pairs(
    path: str | Path | None, scenes: Mapping[str, Scene], listeners: Mapping[str, Listener]
) -> list[tuple[str, str]]:
    """Return scenes and listeners by name, from Clarity's ``scenes_listeners.json``, or all combinations.

    Raises:
        ValueError: the file is broken or names an unknown scene or listener, or a listener lacks an ear.
    """
    named = {scene: list(listeners) for scene in scenes}
    try:
        if path is not None:
            named = json.loads(Path(path).read_text(encoding="utf-8"))
        pairs = [(scene, name) for scene, names in named.items() for name in names]
    except (OSError, ValueError, RecursionError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); expected an object with a list of listeners per scene"
        ) from error
    if not pairs:
        raise ValueError(f"{path}: no scene has a listener")
    for scene, name in pairs:
        if scene not in scenes or name not in listeners:
            raise ValueError(f"{path}: there is no scene {scene!r} or no listener {name!r}")
        if Path(name).name != name:
            raise ValueError(f"the listener {name!r} has a name that no file can have")
        for ear in EARS:
            if getattr(listeners[name], ear) is None:
                raise ValueError(f"the {ear} ear of listener {name} is missing")
    return list(dict.fromkeys(pairs))


def _conditions(
    aids: Mapping[str, str],
    enhancers: Sequence[str],
    linked: bool,
    rate: int,
    full_scale_spl: float,
) -> list[Condition]:
    levels: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl}
    if taken := {UNAIDED, NAL_R} & set(aids):
        raise ValueError(f"{taken.pop()} is always evaluated; give the aid another label")
    loaded: dict[str, Any] = {NAL_R: load_compensator("nalr", **levels)}
    for label, name in aids.items():
        if ":" in name and not Path(name).exists():
            loaded[label] = WaveformPlugin(name, "aid")
        else:
            loaded[label] = load_compensator(name, **levels, linked=linked).eval()
    before = load_enhancers(enhancers)
    conditions = [Condition(UNAIDED, Aids(None, None, rate, full_scale_spl), "unaided")]
    for label, aid in loaded.items():
        for prefix, enhancer in before.items():
            process = Aids(aid, enhancer, rate, full_scale_spl)
            conditions.append(Condition(f"{prefix} + {label}", process, "enhanced", label))
        kind = "prescription" if label == NAL_R else "aid"
        conditions.append(Condition(label, Aids(aid, None, rate, full_scale_spl), kind))
    return conditions


def _folders(conditions: Sequence[Condition], root: Path) -> dict[str, Path]:
    """Return the folder of each condition's signals; ValueError unless all differ."""
    names = {c.name: re.sub(r"[^\w.+-]+", "-", c.name).strip(".-") for c in conditions}
    if len({*names.values(), ""}) <= len(names):
        raise ValueError(f"the labels {', '.join(names)} make no folders of different names")
    return {condition: root / name for condition, name in names.items()}


def _look_ahead(
    conditions: Sequence[Condition], mix: Path, listener: Listener
) -> dict[str, float | None]:
    """Measure the look-ahead in ms on the beginning of a scene; None where an aid fails."""
    scene, rate = read_audio(mix)
    scene = _two_channels(mix, scene)[:, : int(_LONGEST_SECONDS * rate)]
    time = scene.shape[-1]
    generator = torch.Generator().manual_seed(0)
    other = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    if scene.any():
        other *= scene.square().mean().sqrt() / other.square().mean().sqrt()
    else:  # its beginning is silent
        scene = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    places = [*range(time // 4, time, max(1, time // (_PLACES + 3)))][:_PLACES]
    signals = [scene, *(torch.cat((scene[:, :p], other[:, p:]), -1) for p in places)]
    ahead: dict[str, float | None] = {}
    for condition in conditions:
        assert condition.process is not None
        try:
            first, *others = (condition.process(signal, listener) for signal in signals)
        except ValueError:
            ahead[condition.name] = None
            continue
        ahead[condition.name] = 1000.0 * samples_ahead(first, others, places) / rate
    return ahead


class _Pair(NamedTuple):
    """One scene for one listener."""

    scene: str
    person: str
    files: Scene
    listener: Listener

    def file(self, folder: Path) -> Path:
        """Return the file of the output in a condition's folder."""
        return folder / f"{self.scene}_{self.person}_HA-output.wav"


def _reference_file(out: Path, scene: str) -> Path:
    return out / "reference" / f"{scene}.wav"


def _remove_outdated(
    conditions: Sequence[Condition], folders: Mapping[str, Path], scenes: Mapping[str, Scene]
) -> None:
    """Remove the signals of a condition whose processing or scenes have changed since they were written."""
    mixes = [content_hash(scene.mix) for scene in scenes.values()]
    for condition in conditions:
        folder = folders[condition.name]
        note, state = folder / "fingerprint.txt", key_of({"of": [condition.fingerprint, mixes]})
        unknown = condition.fingerprint is None
        if unknown or not note.is_file() or note.read_text() != state:
            for path in folder.glob("*_HA-output.wav"):
                path.unlink()
            write_atomically(note, state)


@one_thread()
def _write_signals(
    pair: _Pair, rate: int, conditions: Sequence[Condition], folders: Mapping[str, Path], out: Path
) -> dict[str, str]:
    """Write the reference and the missing outputs of a pair; return by condition why there is none."""
    problems: dict[str, str] = {}
    try:
        mix, reference = _read_scene(pair.files, rate)
        _write(_reference_file(out, pair.scene), reference, rate)
    except ValueError as error:
        return dict.fromkeys(folders, str(error))
    for condition in conditions:
        path = pair.file(folders[condition.name])
        try:
            if not path.is_file() and condition.process is not None:
                _write(path, condition.process(mix, pair.listener), rate)
        except Exception as error:  # whatever it is, the other conditions go on
            problems[condition.name] = reason_of(error)
    return problems


def _write(path: Path, waveform: Tensor, rate: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_audio(path, waveform, rate)


def _read_scene(scene: Scene, rate: int) -> tuple[Tensor, Tensor]:
    """Return the mix, and the target without its room at the level that it has in the room.

    Shape: -> (2, time) twice. ValueError if a file is broken, or its rate or length is not that of the mix.
    """
    mix, reference, *in_room = _same_length(scene, rate)
    if not in_room:
        return mix, reference
    power, wanted = (
        signal.double().square().mean(-1, keepdim=True) for signal in (reference, in_room[0])
    )
    if not bool(power.all()):
        raise ValueError(f"a channel of {scene.reference} is silent")
    return mix, reference * (wanted / power).sqrt()


def _same_length(scene: Scene, rate: int) -> Iterator[Tensor]:
    """Yield the signals of a scene, cut to the mix's length if they differ from it by 0.1 s at most."""
    samples = 0
    for path in filter(None, scene):
        waveform, found = read_audio(path)
        if found != rate:
            raise ValueError(f"{path} has {found} Hz, and the first scene {rate} Hz")
        lengths = waveform.shape[-1], samples or waveform.shape[-1]
        samples = common_length(lengths, rate, (str(path), str(scene.mix)))
        yield _two_channels(path, waveform[:, :samples], mono=path != scene.mix)


def _two_channels(path: Path, waveform: Tensor, mono: bool = False) -> Tensor:
    """Return a waveform of two channels, with ``mono`` also of one; ValueError for other numbers."""
    if len(waveform) != 2 and not (mono and len(waveform) == 1):
        raise ValueError(f"{path} has {len(waveform)} channels; expected left and right")
    return waveform.expand(2, -1)
