"""Scenes of the Clarity enhancement challenges: both ears' aids, and the score of the better ear.

As in the challenges' own scripts (claritychallenge/clarity, recipes/icassp_2023 and cec3), the reference is the
target without its room, at the level that the target has in the room; a file's RMS of 1.0 is 100 dB SPL; and the
score of a listener is that of the ear which scores higher, by each measure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audio import read_audio, write_audio
from hlsim.audiogram.listener import EARS, Listener
from hlsim.audiogram.table import read_listeners
from hlsim.calibration import check_full_scale, gain_to_pascals, level_spl, set_level
from hlsim.evaluation.comparison import compare
from hlsim.evaluation.enhancers import load_enhancers
from hlsim.evaluation.fingerprint import combined_fingerprint, fingerprint
from hlsim.evaluation.measurements import samples_ahead
from hlsim.evaluation.measures import find_measures
from hlsim.evaluation.result import Evaluation, check_scored, score_columns
from hlsim.evaluation.store import ScoreStore, content_hash, key_of
from hlsim.evaluation.study import Condition, Item, Measure, Source, Values, run_study
from hlsim.files import write_atomically
from hlsim.metrics.pair import check_seed
from hlsim.parallel import Progress
from hlsim.plugins import WaveformPlugin

if TYPE_CHECKING:
    from pandas import DataFrame

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


@dataclass(frozen=True)
class Scene:
    """Files of a scene: the front microphones, the target without its room, and the target in the room, if known."""

    mix: Path
    reference: Path
    in_room: Path | None


@dataclass(frozen=True)
class SceneItem:
    """One scene for one listener, in files; ``problem`` says why its reference cannot be used."""

    scene: str
    person: str
    mix: Path
    reference: Path
    listener: Listener
    full_scale_spl: float
    seed: int
    problem: str = ""

    @property
    def name(self) -> str:
        """Listener and scene."""
        return f"{self.person} {self.scene}"

    @property
    def facts(self) -> dict[str, Any]:
        """What the table says of the item."""
        return {"scene": self.scene, "listener": self.person}

    def digest(self, condition: str) -> str:
        """Return the SHA-256 of both files, the listener, the level and the seed."""
        if self.problem:
            raise ValueError(self.problem)
        files = [content_hash(self.mix), content_hash(self.reference)]
        settings = [self.full_scale_spl, self.seed]
        return key_of({"files": files, "ears": self.listener.to_dict(), "settings": settings})

    def load(self) -> Item:
        """Read mix and reference."""
        (mix, rate), (reference, _) = read_audio(self.mix), read_audio(self.reference)
        return Item(
            self.name,
            reference,
            two_channels(self.mix, mix),
            self.listener,
            sample_rate=rate,
            full_scale_spl=self.full_scale_spl,
            seed=(self.seed + int(content_hash(self.reference)[:8], 16)) % 2**32,
            facts=self.facts,
        )


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
        settings = (
            f"{self.aid is None} {self.enhancer is None} {self.sample_rate} {self.full_scale_spl}"
        )
        return combined_fingerprint(settings, *map(fingerprint, parts))

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


@dataclass(frozen=True, kw_only=True)
class Written(Condition):
    """A condition whose outputs are written to a folder, under the challenges' names."""

    folder: Path

    def file(self, item: Source) -> Path:
        """Return the file of an output."""
        facts = item.facts
        return self.folder / f"{facts['scene']}_{facts['listener']}_HA-output.wav"

    def output(self, item: Item) -> Tensor:
        """Process an item and write the output."""
        output = self.process(item.signal, item.ear)
        write_audio(self.file(item), output, item.sample_rate)
        return output

    def prepare_folder(self) -> None:
        """Remove outputs of another processing of the same name."""
        self.folder.mkdir(parents=True, exist_ok=True)
        note = self.folder / "fingerprint.txt"
        if not note.is_file() or note.read_text() != str(self.fingerprint):
            for path in self.folder.glob("*_HA-output.wav"):
                path.unlink()
            write_atomically(note, str(self.fingerprint))


