"""Scenes of the Clarity enhancement challenges: listeners' aids run on both ears, and the better ear's HASPI and HASQI.

What the challenges' own scripts do (claritychallenge/clarity, recipes/icassp_2023 and cec3): the reference is the
target without its room at the level that it has in it, a file's RMS of 1.0 is 100 dB SPL, and a listener's score is that
of the ear which scores higher, by each measure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram.listener import EARS, Listener, read_listeners
from hlsim.calibration import check_full_scale, gain_to_pascals, set_level
from hlsim.evaluation.enhancers import load_enhancers
from hlsim.evaluation.measurements import samples_ahead
from hlsim.evaluation.previous.haspi_report import HaspiReport, report_items
from hlsim.evaluation.previous.keys import weights_hash
from hlsim.evaluation.previous.scores import Failure
from hlsim.evaluation.previous.scoring import FileItem
from hlsim.evaluation.store import ScoreStore, content_hash, key_of
from hlsim.metrics.pair import check_seed
from hlsim.metrics.registry import MeasureName, check_measures
from hlsim.parallel import Failed, Progress, check_parallel, make_missing, one_thread, reason_of
from hlsim.plugins import WaveformPlugin

FULL_SCALE_SPL = 100.0
"""Level in dB SPL of RMS 1.0 in the challenges' files."""

RULE_MS = 5.0
"""How far the challenges let an aid look ahead."""

UNAIDED, PRESCRIBED = "unaided", "NAL-R"
"""Conditions that are always there."""

_MIX = ("_mix_CH1.wav", "_mixed_CH1.wav")
_REFERENCE = ("_target_anechoic_CH1.wav", "_target_anechoic.wav", "_reference.wav")
_IN_ROOM = "_target_CH1.wav"

_MEASURES: tuple[MeasureName, ...] = ("haspi", "hasqi")
_PLACES = 8  # of a scene, where it becomes another sound
_LONGEST = 4.0  # seconds of that scene


@dataclass(frozen=True)
class Scene:
    """Files of a scene: what the front microphones get, the target without its room, and in it where there is that."""

    mix: Path
    reference: Path
    in_room: Path | None


class Aids(NamedTuple):
    """What both ears are given of a scene, after an enhancer or at once; None for ``aid`` leaves it as it is."""

    aid: nn.Module | WaveformPlugin | None
    enhancer: WaveformPlugin | None
    sample_rate: int
    full_scale_spl: float

    @torch.no_grad()
    def __call__(self, waveform: Tensor, listener: Listener) -> Tensor:
        """Shape: (2, time) -> (2, time)."""
        if self.enhancer is not None:
            gain = gain_to_pascals(self.full_scale_spl)
            waveform = self.enhancer(waveform * gain, self.sample_rate) / gain
        if isinstance(self.aid, WaveformPlugin):
            return self.aid(waveform, listener, self.sample_rate)
        if self.aid is None:
            return waveform
        aided: Tensor = self.aid(waveform, listener)
        return aided

    def settings(self) -> dict[str, Any]:
        """What its outputs are stored under."""
        aid = self.aid
        of_aid = weights_hash(aid) if isinstance(aid, nn.Module) else str(aid)
        return {
            "aid": of_aid,
            "enhancer": str(self.enhancer),
            "full_scale_spl": self.full_scale_spl,
        }


class _Task(NamedTuple):
    """A file to make of others."""

    make: Callable[..., Tensor]
    given: tuple[Path, ...]
    more: tuple[Any, ...]
    sample_rate: int
    made: Path
    key: str


