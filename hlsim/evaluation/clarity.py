"""The study of ``clarity``: aids of both ears on scenes of the Clarity enhancement challenges.

As in the challenges' scripts (claritychallenge/clarity, recipes/icassp_2023 and cec3), the
reference is the target without its room, at the level of the target in the room. An RMS of 1.0 in a
file is 100 dB SPL. A listener has one score per measure, that of the ear with the higher score.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim.audio import find_audio, read_audio, write_audio
from hlsim.audiogram.listener import Listener
from hlsim.audiogram.table import read_listeners
from hlsim.calibration import level_spl, set_level
from hlsim.checks import check_number
from hlsim.data.layouts import CLARITY_REFERENCES
from hlsim.data.recorded_scenes import SceneFiles
from hlsim.evaluation.aid_properties import measure_look_ahead
from hlsim.evaluation.conditions import (
    NAL_R,
    UNAIDED,
    Enhanced,
    PluginAid,
    Unaided,
    load_enhancers,
    takes_microphones,
)
from hlsim.evaluation.measures import find_measures
from hlsim.evaluation.recorded_items import RecordedItem
from hlsim.evaluation.recordings import score_recordings
from hlsim.evaluation.result import Evaluation
from hlsim.evaluation.running.parallel import (
    CRASH,
    Crash,
    check_scheduler,
    describe_error,
    run_parallel,
)
from hlsim.evaluation.study import Condition, cut_output
from hlsim.files import lock_folder, read_json
from hlsim.progress import track
from hlsim.torchtools import one_thread

FULL_SCALE_SPL = 100.0
"""Level in dB SPL of RMS 1.0 in the challenges' files."""

RULE_MS = 5.0
"""Look-ahead in ms that the challenges allow."""

_MIX_ENDINGS = ("_mix_CH1.wav", "_mixed_CH1.wav")
"""Ends of the names of files with the signals of the front microphones."""

_MICROPHONES = (1, 2, 3)
"""Numbers of the front, middle and rear microphone in the names of files, after ``CH``."""

_CHANGES = 8
"""Number of positions at which the scene changes to noise, to measure the look-ahead."""

_LOOK_AHEAD_SECONDS = 4.0
"""Length of the part of a scene on which the look-ahead is measured."""


class _Pair(NamedTuple):
    """A scene and one of the listeners for whom it is processed.

    Attributes:
        mix: File with the signals of the front microphones, whose name ends with ``CH1.wav``.
        reference: File with the target without its room.
        scene: Name of the scene.
        name: Name of the listener.
        listener: Both ears of the listener.
    """

    mix: Path
    reference: Path
    scene: str
    name: str
    listener: Listener

    def microphone(self, number: int) -> Path:
        """Return the file with both ears' signals of a microphone; number 1 is the front one."""
        return self.mix.with_name(f"{self.mix.name.removesuffix('1.wav')}{number}.wav")

    @property
    def output_name(self) -> str:
        """Name of the file with an aid's output for both ears: SCENE_LISTENER_HA-output.wav."""
        return f"{self.scene}_{self.name}_HA-output.wav"