class BetterEar:
    """Scores of the better ear: the higher one by each measure, and the level by the first."""

    def __init__(self, measures: Sequence[Measure]) -> None:
        self.measures = list(measures)

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of all measures; None if one is unknown."""
        return combined_fingerprint(*(measure.fingerprint for measure in self.measures))

    def __call__(self, item: Item, output: Tensor) -> Values:
        """Return the scores, the level in dB SPL, and which ear is better."""
        ears, reasons = {}, []
        for place, ear in enumerate(EARS):
            try:
                ears[ear] = self._score_ear(item, output, place)
            except ValueError as error:
                reasons.append(f"{ear} ear: {error}")
        if not ears:
            raise ValueError("; ".join(reasons))
        first = self.measures[0].name
        better = max(ears, key=lambda ear: ears[ear][first])
        scores = {name: max(scores[name] for scores in ears.values()) for name in ears[better]}
        return {**scores, "level": ears[better]["level"], "better_ear": better}

    def _score_ear(self, item: Item, output: Tensor, place: int) -> dict[str, float]:
        one_ear = Item(
            item.name,
            item.clean[place].double(),
            item.signal[place].double(),
            getattr(item.ear, EARS[place]),
            sample_rate=item.sample_rate,
            full_scale_spl=item.full_scale_spl,
            seed=item.seed,
        )
        samples = output[place].float().double()  # as the file has them
        if not bool(samples.any()):
            raise ValueError("the output is silent")
        scores: dict[str, Any] = {}
        for measure in self.measures:
            scores |= measure.compute(one_ear, samples)
        return {**scores, "level": float(level_spl(samples, item.full_scale_spl))}


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
    jobs: int | None = None,
    dask: str | None = None,
    progress: Progress | None = None,
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
        jobs, dask, progress: as in ``run_study``.

    Returns: the evaluation of all conditions, ``unaided`` first; its detail ``look_ahead_ms`` is by condition, None
        where an aid fails on the first pair.

    Raises:
        ValueError: a file is missing, broken or contradicts another, a listener lacks an ear, or nothing
            could be scored.
        MissingExtraError: a package is not installed.
    """
    scores = find_measures(["haspi", "hasqi", *measures])
    check_seed(seed)
    check_full_scale(full_scale_spl)
    if every < 1:
        raise ValueError(f"every is {every}; expected 1 or more")
    if taken := {UNAIDED, NAL_R} & set(aids):
        raise ValueError(f"{taken.pop()} is always evaluated; give the aid another label")
    known, people = read_scenes(scenes), read_listeners(listeners)
    pairs = read_pairs(scenes_listeners, known, people)[::every]
    rate = read_audio(known[pairs[0][0]].mix)[1]
    conditions = _conditions(aids, enhancers, linked, rate, full_scale_spl, Path(out) / "signals")
    ahead = _look_ahead(conditions, known[pairs[0][0]].mix, people[pairs[0][1]])
    problems = _write_references({name: known[name] for name, _ in pairs}, rate, Path(out))
    items = [
        SceneItem(
            scene=scene,
            person=person,
            mix=known[scene].mix,
            reference=_reference_file(Path(out), scene),
            listener=people[person],
            full_scale_spl=full_scale_spl,
            seed=seed,
            problem=problems.get(scene, ""),
        )
        for scene, person in pairs
    ]
    for condition in conditions:
        condition.prepare_folder()
    better = BetterEar(scores)
    table = run_study(
        items,
        conditions,
        [Measure("better ear", better, settings=better.fingerprint)],
        store=ScoreStore(Path(out) / "scores.jsonl"),
        is_kept=lambda item, condition: _written(condition).file(item).is_file(),
        jobs=jobs,
        dask=dask,
        progress=progress,
    )
    check_scored(table, ["haspi"])
    table = _with_ears(table, items)
    columns = score_columns(table, scores, {**items[0].facts, **_EAR_FACTS})
    planned = [
        ("haspi", NAL_R, condition.name) for condition in conditions if condition.kind == "aid"
    ]
    return Evaluation(
        items=items,
        conditions=conditions,
        measures=scores,
        table=table,
        comparisons=compare(table, columns, planned=planned),
        settings={
            "seed": seed,
            "measures": columns,
            "full_scale_spl": full_scale_spl,
            "better_ear": True,
        },
        details={"look_ahead_ms": ahead},
    )


_EAR_FACTS = dict.fromkeys(("better_ear", "severity", "audiogram"))


def _written(condition: Condition) -> Written:
    assert isinstance(condition, Written)
    return condition


def _with_ears(table: DataFrame, items: Sequence[SceneItem]) -> DataFrame:
    """Add severity and audiogram of the ear that is better under the last condition."""
    last = table[table["condition"] == table["condition"].iloc[-1]].set_index("item")
    ears = {
        number: getattr(items[number].listener, ear if isinstance(ear, str) else EARS[0])
        for number, ear in last["better_ear"].items()
    }
    return table.assign(
        severity=[ears[number].severity for number in table["item"]],
        audiogram=[list(ears[number].thresholds) for number in table["item"]],
    )


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
        levelled = found[0].name.endswith(_REFERENCE[-1]) or not in_room.is_file()
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
    if path is None:
        pairs = [(scene, name) for scene in scenes for name in listeners]
    else:
        try:
            named = json.loads(Path(path).read_text(encoding="utf-8"))
            pairs = [(scene, name) for scene, names in named.items() for name in names]
        except (OSError, ValueError, RecursionError, AttributeError, TypeError) as error:
            raise ValueError(
                f"{path}: cannot be read ({error}); expected an object with a list of listeners per scene"
            ) from error
    if not pairs:
        raise ValueError(f"{path}: no scene has a listener")
    for scene, name in pairs:
        if scene not in scenes:
            raise ValueError(f"{path}: there is no scene {scene!r} in the folder of scenes")
        if name not in listeners:
            raise ValueError(f"{path}: there is no listener {name!r} among {len(listeners)}")
        if Path(name).name != name:
            raise ValueError(f"the listener {name!r} has a name that no file can have")
        missing = [ear for ear in EARS if getattr(listeners[name], ear) is None]
        if missing:
            raise ValueError(f"the {missing[0]} ear of listener {name} is missing")
    return list(dict.fromkeys(pairs))