def evaluate_scenes(
    aids: Mapping[str, str],
    *,
    scenes: str | Path,
    listeners: str | Path,
    out: str | Path,
    scenes_listeners: str | Path | None = None,
    every: int = 1,
    enhancers: Sequence[str] = (),
    linked: bool = False,
    full_scale_spl: float = FULL_SCALE_SPL,
    seed: int = 0,
    jobs: int | None = None,
    progress: Callable[[str], Progress] | None = None,
) -> HaspiReport:
    """Judge pairs of aids beside no aid and NAL-R on binaural scenes, by the better ear's HASPI and HASQI.

    What the ears are given is written to ``out/signals/CONDITION/SCENE_LISTENER_HA-output.wav``, the challenges' names,
    the references to ``out/reference``; files, and scores in ``out/scores.jsonl``, are made once, and a run that was
    stopped goes on where it was.

    Args:
        aids: by label, a compensator's name or folder, or the name of a plug-in
            ``(waveform, listener, sample_rate) -> waveform``.
        scenes: folder with ``SCENE_mix_CH1.wav`` (or ``_mixed_CH1``), of two channels, and
            ``SCENE_target_anechoic_CH1.wav`` (or ``_target_anechoic``, ``_reference``), of one or two. With
            ``SCENE_target_CH1.wav`` there, each channel of the former gets that one's level, as in the challenges.
        listeners: Clarity's ``listeners.json``, or a CSV file, as ``read_listeners`` takes.
        scenes_listeners: JSON file of the names of each scene's listeners; None takes every listener in every scene.
        every: of the pairs of scene and listener take the first and then each so manyth; the challenges' small test
            has 15.
        enhancers: names of plug-ins that remove noise before each aid, see ``load_enhancer``.
        linked: compensators set the gains of both ears by one level.
        full_scale_spl: level in dB SPL of RMS 1.0.
        jobs: processes; None takes all cores.
        progress: of what it is to tell of, called with how many are done and all.

    Returns: a report of all conditions, ``unaided`` first, the last aid last, whose ``extra`` has ``looks_ahead_ms`` by
        condition: how long before the input becomes another sound the output changes, see ``samples_ahead``; None where
        an aid refused the first pair.

    Raises:
        ValueError: a file is missing, broken or contradicts another, a listener lacks an ear, or nothing could be scored.
        MissingExtraError: joblib is not installed.
    """
    check_measures(_MEASURES)
    check_parallel(jobs, "loky", None)
    check_seed(seed)
    check_full_scale(full_scale_spl)
    if every < 1:
        raise ValueError(f"every is {every}; allowed: 1 or more")
    if taken := {UNAIDED, PRESCRIBED} & {*aids}:
        raise ValueError(
            f"an aid named {min(taken)!r}; allowed: other names, that one is there anyway"
        )
    known, people = read_scenes(scenes), read_listeners(listeners)
    pairs = read_pairs(scenes_listeners, known, people)[::every]
    rate = read_audio(known[pairs[0][0]].mix)[1]
    conditions = _conditions(aids, enhancers, linked, rate, full_scale_spl)
    ahead = _looks_ahead(conditions, known[pairs[0][0]].mix, people[pairs[0][1]])
    show = progress or (lambda what: lambda done, total: None)
    store, folder = ScoreStore(Path(out) / "signals.jsonl"), Path(out)
    references = {name: folder / "reference" / f"{name}.wav" for name, _ in pairs}
    tasks = [_reference_task(known[name], path, rate) for name, path in references.items()]
    given = {label: {"rate": rate, **own.settings()} for label, own in conditions.items()}
    made = {
        label: folder / "signals" / re.sub(r"[^\w.+-]+", "-", label).strip(".-")
        for label in conditions
    }
    if len({*made.values(), folder / "signals"}) <= len(made):
        raise ValueError(
            f"labels {', '.join(aids)}; allowed: ones whose letters and digits differ, for folders' names"
        )
    for label, own in conditions.items():
        for name, person in pairs:
            path = made[label] / f"{name}_{person}_HA-output.wav"
            about = {
                "signal": content_hash(known[name].mix),
                "listener": people[person].to_dict(),
                **given[label],
            }
            key = key_of({**about, "made": str(path.relative_to(folder))})
            tasks.append(_Task(_aided, (known[name].mix,), (own, people[person]), rate, path, key))
    for task in tasks:
        _forget_changed(store, task)
    failed = make_missing(
        _make, tasks, lambda task: [task.key], store, jobs=jobs, progress=show("signals")
    )
    reasons = {task.made: failed[task.key] for task in tasks if task.key in failed}
    items, failures = [], []
    for name, person in pairs:
        reference = references[name]
        paths = {label: made[label] / f"{name}_{person}_HA-output.wav" for label in conditions}
        broken = {
            label: reasons.get(reference) or reasons.get(path) for label, path in paths.items()
        }
        whole = {label: path for label, path in paths.items() if not broken[label]}
        for label, reason in broken.items():
            failures += [
                Failure(f"{person} {name}", label, measure, reason)
                for measure in _MEASURES
                if reason
            ]
        for ear in EARS if whole else ():
            about = {"listener": person, "ear": ear, "full_scale_spl": full_scale_spl}
            audiogram = getattr(people[person], ear)
            items.append(FileItem(f"{person} {ear} {name}", reference, whole, audiogram, **about))
    if not items:
        raise ValueError(
            f"no scene could be used; the first, {failures[0].file}: {failures[0].reason}"
        )
    return report_items(
        items,
        _MEASURES,
        conditions=[*conditions],
        better_ear=True,
        store=folder / "scores.jsonl",
        seed=seed,
        failures=failures,
        extra={"looks_ahead_ms": ahead},
        jobs=jobs,
        progress=show("scores"),
    )


