"""The commands ``prepare`` and ``draw-alignment``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hlsim.cli.options import (
    EARS_TABLE,
    Commands,
    add_command,
    audiogram_option,
    check_files,
    count,
    full_scale_option,
    integer,
    number,
    out_option,
    positive,
    read_ear,
    seed_option,
    show_progress,
)
from hlsim.data.corpora import LAYOUTS
from hlsim.data.noises import TEST_SNRS_DB, TEST_TYPES, TRAIN_SNRS_DB, TRAIN_TYPES
from hlsim.data.teacher import ALIGNMENTS, TEACHERS, Reference, check_grid
from hlsim.parallel import BACKENDS


def add(commands: Commands) -> None:
    sub = add_command(
        commands,
        "prepare",
        _prepare,
        "check a corpus and plan training instances: utterances, noise, ears, levels; with --write make them",
    )
    sub.add_argument(
        "corpus",
        type=Path,
        help="folder: VoiceBank-DEMAND's, LibriSpeech's, or any with wav, flac or ogg files",
    )
    sub.add_argument("--layout", choices=("auto", *LAYOUTS), default="auto", help="of the corpus")
    sub.add_argument(
        "--table",
        type=Path,
        help="CSV with columns file and any of id, speaker, split, noisy, noise, snr (dB)",
    )
    sub.add_argument("--noise", type=Path, help="folder of noises to mix in, a folder a type")
    sub.add_argument(
        "--root", type=Path, help="folder that holds corpus and noise; by default what they share"
    )
    sub.add_argument(
        "--train-snr", type=numbers, default=TRAIN_SNRS_DB, help="SNRs in dB by active speech level"
    )
    sub.add_argument("--test-snr", type=numbers, default=TEST_SNRS_DB, help="other ones")
    sub.add_argument("--train-types", type=count, default=TRAIN_TYPES, help="types of noise to train with")
    sub.add_argument("--test-types", type=count, default=TEST_TYPES, help="other ones to test with")
    sub.add_argument("--audiograms", type=Path, help=f"{EARS_TABLE}. Without it ears are drawn")
    sub.add_argument("--test-audiograms", type=Path, help="CSV of the ears for test")
    sub.add_argument("--ears", type=count, default=2, help="an utterance")
    sub.add_argument(
        "--severities",
        type=shares,
        help="proportions such as mild=1,moderate=1,severe=2, also none; by default equal ones of mild, moderate and "
        "severe, or as in the CSV",
    )
    sub.add_argument(
        "--level",
        type=number,
        nargs="+",
        default=[65.0],
        help="active speech level in dB SPL that ears are given; two draw one in between for each utterance and ear",
    )
    sub.add_argument("--rate", type=integer, default=16000, help="of the instances, Hz")
    sub.add_argument(
        "--test-share",
        type=number,
        default=0.1,
        help="of speakers, where the corpus has no splits of its own",
    )
    sub.add_argument("--valid-share", type=number, default=0.0, help="of the speakers to train with")
    sub.add_argument("--shortest", type=positive, default=0.5, help="seconds; shorter files are left out")
    sub.add_argument("--strict", action="store_true", help="make a fault an error")
    sub.add_argument("--write", action="store_true", help="make the instances too, 12 bytes a sample")
    sub.add_argument(
        "--teacher", choices=TEACHERS, default="msbg", help="that says what is heard, with --write"
    )
    sub.add_argument(
        "--alignment",
        choices=ALIGNMENTS[:2],
        default="structural",
        help="impulse is the paper's, with --write",
    )
    sub.add_argument("--jobs", type=count, help="processes; all cores by default")
    sub.add_argument("--backend", choices=BACKENDS, default="loky", help="this machine, or a cluster")
    sub.add_argument("--scheduler", help="of --backend dask: its address, such as tcp://host:8786")
    seed_option(sub)
    out_option(sub)

    sub = add_command(
        commands,
        "draw-alignment",
        _draw_alignment,
        "draw an utterance and what an ear hears of it, raised to the utterance's level, before and after alignment",
    )
    sub.add_argument(
        "input", type=Path, metavar="IN", help="wav, flac or ogg, 16 to 48 kHz; its first channel"
    )
    sub.add_argument("output", type=Path, metavar="OUT", help="png")
    audiogram_option(sub, default="N3")
    sub.add_argument("--alignment", choices=ALIGNMENTS[:2], default="impulse", help="impulse is the paper's")
    full_scale_option(sub)


def numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(number(part) for part in text.split(","))
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"{text}; allowed: numbers separated by commas, such as 0,2.5,5"
        ) from None


def shares(text: str) -> dict[str, float]:
    pairs = [part.partition("=") for part in text.split(",")]
    try:
        return {name.strip(): number(value) for name, _, value in pairs}
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"{text}; allowed: severities with a number each, such as mild=1,severe=2"
        ) from None


def _prepare(options: argparse.Namespace) -> None:
    from hlsim.data.plan import FAULTS, prepare
    from hlsim.data.plan_settings import PlanSettings
    from hlsim.data.writing import Recipe, write_instances

    if len(options.level) > 2:
        raise ValueError(f"--level {options.level}; allowed: one level, or lowest and highest")
    _refuse_what_has_no_use(options)
    settings = PlanSettings(
        corpus=options.corpus,
        noise=options.noise,
        root=options.root,
        layout=options.layout,
        table=options.table,
        train_snrs=options.train_snr,
        test_snrs=options.test_snr,
        train_types=options.train_types,
        test_types=options.test_types,
        audiograms=options.audiograms,
        test_audiograms=options.test_audiograms,
        ears=options.ears,
        severities=options.severities,
        level=(options.level[0], options.level[-1]),
        rate=options.rate,
        test_share=options.test_share,
        valid_share=options.valid_share,
        shortest=options.shortest,
        seed=options.seed,
    )
    if options.write:
        check_grid(options.rate)  # before hours of checking files
    where: dict[str, Any] = {"jobs": options.jobs, "backend": options.backend, "scheduler": options.scheduler}
    recipe = Recipe(options.alignment, _reference(options.teacher)) if options.write else None
    prepared = prepare(
        settings, options.out, strict=options.strict, progress=show_progress("utterances"), **where
    )
    print(prepared.to_text())
    if prepared.faults:
        print(f"{prepared.faults} faults are left out: {options.out / FAULTS}")
    if recipe is not None:
        count_made = write_instances(options.out, recipe, progress=show_progress("instances"), **where)
        print(f"{count_made} instances are in {options.out / 'instances'}")


def _refuse_what_has_no_use(options: argparse.Namespace) -> None:
    """Options that another one has to be given with. A value that is the default's equal passes: it changes nothing."""
    mixing = {
        "--train-snr": options.train_snr != TRAIN_SNRS_DB,
        "--test-snr": options.test_snr != TEST_SNRS_DB,
        "--train-types": options.train_types != TRAIN_TYPES,
        "--test-types": options.test_types != TEST_TYPES,
    }
    making = {
        "--teacher": options.teacher != TEACHERS[0],
        "--alignment": options.alignment != ALIGNMENTS[0],
    }
    for needed, there, given in (
        ("--noise", options.noise is not None, mixing),
        ("--write", options.write, making),
    ):
        if not there and any(given.values()):
            names = ", ".join(name for name, other in given.items() if other)
            raise ValueError(f"{names} without {needed}; allowed: only with it")


def _reference(teacher: str) -> Reference | None:
    if teacher == "msbg":
        return None
    from hlsim.extras import require
    from hlsim.metrics.reference import pyclarity_msbg

    require("clarity", "eval")
    return pyclarity_msbg


def _draw_alignment(options: argparse.Namespace) -> None:
    from hlsim.audio import read_audio
    from hlsim.calibration import gain_to_pascals
    from hlsim.report.alignment import draw_alignment

    check_files(options.input, options.output)
    waveform, rate = read_audio(options.input)
    signal = waveform[0] * gain_to_pascals(options.full_scale_spl)
    delay = draw_alignment(
        signal, read_ear(options.audiogram), rate, options.output, method=options.alignment
    )
    print(f"{options.output}: delay {delay:.1f} samples at {rate} Hz ({1000 * delay / rate:.2f} ms)")