def evaluate_scenes(
    aids: Mapping[str, str],
    *,
    scenes: str | Path,
    listeners: str | Path,
    out: str | Path,
    outputs: Mapping[str, str | Path] | None = None,
    scenes_listeners: str | Path | None = None,
    microphones: Sequence[int] = (1,),
    stride: int = 1,
    enhancers: Sequence[str] = (),
    measures: Sequence[str] = (),
    precision: int = 32,
    linked: bool = False,
    full_scale_spl: float = FULL_SCALE_SPL,
    seed: int = 0,
    listen: int = 0,
    **running: Any,
) -> Evaluation:
    """Compare aids of both ears with no aid and NAL-R on binaural scenes, by HASPI and HASQI.

    The outputs are written to ``out/signals/CONDITION/SCENE_LISTENER_HA-output.wav`` (the
    challenges' names), the references to ``out/reference``, and the scores to
    ``out/scores.jsonl``, from which a repeated run reads them. The score of a scene is that of the
    better ear. The comparison of each aid with NAL-R by HASPI is planned, so that its p values
    are not adjusted for the number of comparisons.

    Args:
        aids: Compensators (name or folder) and aids of your own, by their label in tables. An aid
            is ``package.module:name`` of a function ``(waveform, listener, sample_rate) ->
            waveform`` for signals with shape (2, time), at the scale of the files and the sample
            rate of the first scene.
        scenes: Folder with ``SCENE_mix_CH1.wav`` (or ``_mixed_CH1``) with two channels, and
            ``SCENE_target_anechoic_CH1.wav`` (or ``_target_anechoic``, ``_reference``) with one or
            two. If there is a ``SCENE_target_CH1.wav``, or one with the first of ``microphones``
            as its number, the target in the room, each channel of the reference gets the level of
            that file, unless the reference is ``_reference``.
        listeners: Clarity's ``listeners.json``, or a CSV file, see ``read_listeners``. With
            ``scenes_listeners``, only the listeners in it are validated.
        out: Folder of the results.
        outputs: Folder of existing outputs of an aid, by the label of the aid in tables. The files
            have the challenges' names, see above, two channels, and the sample rate of the scenes.
            An output that is missing or broken is listed with the reason.
        scenes_listeners: JSON file with the names of the listeners of each scene; by default all
            scenes and listeners are combined.
        microphones: Numbers of the microphones that are used: 1 is the front one, 2 and 3 are the
            others, in ``SCENE_mix_CH2.wav`` and ``SCENE_mix_CH3.wav``. The input of aids is the
            mean of these microphones, as in the baseline of the third challenge. An aid of your own
            with the attribute ``takes_microphones = True`` receives all of them, with shape
            (microphones, 2, time).
        stride: Number n, of which every n-th pair of scene and listener is used. 15 gives the
            challenges' small test.
        enhancers: ``package.module:name`` of functions ``(waveform, sample_rate) -> waveform`` that
            reduce noise, for signals in pascals with shape (..., time). Each adds a condition
            before NAL-R and before each of ``aids``.
        measures: Further measures: names of hlsim's own, or ``package.module:name`` of yours.
        precision: Number of bits with which HASPI, HASQI and HAAQI are computed, 32 or 64.
        linked: Whether one level sets the gains of both ears. There must be ``aids``, which all
            support it.
        full_scale_spl: Level in dB SPL of a file whose RMS is 1.0.
        seed: Seed of the noise that HASPI, HASQI and HAAQI add.
        listen: Number of pairs of scene and listener with sounds for the players of a page, as an
            ear perceives them.
        running: Arguments of ``run_study``: ``jobs``, the number of processes; ``dask``, the
            address of a Dask scheduler; and ``progress``, a function of the numbers of finished
            and of all scores.

    Returns:
        The evaluation of all conditions, ``unaided`` first. Its ``notes`` say which microphones and
        how many files of ``outputs`` are not used. The column ``combined`` of its table is the mean
        of HASPI and HASQI. Its ``details["look_ahead_ms"]`` has the measured look-ahead by
        condition, and None for ``outputs`` and for an aid that fails on the first pair.

    Raises:
        ValueError: A file is missing, broken or contradicts another, a listener lacks an ear, an
            aid, enhancer or measure does not exist, a number is out of range, two conditions have
            one name, nothing could be scored, or another process evaluates scenes in ``out``.
        MissingExtraError: A package is not installed.
        OSError: The file of scores cannot be read.
    """
    check_scheduler(running.get("dask"))
    names = ["haspi", "hasqi", *measures]
    find_measures(names, precision)
    check_number("stride", stride, 1, whole=True)
    all_pairs = _read_pairs(Path(scenes), listeners, scenes_listeners)
    pairs = all_pairs[::stride]
    microphones = [*dict.fromkeys(microphones)]
    notes = _describe_unused_microphones(pairs, microphones)
    folders = {label: Path(folder) for label, folder in (outputs or {}).items()}
    for label, folder in folders.items():
        notes += _describe_unused_outputs(label, folder, pairs, all_pairs)
    rate = read_audio(pairs[0].mix)[1]
    levels = {"sample_rate": rate, "full_scale_spl": full_scale_spl}
    conditions = _make_conditions(aids, folders, enhancers, linked, **levels)
    for condition in conditions:
        _check_existing_outputs(condition, folders, Path(out))
    look_ahead_ms = {
        c.name: _measure_look_ahead(c, pairs[0], rate, microphones)
        for c in track(conditions, "conditions", len(conditions))
    }
    with lock_folder(out):  # Scores would be those of the signals that another run writes.
        write = partial(_write_signals, Path(out), conditions, folders, microphones, rate)
        written = run_parallel(write, pairs, jobs=running.get("jobs"), dask=running.get("dask"))
        recordings = []
        for pair, files in track(written, "pairs of scene and listener", len(pairs)):
            if isinstance(files, Crash):
                files = {condition.name: ValueError(CRASH) for condition in conditions}
            for side, ear in pair.listener.ears().items():
                recordings.append(
                    RecordedItem(
                        pair.scene,
                        _reference_file(Path(out), pair),
                        files,
                        ear,
                        pair.name,
                        side,
                        full_scale_spl=full_scale_spl,
                        seed=seed,
                    )
                )
        aid_names = [condition.name for condition in conditions if condition.kind == "aid"]
        evaluation = score_recordings(
            recordings,
            [replace(condition, process=None) for condition in conditions],
            names,
            precision=precision,
            better_ear=True,
            planned=[("haspi", NAL_R, name) for name in aid_names],
            listen=listen,
            played=[UNAIDED, NAL_R, *aid_names],
            store=Path(out) / "scores.jsonl",
            required=["haspi", "hasqi"],
            **running,
        )
    combined = evaluation.table[["haspi", "hasqi"]].mean(axis=1, skipna=False)
    return replace(
        evaluation,
        table=evaluation.table.assign(combined=combined),
        notes=[*notes, *evaluation.notes],
        details={"look_ahead_ms": look_ahead_ms},
    )