def read_scenes(folder: str | Path) -> dict[str, Scene]:
    """The scenes of a folder by name, sorted; ValueError where there is none, or one lacks its reference."""
    folder, found = Path(folder), {}
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder; allowed: one with Clarity's scenes")
    for path in sorted(folder.iterdir()):
        end = next((end for end in _MIX if path.name.endswith(end)), None)
        if end is None:
            continue
        name = path.name.removesuffix(end)
        references = [own for other in _REFERENCE if (own := folder / (name + other)).is_file()]
        if not references:
            raise ValueError(
                f"{path}: no reference; allowed: {' or '.join(name + end for end in _REFERENCE)} beside it"
            )
        in_room = folder / (name + _IN_ROOM)
        # a reference of the third challenge has its level
        level_of = (
            in_room
            if in_room.is_file() and not references[0].name.endswith(_REFERENCE[-1])
            else None
        )
        found[name] = Scene(path, references[0], level_of)
    if not found:
        raise ValueError(f"{folder}: no scenes; allowed: files that end with {' or '.join(_MIX)}")
    return found


def read_pairs(
    path: str | Path | None, scenes: Mapping[str, Scene], listeners: Mapping[str, Listener]
) -> list[tuple[str, str]]:
    """Scenes and listeners by name, from Clarity's ``scenes_listeners.json``, or every two.

    Raises ValueError where the file is broken, names a scene or listener that there is not, or a listener lacks an ear.
    """
    if path is None:
        pairs = [(scene, name) for scene in scenes for name in listeners]
    else:
        try:
            given = json.loads(Path(path).read_text(encoding="utf-8"))
            pairs = [(scene, name) for scene, names in given.items() for name in names]
        except (
            OSError,
            UnicodeDecodeError,
            RecursionError,
            ValueError,
            AttributeError,
            TypeError,
        ) as error:
            raise ValueError(
                f"{path}: cannot be read ({error}); allowed: a JSON object with a list of listeners for each scene"
            ) from error
    if not pairs:
        raise ValueError(f"{path}: no scene has a listener; allowed: one or more")
    for scene, name in pairs:
        if scene not in scenes:
            raise ValueError(f"{path}: no scene {scene!r} in the folder of scenes")
        if name not in listeners:
            raise ValueError(f"{path}: no listener {name!r} among {len(listeners)}")
        if Path(name).name != name:
            raise ValueError(f"listener {name!r}; allowed: a name that a file can have")
        if gone := [ear for ear in EARS if getattr(listeners[name], ear) is None]:
            raise ValueError(
                f"listener {name}: the {gone[0]} ear is missing; allowed: both, for the better ear's score"
            )
    return [*dict.fromkeys(pairs)]


def _conditions(
    aids: Mapping[str, str],
    enhancers: Sequence[str],
    linked: bool,
    rate: int,
    full_scale_spl: float,
) -> dict[str, Aids]:
    before = load_enhancers(enhancers)
    options: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl}

    def load(name: str) -> Any:
        if ":" in name and not Path(name).exists():
            return WaveformPlugin(name, "aid")
        return load_compensator(name, **options, linked=linked).eval()

    loaded = {
        PRESCRIBED: load_compensator("nalr", **options),
        **{label: load(name) for label, name in aids.items()},
    }
    conditions = {UNAIDED: Aids(None, None, rate, full_scale_spl)}
    for label, aid in loaded.items():
        for prefix, enhancer in before.items():
            conditions[f"{prefix} + {label}"] = Aids(aid, enhancer, rate, full_scale_spl)
        conditions[label] = Aids(aid, None, rate, full_scale_spl)
    return conditions