def _conditions(
    aids: Mapping[str, str],
    enhancers: Sequence[str],
    linked: bool,
    rate: int,
    full_scale_spl: float,
    folder: Path,
) -> list[Written]:
    levels: dict[str, Any] = {"sample_rate": rate, "full_scale_spl": full_scale_spl}
    loaded: dict[str, Any] = {NAL_R: load_compensator("nalr", **levels)}
    for label, name in aids.items():
        if ":" in name and not Path(name).exists():
            loaded[label] = WaveformPlugin(name, "aid")
        else:
            loaded[label] = load_compensator(name, **levels, linked=linked).eval()
    before = load_enhancers(enhancers)

    def condition(name: str, aid: Any, enhancer: Any, kind: str, of: str = "") -> Written:
        own = folder / re.sub(r"[^\w.+-]+", "-", name).strip(".-")
        process = Aids(aid, enhancer, rate, full_scale_spl)
        return Written(name, process, kind, of, folder=own)

    conditions = [condition(UNAIDED, None, None, "unaided")]
    for label, aid in loaded.items():
        for prefix, enhancer in before.items():
            conditions.append(condition(f"{prefix} + {label}", aid, enhancer, "enhanced", label))
        kind = "prescription" if label == NAL_R else "aid"
        conditions.append(condition(label, aid, None, kind))
    folders = {own.folder for own in conditions}
    if len(folders) < len(conditions) or folder in folders:
        raise ValueError(
            f"the labels {', '.join(aids)} make no folders of different names; choose others"
        )
    return conditions


def _look_ahead(
    conditions: Sequence[Condition], mix: Path, listener: Listener
) -> dict[str, float | None]:
    """Measure the look-ahead in ms on the beginning of a scene; None where an aid fails."""
    scene, rate = read_audio(mix)
    scene = two_channels(mix, scene)[:, : int(_LONGEST_SECONDS * rate)]
    time = scene.shape[-1]
    generator = torch.Generator().manual_seed(0)
    other = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    if scene.any():
        other *= scene.square().mean().sqrt() / other.square().mean().sqrt()
    else:  # its beginning is silent
        scene = set_level(torch.randn(scene.shape, generator=generator), 65.0)
    places = [*range(time // 4, time, max(1, time // (_PLACES + 3)))][:_PLACES]
    changed = [torch.cat((scene[:, :place], other[:, place:]), -1) for place in places]
    ahead: dict[str, float | None] = {}
    for condition in conditions:
        try:
            first, *others = (condition.process(signal, listener) for signal in (scene, *changed))
        except ValueError:
            ahead[condition.name] = None
            continue
        ahead[condition.name] = 1000.0 * samples_ahead(first, others, places) / rate
    return ahead


def _reference_file(out: Path, scene: str) -> Path:
    return out / "reference" / f"{scene}.wav"


def _write_references(scenes: Mapping[str, Scene], rate: int, out: Path) -> dict[str, str]:
    """Write the reference of each scene; return by scene why there is none."""
    problems = {}
    (out / "reference").mkdir(parents=True, exist_ok=True)
    for name, scene in scenes.items():
        try:
            write_audio(_reference_file(out, name), read_reference(scene, rate), rate)
        except ValueError as error:
            problems[name] = str(error)
    return problems


def read_reference(scene: Scene, rate: int) -> Tensor:
    """Return the target without its room at the level that it has in the room. Shape: -> (2, time).

    Raises:
        ValueError: a file is broken, or its rate or length is not that of the mix.
    """
    signals = []
    for path in filter(None, (scene.mix, scene.reference, scene.in_room)):
        waveform, found = read_audio(path)
        if found != rate:
            raise ValueError(f"{path} has {found} Hz and the first scene {rate} Hz")
        signals.append(two_channels(path, waveform, mono=path is not scene.mix))
        if signals[-1].shape[-1] != signals[0].shape[-1]:
            raise ValueError(
                f"{path} has {signals[-1].shape[-1]} samples and the mix {signals[0].shape[-1]}"
            )
    reference, *in_room = signals[1:]
    if not in_room:
        return reference
    power, wanted = (
        signal.double().square().mean(-1, keepdim=True) for signal in (reference, in_room[0])
    )
    if not bool(power.all()):
        raise ValueError(f"a channel of {scene.reference} is silent")
    return reference * (wanted / power).sqrt()


def two_channels(path: Path, waveform: Tensor, mono: bool = False) -> Tensor:
    """Return a waveform of two channels, with ``mono`` also of one; ValueError for other numbers."""
    channels = len(waveform)
    if channels != 2 and not (mono and channels == 1):
        expected = "1 or 2" if mono else "2, left and right"
        raise ValueError(f"{path} has {channels} channels; expected {expected}")
    return waveform.expand(2, -1)