def _read_pairs(
    folder: Path, listeners: str | Path, scenes_listeners: str | Path | None
) -> list[_Pair]:
    """Return the pairs of scene and listener: those of ``scenes_listeners``, or else all.

    See ``evaluate_scenes`` for the arguments.

    Raises:
        ValueError: There is no scene, or two files are one scene; a scene lacks its reference; a
            file is broken, or names an unknown scene or listener; a listener who is used lacks an
            ear or has a name that cannot be that of a file; or two pairs have one output file.
    """
    mixes: dict[str, Path] = {}
    for ending in _MIX_ENDINGS:
        for mix in sorted(folder.glob(f"*{ending}")):
            scene = mix.name.removesuffix(ending)
            if scene in mixes:
                raise ValueError(f"{mixes[scene]} and {mix} are one scene; remove one of the two")
            mixes[scene] = mix
    if scenes_listeners is None:
        people = read_listeners(listeners)
        names = list(product(sorted(mixes), people))
    else:
        names = _read_names(Path(scenes_listeners))
        people = read_listeners(listeners, {name for _, name in names})
    pairs = []
    for scene, name in names:
        if scene not in mixes:
            raise ValueError(f"{scenes_listeners}: no scene {scene!r} in {folder}; correct it")
        if len(people[name].ears()) < 2:
            raise ValueError(f"{listeners}: listener {name!r} lacks an ear; add its audiogram")
        if Path(name).name != name:
            raise ValueError(f"{listeners}: listener {name!r} cannot name a file; rename it")
        candidates = [folder / f"{scene}{ending}" for ending in CLARITY_REFERENCES]
        reference = next(filter(Path.is_file, candidates), None)
        if reference is None:
            expected = " or ".join(path.name for path in candidates)
            raise ValueError(f"{mixes[scene]} has no reference; put {expected} beside it")
        pairs.append(_Pair(mixes[scene], reference, scene, name, people[name]))
    by_output = {pair.output_name: pair for pair in pairs}
    for pair in pairs:
        other = by_output[pair.output_name]
        if pair is not other:
            raise ValueError(
                f"the output of scene {pair.scene} for {pair.name} and that of scene "
                f"{other.scene} for {other.name} would be the same file, {pair.output_name}; "
                "rename a scene or a listener"
            )
    if not pairs:
        raise ValueError(
            f"{folder}, {scenes_listeners or listeners}: no scene has a listener; expected files "
            f"that end with {' or '.join(_MIX_ENDINGS)}, and a listener for them"
        )
    return pairs