def _looks_ahead(
    conditions: Mapping[str, Aids], mix: Path, listener: Listener
) -> dict[str, float | None]:
    """By condition in ms, on the beginning of a scene; None where it fails, which scoring will tell."""
    scene, rate = read_audio(mix)
    scene = _two_channels(mix, scene)[:, : int(_LONGEST * rate)]
    time = scene.shape[-1]
    drawn = torch.Generator().manual_seed(0)
    other = set_level(torch.randn(scene.shape, generator=drawn), 65.0)
    if scene.any():
        other *= scene.square().mean().sqrt() / other.square().mean().sqrt()
    else:  # its beginning is silent
        scene = set_level(torch.randn(scene.shape, generator=drawn), 65.0)
    places = [*range(time // 4, time, max(1, time // (_PLACES + 3)))][:_PLACES]
    changed = [torch.cat((scene[:, :place], other[:, place:]), -1) for place in places]
    found: dict[str, float | None] = {}
    for label, aids in conditions.items():
        try:
            first, *others = (aids(given, listener) for given in (scene, *changed))
        except ValueError:
            found[label] = None
            continue
        found[label] = 1000.0 * samples_ahead(first, others, places) / rate
    return found


def _reference_task(scene: Scene, made: Path, rate: int) -> _Task:
    given = (scene.mix, scene.reference, *filter(None, [scene.in_room]))
    key = key_of(
        {
            "files": [content_hash(path) for path in given[1:]],
            "made": made.name,
            "kind": "reference",
        }
    )
    return _Task(_reference, given, (), rate, made, key)


def _reference(mix: Tensor, reference: Tensor, in_room: Tensor | None = None) -> Tensor:
    if in_room is None:
        return reference
    power, wanted = (
        signal.double().square().mean(-1, keepdim=True) for signal in (reference, in_room)
    )
    if not bool(power.all()):
        raise ValueError("a silent channel of the reference; allowed: speech in both")
    return reference * (wanted / power).sqrt()


def _aided(mix: Tensor, aids: Aids, listener: Listener) -> Tensor:
    return aids(mix, listener)


def _two_channels(path: Path, waveform: Tensor, mono: bool = False) -> Tensor:
    channels = waveform.shape[0]
    if channels != 2 and not (mono and channels == 1):
        raise ValueError(
            f"{path}: {channels} channels; allowed: {'1 or ' if mono else ''}2, left and right"
        )
    return waveform.expand(2, -1)


def _read(task: _Task) -> Iterator[Tensor]:
    length = None
    for path in task.given:
        waveform, rate = read_audio(path)
        if rate != task.sample_rate:
            raise ValueError(f"{path}: {rate} Hz; allowed: the first scene's {task.sample_rate} Hz")
        length = length or waveform.shape[-1]
        if waveform.shape[-1] != length:
            raise ValueError(f"{path}: {waveform.shape[-1]} samples; allowed: the mix's {length}")
        yield _two_channels(path, waveform, mono=path is not task.given[0])


@one_thread()
def _make(task: _Task, _: Sequence[str] = ()) -> dict[str, dict[str, Any] | Failed]:
    try:
        made = task.make(*_read(task), *task.more)
        task.made.parent.mkdir(parents=True, exist_ok=True)
        write_audio(task.made, made, task.sample_rate)
    except Exception as error:  # whatever it is, it is this file's reason, and the others go on
        return {task.key: Failed(reason_of(error))}
    return {task.key: {"file": task.made.name, "sha256": content_hash(task.made)}}


def _forget_changed(store: ScoreStore, task: _Task) -> None:
    """A file that is gone, or another than was made, is made anew."""
    record = store.get(task.key)
    if record and not (task.made.is_file() and content_hash(task.made) == record["sha256"]):
        del store.records[task.key]
