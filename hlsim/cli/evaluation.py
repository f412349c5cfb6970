"""The commands ``evaluate-simulator``, ``evaluate-compensator``, ``haspi-report``, ``clarity``."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.inputs import check_extras, parse_ear, warn_of_other_ears
from hlsim.cli.options import (
    ALL_EARS,
    EARS_TABLE,
    Parser,
    count,
    full_scale,
    input_path,
    loudness,
    positive_number,
    seed,
    sound_level,
)
from hlsim.progress import ProgressLine

if TYPE_CHECKING:
    from hlsim.evaluation.result import Evaluation
    from hlsim.report.page import Page

STORE = "scores.jsonl"
"""Name of the file of scores in the folder of the results."""

_PLAYED_ITEMS = 3
"""Number of items whose sounds a page plays; the page about simulators plays one."""

_CHECKPOINTS = "by name or folder; LABEL=FOLDER sets the name in the tables to LABEL"
"""End of the help text of arguments that name checkpoints."""


def evaluate_simulator(parser: Parser) -> None:
    """Declare the options of the command ``evaluate-simulator``."""
    parser.set_command(
        _evaluate_simulator,
        "neuro-msbg neuro-msbg-cnn --speech speech/valid --audiograms standard --out judged",
        "mine=runs/simulator/checkpoint --speech speech/valid --audiograms standard --out judged",
    )
    option = parser.option
    option("names", str, f"msbg (exact), or checkpoints {_CHECKPOINTS}", nargs="+")
    option("--audiograms", str, EARS_TABLE, required=True)
    parser.teacher("simulator to compare with")
    text = "folder of clean speech, of speakers that were not used in training"
    option("--speech", input_path, text, required=True)
    _declare_items(parser, "items", 240, [50, 60, 65, 70, 80])
    text = "input of the simulators: as-is, louder (20 dB), nalr, compressed (3:1), compensated"
    parser.series("--inputs", str, text, ["as-is"])
    option("--compensator", str, "compensator of the input compensated, by name or folder")
    _declare_study(parser)


def _evaluate_simulator(options: argparse.Namespace) -> None:
    if options.compensator and "compensated" not in options.inputs:
        raise ValueError(
            "--compensator has no effect without --inputs compensated; add that input, or leave "
            "--compensator out"
        )
    check_extras("eval")
    from compensators import load_compensator
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.report.simulators_page import simulators_page

    compensator = load_compensator(options.compensator) if options.compensator else None
    if options.compensator:
        warn_of_other_ears({options.compensator: options.compensator}, None)
    _run_study(
        options,
        evaluate_simulators,
        simulators_page,
        simulators=_read_labels(options.names),
        compensator=compensator,
        store=options.out / STORE,
    )


def evaluate_compensator(parser: Parser) -> None:
    """Declare the options of the command ``evaluate-compensator``."""
    parser.set_command(
        _evaluate_compensator,
        "hearing-aid --audiograms standard --speech speech/valid --noise noise/valid --out judged",
        "mine=runs/n3/checkpoint --audiogram N3 --speech speech/valid --items 40 --out judged",
    )
    option = parser.option
    option("names", str, f"compensators, {_CHECKPOINTS}", nargs="+")
    text = f"{EARS_TABLE}; used in addition to Bisgaard's ears N2 to N6 and S1 to S3"
    option("--audiograms", str, text)
    parser.audiogram(text="; single ear for everything, for a compensator trained for it")
    speech = parser.add_mutually_exclusive_group(required=True)
    text = "folder of clean speech, of speakers that were not used in training"
    option("--speech", input_path, text, group=speech)
    text = (
        "manifest of noisy speech, with one or several microphones, instead of --speech and "
        "--noise; its split test is used, or else valid"
    )
    option("--manifest", input_path, text, group=speech)
    text = "folder to which the manifest's paths are relative; by default the manifest's folder"
    option("--root", input_path, text)
    _declare_items(parser, "clean speech", 400, [50, 65, 80])
    parser.enhancers("time-aligned waveforms with shape (..., time) in pascals")
    option("--simulator", str, "Neuro-MSBG of the surrogate gap, by name or folder", "neuro-msbg")
    text = "standard ears of the gain curves and tones; with --audiogram that ear is used"
    parser.series("--gain-ears", str.upper, text, ["N3", "S2"])
    _declare_precision(parser)
    text = "measure thresholds for digits in noise as well, for the ears of the gain curves"
    parser.flag("--srt", text)
    text = (
        "prescription with which each compensator is compared at its level: nalr, nalrp, camfit, "
        "or for-ear, which is nalrp if the threshold at 2 kHz is above 90 dB HL, and else nalr"
    )
    option("--rival", str, text, "nalr")
    text = (
        "target of the loudness error: loudness in dB relative to a normal ear, a number or "
        "numbers by level, such as 50:0,65:-5,80:-9; the tables name it; unlike --loudness of "
        "compensate, it does not make the compensators softer"
    )
    option("--loudness", loudness, text, 0.0)
    parser.limit_to_ear("--audiograms has columns such as ucl_500")
    _declare_study(parser)


def _evaluate_compensator(options: argparse.Namespace) -> None:
    check_extras("eval")
    from compensators import load_compensator
    from hlsim.evaluation.compensators import evaluate_compensators
    from hlsim.report.compensators_page import compensators_page

    checkpoints = _read_labels(options.names)
    ear: Any = parse_ear(options)
    notes = warn_of_other_ears(checkpoints, ear)
    if options.limit_to_ear:
        levels = ", ".join(f"{level:g} dB HL at {hz:g} Hz" for hz, level in ear.ucl) if ear else ""
        text = (
            "The compensators are limited to the ear (--limit-to-ear), at uncomfortable levels of "
            f"{levels or 'the file of ears, or predicted ones'}. The prescriptions with which "
            "they are compared, such as WDRC, are not."
        )
        notes = [*notes, text]
    _run_study(
        options,
        evaluate_compensators,
        compensators_page,
        notes=notes,
        compensators={
            label: load_compensator(name, limit_to_ear=options.limit_to_ear)
            for label, name in checkpoints.items()
        },
        audiogram=ear,
        store=options.out / STORE,
    )


def haspi_report(parser: Parser) -> None:
    """Declare the options of the command ``haspi-report``."""
    parser.set_command(
        _haspi_report,
        "--clean clean --before noisy --after enhanced --audiogram N3 --out report",
        "--clean clean --condition noisy=noisy --condition A=outputs-a --audiograms ears.csv "
        "--baseline noisy --out report",
    )
    option = parser.option
    text = "folder of clean speech; all folders have files with the same names"
    option("--clean", input_path, text)
    text = "folder of speech before the treatment; without it, nothing is compared"
    option("--before", input_path, text)
    option("--after", input_path, "folder of speech after the treatment")
    text = (
        "condition NAME=FOLDER instead of --before and --after, a folder of the outputs of a "
        "system; repeat the option for several systems"
    )
    option("--condition", _named_folder, text, [], action="append", dest="conditions")
    text = (
        "CSV file instead of the folders, with columns condition, clean, processed and, if they "
        "are known, listener, ear, item, snr, and hl_250, ... or audiogram"
    )
    option("--manifest", input_path, text)
    text = "folder to which the manifest's paths are relative; by default the manifest's folder"
    option("--root", input_path, text)
    text = "; the ear of all files, or of rows of the manifest without an ear"
    parser.audiogram(ears=ALL_EARS, text=text)
    text = (
        "CSV file of ears with columns hl_250, ...: with folders, every file is scored for each of "
        "them; with a manifest, they are its listeners', with the columns listener and ear, too"
    )
    option("--audiograms", input_path, text)
    text = "measures, the most important first: haspi, hasqi, haaqi, stoi, pesq"
    parser.series("--measures", str, text, ["haspi"])
    _declare_precision(parser)
    option("--baseline", str, "condition to compare all others with; by default all pairs")
    text = "use the better ear's scores; needs a manifest or a table of ears with both ears"
    parser.flag("--better-ear", text)
    parser.levels("every clean file")
    _declare_study(parser)


def _haspi_report(options: argparse.Namespace) -> None:
    check_extras("eval")
    from hlsim.evaluation.recordings import haspi_report
    from hlsim.report.recordings_page import report_page

    _run_study(
        options,
        haspi_report,
        report_page,
        audiogram=parse_ear(options),
        conditions=_by_name(options.conditions, "--condition") or None,
        store=options.out / STORE,
    )


def clarity(parser: Parser) -> None:
    """Declare the options of the command ``clarity``."""
    parser.set_command(
        _clarity,
        "dev/scenes hearing-aid --listeners listeners.json --scenes-listeners pairs.json --out out",
        "dev/scenes mine=my_package.aids:pair --listeners listeners.json --every 15 --out judged",
    )
    option = parser.option
    text = (
        "folder with SCENE_mix_CH1.wav, SCENE_target_anechoic_CH1.wav (or SCENE_reference.wav) and "
        "SCENE_target_CH1.wav"
    )
    option("scenes", input_path, text)
    text = (
        f"compensators {_CHECKPOINTS}; or aids of your own as package.module:name or "
        "path/to/file.py:name, a callable (waveform, listener, sample_rate) -> waveform or its "
        "class, for (2, time) at the files' scale"
    )
    names = parser.add_argument("names", help=text, nargs="+", default=[])
    names.required = False  # with nargs="*", argparse would not find names behind other options
    text = (
        "existing outputs of an aid as LABEL=FOLDER, in files SCENE_LISTENER_HA-output.wav with "
        "two channels; repeat the option for several aids"
    )
    option("--outputs", _named_folder, text, [], action="append")
    text = "Clarity's listeners.json, or a CSV file with the columns listener, ear, hl_250, ..."
    option("--listeners", input_path, text, required=True)
    text = "JSON file with each scene's listeners; by default every listener in every scene"
    option("--scenes-listeners", input_path, text)
    text = (
        "numbers of the microphones whose mean is the input of the aids: 1 is the front one; "
        "the baseline of the third challenge uses 1 2 3"
    )
    parser.series("--microphones", count, text, [1])
    text = "use every N-th pair of scene and listener"
    option("--every", count, text, 1, dest="stride")
    _declare_precision(parser)
    parser.enhancers("time-aligned waveforms with shape (..., time) in pascals")
    parser.linked("")
    text = "level in dB SPL of a file whose RMS is 1.0"
    option("--full-scale-spl", full_scale, text, 100.0)
    _declare_study(parser)


def _clarity(options: argparse.Namespace) -> None:
    if not options.names and not options.outputs:
        raise ValueError("expected the name of an aid, or --outputs; add one")
    check_extras("eval")
    from hlsim.evaluation.clarity import evaluate_scenes
    from hlsim.report.recordings_page import scenes_page

    aids = _read_labels(options.names)
    checkpoints = {
        label: name for label, name in aids.items() if ":" not in name or Path(name).exists()
    }
    _run_study(
        options,
        evaluate_scenes,
        scenes_page,
        notes=warn_of_other_ears(checkpoints, None),
        aids=aids,
        outputs=_by_name(options.outputs, "--outputs"),
        out=options.out,
    )


def _read_labels(texts: Sequence[str]) -> dict[str, str]:
    """Parse texts NAME or LABEL=NAME, and return the names or folders by their label in tables.

    Without LABEL, the name is the label. The path of an existing file or folder that contains
    ``=``, such as ``runs/lr=0.1``, is a name.

    Raises:
        ValueError: Two names have the same label.
    """
    labels: dict[str, str] = {}
    for text in texts:
        label, _, name = (text, "", "") if Path(text).exists() else text.partition("=")
        if label in labels:
            raise ValueError(
                f"two of the names have the same label, {label}; write one of them as LABEL=NAME "
                "with another label"
            )
        labels[label] = name or label
    return labels


def _named_folder(text: str) -> tuple[str, Path]:
    """Convert the text NAME=FOLDER to the name and the folder.

    Raises:
        argparse.ArgumentTypeError: The text has another form, or the folder does not exist.
    """
    name, _, folder = text.partition("=")
    if not name or not folder:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected NAME=FOLDER")
    return name, input_path(folder)


def _by_name(named_folders: Sequence[tuple[str, Path]], option: str) -> dict[str, Path]:
    """Return a dict of named folders.

    Args:
        named_folders: Name and folder of each.
        option: Name of the option that they come from, for the message.

    Raises:
        ValueError: Two folders have the same name.
    """
    folders = dict(named_folders)
    if len(folders) < len(named_folders):
        raise ValueError(f"two of {option} have the same name; rename one")
    return folders


def _declare_items(parser: Parser, levelled: str, items: int, levels: list[int]) -> None:
    """Declare the options of items that are drawn from recordings, except for the speech.

    Args:
        parser: Parser of the command.
        levelled: Plural noun for the signals with the levels, for the help text.
        items: Default number of items.
        levels: Default levels in dB SPL.
    """
    option = parser.option
    text = "folder of noises; every second item is then noisy, at 2.5 to 17.5 dB"
    option("--noise", input_path, text)
    parser.series("--levels", sound_level, f"levels of the {levelled} in dB SPL, in turn", levels)
    option("--items", count, "number of items", items)
    option("--seconds", positive_number, "length of an item in seconds", 3.0)


def _declare_precision(parser: Parser) -> None:
    """Declare ``--precision``, the number of bits for HASPI, HASQI and HAAQI."""
    text = (
        "bits of the numbers with which HASPI, HASQI and HAAQI are computed, 32 or 64; with 64 "
        "they are those of pyclarity, in twice the time"
    )
    parser.option("--precision", int, text, 32, choices=[32, 64])


def _declare_study(parser: Parser) -> None:
    """Declare the options that all evaluations share."""
    text = (
        "additional measure of your own, package.module:name or path/to/file.py:name: a "
        "function (item, output) -> dict of numbers"
    )
    parser.option("--measure", str, text, [], nargs="+", dest="own_measures")
    parser.option("--jobs", count, "number of processes; all cores by default")
    text = "address of a Dask scheduler, such as tcp://host:8786, whose workers are used"
    parser.option("--dask", str, text)
    parser.option("--seed", seed, "seed of every random draw", 0)
    parser.option("--out", Path, "folder for the results", required=True)


def _run_study(
    options: argparse.Namespace,
    evaluate: Callable[..., Evaluation],
    make_page: Callable[[Evaluation], Page],
    *,
    notes: Sequence[str] = (),
    **changes: Any,
) -> None:
    """Run an evaluation, write its page, and print its verdict and its first table.

    The page also has the warnings of the evaluation, once each.

    The notes of the evaluation are printed to stderr, and if scores are missing, the number of
    outputs without them and the first reason.

    Args:
        options: Options of the command. Each becomes an argument of ``evaluate`` under its name,
            except ``run``, ``names``, ``out``, ``limit_to_ear`` and ``ucl``; measures of
            ``--measure`` are appended to ``measures``.
        evaluate: Function that runs the study and returns its evaluation.
        make_page: Function from the evaluation to its page.
        notes: Sentences for the page, before those of the evaluation.
        changes: Arguments of ``evaluate`` that replace options or are added to them.
    """
    from hlsim.files import check_output_folder
    from hlsim.report.writing import write_results

    check_output_folder(options.out)
    settings = {**vars(options), "listen": _PLAYED_ITEMS}
    settings["measures"] = [*settings.get("measures", []), *settings.pop("own_measures")]
    used_before = {"run", "names", "out", "limit_to_ear", "ucl"}
    arguments = {name: settings[name] for name in settings.keys() - used_before}
    with ProgressLine("scores", "reading the recordings", "drawing the page") as progress:
        with _collect_warnings() as texts:
            evaluation = evaluate(**{**arguments, **changes}, progress=progress)
        notes = [*notes, *dict.fromkeys(texts)]
        evaluation = replace(evaluation, notes=[*notes, *evaluation.notes])
        page = make_page(evaluation)
        path = write_results(page, evaluation, options.out)
    for note in evaluation.notes[len(notes) :]:  # The others have been printed.
        print(f"hlsim: {note}", file=sys.stderr)
    tables = [table for section in page.sections for table in section.tables]
    print(f"{page.verdict}\n\n{tables[0].text()}\n\nThe page: {path.as_uri()}")
    failed = len(evaluation.failures)
    if failed:
        first = evaluation.failures.iloc[0]
        text = (
            f"{failed} of {len(evaluation.table)} outputs (one per item and condition) lack scores "
            "(one per output and measure); the page lists the reasons, of which the first is: "
            f"{first.failure}"
        )
        print(f"hlsim: {text}", file=sys.stderr)


@contextmanager
def _collect_warnings() -> Iterator[list[str]]:
    """Yield a list that gets the text of each warning that is shown within the ``with`` block."""
    texts = []
    show = warnings.showwarning

    def show_and_collect(message: Warning | str, *place: Any) -> None:
        texts.append(str(message))
        show(message, *place)

    with warnings.catch_warnings():
        warnings.showwarning = show_and_collect  # type: ignore[assignment]
        yield texts