def _read_names(path: Path) -> list[tuple[str, str]]:
    """Return pairs (scene, listener) of names, as ``scenes_listeners.json`` lists them.

    Raises:
        ValueError: The file cannot be read, or has another structure.
    """
    entries = read_json(path)
    try:
        pairs = [(scene, name) for scene, listeners in entries.items() for name in listeners]
        # A text instead of a list of names would give its letters.
        if any(isinstance(listeners, str) for listeners in entries.values()):
            raise ValueError("a scene has a text instead of a list")
        if not all(isinstance(name, str) for _, name in pairs):
            raise ValueError("a name is not a text")
        if len({*pairs}) < len(pairs):
            raise ValueError("a scene has the same listener twice")
    except (ValueError, AttributeError, TypeError) as error:
        raise ValueError(
            f"{path}: cannot be read ({error}); expected an object with a list of the names of "
            "listeners for each scene"
        ) from error
    return pairs


def _describe_unused_microphones(pairs: Sequence[_Pair], numbers: Sequence[int]) -> list[str]:
    """Return a list with a note about microphones that no aid receives, or an empty list.

    The list is empty unless a scene has files of microphones other than those in ``numbers``.

    Args:
        pairs: Pairs that are evaluated.
        numbers: Numbers of the microphones that the aids receive, out of 1, 2 and 3.
    """
    unused = [number for number in _MICROPHONES if number not in numbers]
    scenes = {pair.scene for pair, n in product(pairs, unused) if pair.microphone(n).is_file()}
    if not scenes:
        return []
    return [
        f"{len(scenes)} of {len({pair.scene for pair in pairs})} scenes have signals of other "
        f"microphones than {', '.join(map(str, numbers))}, which are not used. The baseline of the "
        "third challenge uses the mean of microphones 1, 2 and 3 (--microphones 1 2 3)."
    ]


def _describe_unused_outputs(
    label: str, folder: Path, pairs: Sequence[_Pair], all_pairs: Sequence[_Pair]
) -> list[str]:
    """Return a list with a note about audio files that belong to no pair, or an empty list.

    Args:
        label: Label of the aid.
        folder: Folder of existing outputs of this aid.
        pairs: Pairs that are evaluated.
        all_pairs: These pairs, and those that a stride leaves out.

    Raises:
        ValueError: The folder does not exist or has no audio, or no pair has an output.
    """
    names = {path.relative_to(folder).as_posix() for path in find_audio(folder, by_name=True)}
    if not names & {pair.output_name for pair in pairs}:
        raise ValueError(
            f"{folder}: no file is an output of {label} for a scene and a listener; expected names "
            f"such as {pairs[0].output_name}"
        )
    unused = sorted(names - {pair.output_name for pair in all_pairs})
    if not unused:
        return []
    return [
        f"{len(unused)} files of {label} belong to no scene and listener and are not used, such as "
        f"{unused[0]}."
    ]


