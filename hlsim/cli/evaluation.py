"""The commands ``evaluate-simulator``, ``evaluate-compensator``, ``haspi-report``, ``clarity``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.inputs import check_paths_exist, other_ear_warnings, read_ear, require_installed
from hlsim.cli.options import (
    EARS_TABLE,
    Parser,
    count,
    folder,
    integer,
    natural,
    number,
    plugin_name,
    positive,
)
from hlsim.cli.progress import show_progress

if TYPE_CHECKING:
    from hlsim.evaluation.result import Evaluation
    from hlsim.report.page import Page

GAIN_EARS = ["N3", "S2"]

NAMES = "by name or folder; LABEL=FOLDER sets the name in the tables to LABEL"


def evaluate_simulator(parser: Parser) -> None:
    """Declare the options of ``evaluate-simulator``."""
    parser.set_command(
        _evaluate_simulator,
        "neuro-msbg neuro-msbg-cnn --speech speech/valid --audiograms standard --out judged",
        "mine=runs/simulator/checkpoint --speech speech/valid --audiograms standard --out judged",
    )
    option = parser.option
    text = f"msbg (exact), or checkpoints {NAMES}"
    option("names", str, text, nargs="+", metavar="NAME")
    option("--audiograms", Path, EARS_TABLE, required=True)
    parser.teacher("simulator to compare with", "msbg")
    _declare_items(parser, "items", 240, [50, 60, 65, 70, 80])
    text = "input of the simulators: as-is, louder (20 dB), nal-r, compressed (3:1), compensated"
    option("--inputs", str, text, ["as-is"], nargs="+", metavar="INPUT")
    option("--compensator", str, "compensator of the input compensated, by name or folder")
    _declare_study(parser, listen=1)


def _evaluate_simulator(options: argparse.Namespace) -> None:
    if options.compensator and "compensated" not in options.inputs:
        raise ValueError("--compensator has no effect without --inputs compensated")
    _check_installed(options)
    require_installed("eval", "pystoi")
    check_paths_exist(folders=(options.speech, options.noise), files=(options.audiograms,))
    from compensators import load_compensator
    from hlsim.calibration import PASCAL_SPL
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.losses.frozen_simulator import build_simulator
    from hlsim.neuro.config import NEURO_RATE
    from hlsim.report.simulators import simulators_page

    labels = read_labels(options.names)
    evaluation = evaluate_simulators(
        {label: build_simulator(name, NEURO_RATE, PASCAL_SPL) for label, name in labels.items()},
        teacher=options.teacher,
        inputs=options.inputs,
        compensator=load_compensator(options.compensator) if options.compensator else None,
        store=options.out / "scores.jsonl",
        **_item_arguments(options),
        **_study_arguments(options),
    )
    _finish(evaluation, simulators_page(evaluation, options.listen), options)


def evaluate_compensator(parser: Parser) -> None:
    """Declare the options of ``evaluate-compensator``."""
    parser.set_command(
        _evaluate_compensator,
        "hearing-aid --audiograms standard --speech speech/valid --noise noise/valid --out judged",
        "mine=runs/n3/checkpoint --audiogram N3 --speech speech/valid --items 40 --out judged",
    )
    option = parser.option
    option("names", str, f"compensators, {NAMES}", nargs="+", metavar="NAME")
    text = f"{EARS_TABLE}; used in addition to Bisgaard's ears N2 to N6 and S1 to S3"
    option("--audiograms", Path, text)
    parser.audiogram(text="; single ear for everything, for a compensator trained for it")
    _declare_items(parser, "clean speech", 400, [50, 65, 80])
    parser.enhancers("time-aligned waveforms with shape (..., time) in pascals")
    option("--simulator", str, "Neuro-MSBG of the surrogate gap, by name or folder", "neuro-msbg")
    text = "standard ears of the gain curves and tones; with --audiogram that ear is used"
    option("--gain-ears", str.upper, text, GAIN_EARS, nargs="+", metavar="EAR")
    _declare_study(parser)


def _evaluate_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and options.gain_ears != GAIN_EARS:
        raise ValueError("--gain-ears has no effect with --audiogram; leave one of them out")
    _check_installed(options)
    check_paths_exist(folders=(options.speech, options.noise), files=(options.audiograms,))
    from compensators import load_compensator
    from hlsim.evaluation.compensators import evaluate_compensators
    from hlsim.report.compensators import compensators_page

    labels = read_labels(options.names)
    ear = read_ear(options.audiogram) if options.audiogram else None
    notes: list[str] = []
    for label, name in labels.items():
        notes += other_ear_warnings(label, name, ear)
    for line in notes:
        print(f"hlsim: warning: {line}", file=sys.stderr)
    evaluation = evaluate_compensators(
        {label: load_compensator(name) for label, name in labels.items()},
        audiogram=ear,
        enhancers=options.enhancers,
        simulator=options.simulator,
        gain_ears=options.gain_ears,
        store=options.out / "scores.jsonl",
        **_item_arguments(options),
        **_study_arguments(options),
    )
    evaluation = replace(evaluation, notes=notes)
    _finish(evaluation, compensators_page(evaluation, options.listen), options)


def haspi_report(parser: Parser) -> None:
    """Declare the options of ``haspi-report``."""
    parser.set_command(
        _haspi_report,
        "--clean clean --before noisy --after enhanced --audiogram N3 --out report",
        "--manifest items.csv --measures haspi,hasqi --baseline unaided --out report",
    )
    option = parser.option
    option("--clean", Path, "folder of clean speech; all folders have files with the same names")
    text = "folder of speech before the treatment; without it, nothing is compared"
    option("--before", Path, text)
    option("--after", Path, "folder of speech after the treatment")
    text = (
        "CSV file instead of the folders, with columns condition, clean, processed and, if they "
        "are known, listener, ear, item, snr, and hl_250, ... or audiogram"
    )
    option("--manifest", Path, text)
    text = "folder to which the manifest's paths are relative; by default the manifest's folder"
    option("--root", Path, text)
    parser.audiogram(text="; the ear of all files, or of rows of the manifest without an ear")
    text = "; also with a column file (for folders) or columns listener and ear (for a manifest)"
    option("--audiograms", Path, EARS_TABLE + text)
    text = "measures separated by commas, the most important first: haspi, hasqi, haaqi, stoi, pesq"
    option("--measures", str, text, "haspi")
    option("--baseline", str, "condition to compare all others with; by default all pairs")
    parser.flag("--better-ear", "use the better ear's scores; needs a manifest with both ears")
    parser.levels("every clean file")
    _declare_study(parser)


def _haspi_report(options: argparse.Namespace) -> None:
    _check_installed(options)
    check_paths_exist(
        folders=(options.clean, options.before, options.after, options.root),
        files=(options.manifest, options.audiograms),
    )
    from hlsim.evaluation.recordings import haspi_report
    from hlsim.report.recordings import report_page

    arguments = _study_arguments(options)
    named_measures = [name.strip() for name in options.measures.split(",")]
    evaluation = haspi_report(
        options.clean,
        options.before,
        options.after,
        read_ear(options.audiogram) if options.audiogram else None,
        audiograms=options.audiograms,
        manifest=options.manifest,
        root=options.root,
        measures=named_measures + arguments.pop("measures"),
        baseline=options.baseline,
        better_ear=options.better_ear,
        store=options.out / "scores.jsonl",
        full_scale_spl=options.full_scale_spl,
        spl=options.spl,
        **arguments,
    )
    _finish(evaluation, report_page(evaluation, options.listen), options)


def clarity(parser: Parser) -> None:
    """Declare the options of ``clarity``."""
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
    option("scenes", Path, text, metavar="SCENES")
    text = (
        f"compensators {NAMES}; or aids of your own as package.module:name or "
        "path/to/file.py:name, a callable (waveform, listener, sample_rate) -> waveform or its "
        "class, for (2, time) at the files' scale"
    )
    option("names", str, text, nargs="+", metavar="NAME")
    text = "Clarity's listeners.json, or a CSV file with the columns listener, ear, hl_250, ..."
    option("--listeners", Path, text, required=True)
    text = "JSON file with each scene's listeners; by default every listener in every scene"
    option("--scenes-listeners", Path, text)
    text = "use every N-th pair of scene and listener"
    option("--every", count, text, 1, dest="stride")
    parser.enhancers("waveforms with shape (2, time) in pascals")
    parser.linked("")
    option("--full-scale-spl", number, "level in dB SPL of a file whose RMS is 1.0", 100.0)
    _declare_study(parser)


def _clarity(options: argparse.Namespace) -> None:
    _check_installed(options)
    paths = (options.listeners, options.scenes_listeners)
    check_paths_exist(folders=(options.scenes,), files=paths)
    from hlsim.evaluation.clarity import evaluate_scenes
    from hlsim.report.clarity import scenes_page, write_scores

    evaluation = evaluate_scenes(
        read_labels(options.names),
        scenes=options.scenes,
        listeners=options.listeners,
        out=options.out,
        scenes_listeners=options.scenes_listeners,
        stride=options.stride,
        enhancers=options.enhancers,
        linked=options.linked,
        full_scale_spl=options.full_scale_spl,
        **_study_arguments(options),
    )
    write_scores(evaluation, options.out)
    _finish(evaluation, scenes_page(evaluation, options.listen), options)


def read_labels(texts: Sequence[str]) -> dict[str, str]:
    """Return names by their label. A folder without a label is named by its path.

    Raises:
        ValueError: Two names have the same label.
    """
    labels: dict[str, str] = {}
    for text in texts:
        label, sign, name = text.partition("=")
        if Path(text).exists() or not (sign and label):
            label, name = text, text
        if label in labels:
            raise ValueError(f"two names have the label {label}; write LABEL=NAME")
        labels[label] = name
    return labels


def _declare_items(parser: Parser, levelled: str, items: int, levels: list[int]) -> None:
    """Declare the options of drawn items.

    Args:
        parser: Parser of the command.
        levelled: Plural noun for the signals with the levels.
        items: Default number of items.
        levels: Default levels.
    """
    option = parser.option
    text = "folder of clean speech, of speakers that were not used in training"
    option("--speech", Path, text, required=True)
    text = "folder of noises; every second item is then noisy, at 2.5 to 17.5 dB"
    option("--noise", Path, text)
    option("--levels", number, f"levels of the {levelled} in dB SPL, in turn", levels, nargs="+")
    option("--items", count, "number of items", items)
    option("--seconds", positive, "length of an item in seconds", 3.0)


def _item_arguments(options: argparse.Namespace) -> dict[str, Any]:
    names = ("speech", "noise", "audiograms", "levels", "items", "seconds")
    return {name: getattr(options, name) for name in names}


def _declare_study(parser: Parser, listen: int = 3) -> None:
    """Declare the options that all evaluations share."""
    text = (
        "additional measure of your own, package.module:name or path/to/file.py:name: a "
        "function (item, output) -> dict of numbers"
    )
    parser.option("--measure", plugin_name, text, [], nargs="+", metavar="NAME")
    parser.option("--listen", natural, "number of items with players on the page", listen)
    parser.flag("--print", "print all tables of the page instead of the first")
    parser.option("--jobs", count, "number of processes; all cores by default")
    text = "address of a Dask scheduler, such as tcp://host:8786, whose workers are used"
    parser.option("--dask", str, text, metavar="ADDRESS")
    parser.option("--seed", integer, "seed of every random draw", 0)
    parser.option("--out", folder, "folder for the results", required=True)


def _study_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments that all functions of evaluations share."""
    return {
        "measures": options.measure,
        "seed": options.seed,
        "jobs": options.jobs,
        "dask": options.dask,
        "progress": show_progress("values"),
    }


def _check_installed(options: argparse.Namespace) -> None:
    """Raise MissingExtraError for missing packages before an evaluation takes hours."""
    require_installed("eval", "joblib", "pandas", "matplotlib", "jinja2")
    if options.dask:
        require_installed("cluster", "distributed")


def _finish(evaluation: Evaluation, page: Page, options: argparse.Namespace) -> None:
    """Write the page of an evaluation, and print its verdict and its first table or all text."""
    from hlsim.report.page import write_page

    path = write_page(page, evaluation.to_dict(), options.out)
    tables = [table for section in page.sections for table in section.tables]
    text = page.markdown() if options.print else f"{page.verdict}\n\n{tables[0].text()}\n"
    print(f"{text}\nThe page: {path.as_uri()}")
    failed = len(evaluation.failures)
    if failed:
        text = (
            f"{failed} of {len(evaluation.table)} outputs lack scores; the page lists the reasons"
        )
        print(f"hlsim: {text}", file=sys.stderr)
