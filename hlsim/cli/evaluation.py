"""The commands ``evaluate-simulator``, ``evaluate-compensator`` and ``haspi-report``."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.cli.inputs import check_paths_exist, other_ear_warnings, read_ear, require_installed
from hlsim.cli.options import (
    EARS_TABLE,
    Parser,
    count,
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


def evaluate_simulator(parser: Parser) -> None:
    parser.set_command(
        _evaluate_simulator,
        "neuro-msbg neuro-msbg-cnn --speech speech/valid --audiograms standard --out judged",
        "mine=runs/simulator/checkpoint --speech speech/valid --audiograms standard --out judged",
    )
    option = parser.option
    text = "checkpoints, by name or folder, or msbg (exact); LABEL=FOLDER is called LABEL in the tables"
    option("names", str, text, nargs="+", metavar="NAME")
    option("--speech", Path, "folder of clean speech", required=True)
    option("--audiograms", Path, EARS_TABLE, required=True)
    option("--noise", Path, "folder of noises; every second item is then noisy")
    parser.teacher("simulator to compare with", "msbg")
    levels = [50, 60, 65, 70, 80]
    option("--levels", number, "levels in dB SPL that items take in turn", levels, nargs="+")
    text = "input of the simulators: as-is, louder (20 dB), nal-r, compressed (3:1), compensated"
    option("--inputs", str, text, ["as-is"], nargs="+", metavar="INPUT")
    option("--compensator", str, "name or folder of the compensator of the input compensated")
    option("--items", count, "number of items", 240)
    option("--seconds", positive, "length of an item", 3.0)
    study_options(parser, listen=1)


def _evaluate_simulator(options: argparse.Namespace) -> None:
    if options.compensator and "compensated" not in options.inputs:
        raise ValueError("--compensator has no effect without --inputs compensated")
    prepare_study(options)
    require_installed("eval", "pystoi")
    check_paths_exist(folders=(options.speech, options.noise), files=(options.audiograms,))
    from compensators import load_compensator
    from hlsim.calibration import PASCAL_SPL
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.losses.frozen_simulator import build_simulator
    from hlsim.neuro.config import NEURO_RATE
    from hlsim.report.simulators import simulators_page

    named = labelled_names(options.names)
    evaluation = evaluate_simulators(
        {label: build_simulator(name, NEURO_RATE, PASCAL_SPL) for label, name in named.items()},
        speech=options.speech,
        audiograms=options.audiograms,
        store=options.out / "scores.jsonl",
        noise=options.noise,
        teacher=options.teacher,
        measures=options.measure,
        items=options.items,
        seconds=options.seconds,
        levels=options.levels,
        inputs=options.inputs,
        compensator=load_compensator(options.compensator) if options.compensator else None,
        seed=options.seed,
        jobs=options.jobs,
        dask=options.dask,
        progress=show_progress("values"),
    )
    finish(evaluation, simulators_page(evaluation, options.listen), options.out)


def evaluate_compensator(parser: Parser) -> None:
    parser.set_command(
        _evaluate_compensator,
        "hearing-aid --audiograms standard --speech speech/valid --noise noise/valid --out judged",
        "mine=runs/n3/checkpoint --audiogram N3 --speech speech/valid --items 40 --out judged",
    )
    option = parser.option
    text = "compensators, by name or folder; LABEL=FOLDER is called LABEL in the tables"
    option("names", str, text, nargs="+", metavar="NAME")
    option("--speech", Path, "folder of clean speech of speakers not trained on", required=True)
    option("--audiograms", Path, f"{EARS_TABLE}; its ears join Bisgaard's N2 to N6 and S1 to S3")
    parser.audiogram(text="; one ear in place of all, for a compensator trained for it")
    option("--noise", Path, "folder of noises; every second item is then noisy, at 2.5 to 17.5 dB")
    text = (
        "noise reduction of your own before each aid, package.module:name or "
        "path/to/file.py:name: a callable (waveform, sample_rate) -> waveform or its class, for (..., time) "
        "in pascals, time-aligned"
    )
    option("--enhancer", plugin_name, text, [], nargs="+", metavar="NAME", dest="enhancers")
    option("--simulator", str, "Neuro-MSBG of the surrogate gap, by name or folder", "neuro-msbg")
    option("--levels", number, "levels of the speech in dB SPL, in turn", [50, 65, 80], nargs="+")
    option("--items", count, "number of items", 400)
    option("--seconds", positive, "length of an item", 3.0)
    text = "standard ears of the gain curves and tones; with --audiogram that ear is used"
    option("--gain-ears", str.upper, text, GAIN_EARS, nargs="+", metavar="EAR")
    study_options(parser)


def _evaluate_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and options.gain_ears != GAIN_EARS:
        raise ValueError("--gain-ears has no effect with --audiogram; leave one of them out")
    prepare_study(options)
    check_paths_exist(folders=(options.speech, options.noise), files=(options.audiograms,))
    from compensators import load_compensator
    from hlsim.evaluation.compensators import evaluate_compensators
    from hlsim.report.compensators import compensators_page

    named = labelled_names(options.names)
    ear = read_ear(options.audiogram) if options.audiogram else None
    notes = [line for label, name in named.items() for line in other_ear_warnings(label, name, ear)]
    for line in notes:
        print(f"hlsim: warning: {line}", file=sys.stderr)
    evaluation = evaluate_compensators(
        {label: load_compensator(name) for label, name in named.items()},
        speech=options.speech,
        store=options.out / "scores.jsonl",
        audiograms=options.audiograms,
        audiogram=ear,
        noise=options.noise,
        enhancers=options.enhancers,
        simulator=options.simulator,
        measures=options.measure,
        items=options.items,
        seconds=options.seconds,
        levels=options.levels,
        gain_ears=options.gain_ears,
        notes=notes,
        seed=options.seed,
        jobs=options.jobs,
        dask=options.dask,
        progress=show_progress("values"),
    )
    finish(evaluation, compensators_page(evaluation, options.listen), options.out)


def labelled_names(texts: list[str]) -> dict[str, str]:
    """Return names by label; ValueError if two have the same label."""
    named = dict(map(labelled, texts))
    if len(named) < len(texts):
        raise ValueError(f"two of {', '.join(texts)} have the same label; write LABEL=NAME")
    return named


def labelled(text: str) -> tuple[str, str]:
    """Label and name; a folder by itself is called by its path."""
    label, sign, name = text.partition("=")
    return (text, text) if Path(text).exists() or not (sign and label) else (label, name)


def haspi_report(parser: Parser) -> None:
    parser.set_command(
        _haspi_report,
        "--clean clean --before noisy --after enhanced --audiogram N3 --out report",
        "--manifest items.csv --measures haspi,hasqi --baseline unaided --out report",
    )
    option = parser.option
    option("--clean", Path, "folder of clean speech; all folders have files of the same names")
    option(
        "--before", Path, "folder of speech before the treatment; without it nothing is compared"
    )
    option("--after", Path, "folder of speech after the treatment")
    text = (
        "CSV file in place of the folders, with the columns condition, clean, processed and, where "
        "they are known, listener, ear, item, snr, hl_250, ... or audiogram, spl or full_scale_spl"
    )
    option("--manifest", Path, text)
    option("--root", Path, "folder that the manifest's paths are relative to; by default its own")
    parser.audiogram(text="; the ear of all files, or of rows of the manifest that name none")
    text = "; and a column file (for folders) or columns listener and ear (for a manifest)"
    option("--audiograms", Path, EARS_TABLE + text)
    text = "measures separated by commas, the most important first: haspi, hasqi, haaqi, stoi, pesq"
    option("--measures", str, text, "haspi")
    option("--baseline", str, "condition to compare all others with; by default all pairs")
    parser.flag("--better-ear", "take the better ear's scores; needs a manifest with both ears")
    level = parser.add_mutually_exclusive_group()
    parser.full_scale(group=level)
    text = "level of every clean file in dB SPL, in place of --full-scale-spl"
    option("--spl", positive, text, group=level)
    option("--scores", Path, "file that scores are stored in (default: OUT/scores.jsonl)")
    study_options(parser)


def _haspi_report(options: argparse.Namespace) -> None:
    prepare_study(options)
    check_paths_exist(
        folders=(options.clean, options.before, options.after, options.root),
        files=(options.manifest, options.audiograms),
    )
    from hlsim.evaluation.recordings import haspi_report
    from hlsim.report.recordings import report_page

    evaluation = haspi_report(
        clean=options.clean,
        before=options.before,
        after=options.after,
        audiogram=read_ear(options.audiogram) if options.audiogram else None,
        audiograms=options.audiograms,
        manifest=options.manifest,
        root=options.root,
        measures=[name.strip() for name in options.measures.split(",")] + options.measure,
        baseline=options.baseline,
        better_ear=options.better_ear,
        store=options.scores or options.out / "scores.jsonl",
        full_scale_spl=options.full_scale_spl,
        spl=options.spl,
        seed=options.seed,
        jobs=options.jobs,
        dask=options.dask,
        progress=show_progress("values"),
    )
    finish(evaluation, report_page(evaluation, options.listen), options.out)


def study_options(parser: Parser, listen: int = 3) -> None:
    """Declare the options that all evaluations share."""
    text = (
        "additional measure of your own, package.module:name or path/to/file.py:name: a "
        "function (item, output) -> dict of numbers"
    )
    parser.option("--measure", plugin_name, text, [], nargs="+", metavar="NAME")
    parser.option("--listen", natural, "number of items with players on the page", listen)
    parser.jobs()
    text = "address of a Dask scheduler, such as tcp://host:8786, whose workers are used"
    parser.option("--dask", str, text, metavar="ADDRESS")
    parser.seed()
    parser.out()


def prepare_study(options: argparse.Namespace) -> None:
    """Check what an evaluation needs before it takes hours."""
    os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend may not exist in this environment
    warnings.formatwarning = lambda message, *_, **__: f"hlsim: warning: {message}\n"
    require_installed("eval", "joblib", "pandas", "matplotlib", "jinja2")
    if options.dask:
        require_installed("cluster", "distributed")


def finish(evaluation: Evaluation, page: Page, out: Path) -> None:
    """Write the page of an evaluation, and print its verdict and where it is."""
    from hlsim.report.page import write_page

    path = write_page(page, evaluation.to_dict(), out)
    tables = [table for section in page.sections for table in section.tables]
    print(f"{page.verdict}\n\n{tables[0].text()}\n\nThe page: {path}")
    failed = len(evaluation.failures)
    if failed:
        print(
            f"hlsim: {failed} of {len(evaluation.table)} outputs lack scores; the page lists the reasons",
            file=sys.stderr,
        )