def _make_conditions(
    aids: Mapping[str, str],
    folders: Mapping[str, Path],
    enhancers: Sequence[str],
    linked: bool,
    **levels: Any,
) -> list[Condition]:
    """Return the conditions: no aid, NAL-R, the aids, and the recorded outputs, in this order.

    NAL-R and each aid that is not recorded come after the conditions in which an enhancer precedes
    them.

    Args:
        aids: Aids by their label, see ``evaluate_scenes``.
        folders: Folders of existing outputs, by the label of their aid.
        enhancers: Names of functions that reduce noise.
        linked: Whether one level sets the gains of both ears.
        levels: Arguments ``sample_rate`` and ``full_scale_spl`` of aids.

    Raises:
        ValueError: An aid cannot be loaded or linked, two aids have the same label, or the signals
            of two conditions would have the same folder.
    """
    if linked and not aids:
        raise ValueError(
            "linked (--linked) has no effect on existing outputs; name an aid, or leave it out"
        )
    loaded: dict[str, nn.Module] = {NAL_R: load_compensator("nalr", **levels)}
    for label in (*aids, *folders):
        if label in (UNAIDED, NAL_R) or (label in aids and label in folders):
            raise ValueError(f"{label} is already evaluated; give the aid another label")
    for label, name in aids.items():
        if ":" in name and not Path(name).exists():
            if linked:
                raise ValueError(
                    f"{name} has no setting linked, because it is your own; link its ears in its "
                    "own code, and leave out linked (--linked)"
                )
            loaded[label] = PluginAid(name, levels["sample_rate"])
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
    # Some file systems do not distinguish upper and lower case.
    names = [_folder_name(condition).casefold() for condition in conditions]
    for folder in names:
        if names.count(folder) > 1:
            raise ValueError(
                f"two labels would have the same folder, {folder}, where file names ignore case; "
                "rename one of them"
            )
    for condition in conditions:
        if condition.name in folders:
            raise ValueError(
                f"{condition.name} is already evaluated; give the outputs another label"
            )
    return [*conditions, *(Condition(label) for label in folders)]


def _check_existing_outputs(condition: Condition, folders: Mapping[str, Path], out: Path) -> None:
    """Raise ValueError if a condition's outputs would be written to a folder of existing ones.

    Args:
        condition: Condition of the study.
        folders: Folders of existing outputs, by the label of their aid.
        out: Folder of the results.
    """
    target = out / "signals" / _folder_name(condition)
    for label, folder in folders.items():
        if condition.process is not None and folder.resolve() == target.resolve():
            raise ValueError(
                f"{folder}: the outputs of {condition.name} would replace those of {label}; choose "
                "another folder for the results (out, --out)"
            )


def _folder_name(condition: Condition) -> str:
    """Return the name of the folder for a condition's signals, derived from the condition's name.

    Other characters than letters, digits and ``_.+-`` become hyphens, one for each series of them.
    Hyphens and dots at both ends are removed.
    """
    return re.sub(r"[^\w.+-]+", "-", condition.name).strip(".-")


@torch.no_grad()
def _measure_look_ahead(
    condition: Condition, pair: _Pair, rate: int, microphones: Sequence[int]
) -> float | None:
    """Measure the look-ahead of a condition in ms, on the first 4 s of a scene.

    It is None for existing outputs, and for an aid whose call raises ValueError. An aid of the
    user's own that keeps a state causes a warning, see ``WaveformPlugin.try_twice``.

    Args:
        condition: Condition of the study.
        pair: The scene and the listener.
        rate: Sample rate of the scene in Hz.
        microphones: Numbers of the microphones that are used.

    Raises:
        ValueError: A file of the scene is broken, or has another rate or length.
    """
    if condition.process is None:
        return None
    signals, _ = _read_scene(pair, rate, microphones)
    scene = _input_of(condition, signals)
    scene = scene[..., : int(_LOOK_AHEAD_SECONDS * rate)]
    noise = torch.randn(scene.shape, generator=torch.Generator().manual_seed(0))
    other = set_level(noise, level_spl(scene.flatten()))
    time = scene.shape[-1]
    positions = range(time // 4, time, max(1, time // (_CHANGES + 3)))[:_CHANGES]
    try:
        if isinstance(condition.process, PluginAid):
            condition.process.plugin.try_twice(scene, pair.listener, rate)
        samples = measure_look_ahead(condition.process, pair.listener, scene, other, positions)
    except ValueError:
        return None
    return 1000.0 * samples / rate


def _input_of(condition: Condition, signals: Tensor) -> Tensor:
    """Return the input of a condition: the mean of all microphones, (2, time).

    An aid with ``takes_microphones`` gets all signals, (microphones, 2, time).

    Args:
        condition: Condition with the aid.
        signals: Signals of the microphones. Shape: (microphones, 2, time).
    """
    return signals if takes_microphones(condition.process) else signals.mean(0)


@one_thread()
@torch.no_grad()
def _write_signals(
    out: Path,
    conditions: Sequence[Condition],
    folders: Mapping[str, Path],
    microphones: Sequence[int],
    rate: int,
    pair: _Pair,
) -> dict[str, Path | ValueError]:
    """Write the reference and the outputs of a scene for a listener.

    Existing outputs are only validated.

    Args:
        out: Folder of the results.
        conditions: Conditions with their aids.
        folders: Folders of existing outputs, by the label of their aid.
        microphones: Numbers of the microphones that are used.
        rate: Sample rate in Hz.
        pair: The scene and the listener.

    Returns:
        By the name of the condition, the file with its outputs for both ears, or the ValueError
        that prevented it; the file of an earlier run is then deleted.

    Raises:
        ValueError: A file of the scene is broken, or has another rate or length; or the reference
            cannot be written.
    """
    signals, reference = _read_scene(pair, rate, microphones)
    write_audio(_reference_file(out, pair), reference, rate)
    outputs: dict[str, Path | ValueError] = {}
    for condition in conditions:
        folder = folders.get(condition.name, out / "signals" / _folder_name(condition))
        path = outputs[condition.name] = folder / pair.output_name
        try:
            if condition.process is None:
                _check_output(path, rate)
                continue
            output = condition.process(_input_of(condition, signals), pair.listener)
            write_audio(path, cut_output(output, signals[0], rate), rate)
        except Exception as error:  # A failure must not end the study.
            outputs[condition.name] = ValueError(describe_error(error))
            if condition.process is not None:
                path.unlink(missing_ok=True)  # It is the output of an earlier run.
    return outputs


def _reference_file(out: Path, pair: _Pair) -> Path:
    return out / "reference" / f"{pair.scene}.wav"


def _read_scene(pair: _Pair, rate: int, numbers: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Read the microphones' signals, and the reference at the level of the target in the room.

    Args:
        pair: Files of the scene.
        rate: Sample rate in Hz that the files must have.
        numbers: Numbers of the microphones, of which 1 is the front one.

    Returns:
        Signals for the left and the right ear, cut to the shortest file: of the microphones, with
        shape (microphones, 2, time), and of the reference, with shape (2, time).

    Raises:
        ValueError: A file is broken or has another rate, the lengths differ by more than 0.1 s, or
            a microphone has not two channels.
    """
    files = SceneFiles(pair.reference, tuple(map(pair.microphone, numbers)), references=(1, 2))
    reference, signals, scene_rate = files.read()
    if scene_rate != rate or len(signals) != len(numbers):
        raise ValueError(
            f"{pair.mix}: expected two channels for each microphone at the rate of the first "
            f"scene, {rate} Hz, got {2 * len(signals)} channels for {len(numbers)} microphones at "
            f"{scene_rate} Hz; replace the files"
        )
    return signals, reference


def _check_output(path: Path, rate: int) -> None:
    """Raise ValueError unless a file can be read, and has two channels and a sample rate in Hz."""
    waveform, file_rate = read_audio(path)
    if file_rate != rate or len(waveform) != 2:
        raise ValueError(
            f"{path}: expected 2 channels at the rate of the first scene, {rate} Hz, got "
            f"{len(waveform)} at {file_rate} Hz; replace the file"
        )
