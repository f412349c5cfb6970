"""The command ``prepare``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import check_there, need
from hlsim.cli.options import (
    EARS_TABLE,
    Parser,
    count,
    integer,
    number,
    numbers,
    positive,
    shares,
)
from hlsim.cli.progress import show_progress

ALIGNMENTS = ("structural", "impulse")

# what has a use only with another option: their defaults
MIXING: dict[str, Any] = {
    "train_snr": (0.0, 5.0, 10.0, 15.0),
    "test_snr": (2.5, 7.5, 12.5, 17.5),
    "train_types": 8,
    "test_types": 2,
}
MAKING: dict[str, Any] = {"teacher": "msbg", "alignment": "structural"}


def prepare(parser: Parser) -> None:
    parser.runs(
        _prepare,
        "VoiceBank-DEMAND --out plan",
        "speech --noise noise --ears 1 --write --out plan",
    )
    option = parser.option
    option(
        "corpus",
        Path,
        "folder: VoiceBank-DEMAND's, LibriSpeech's, or any with wav, flac or ogg files",
    )
    layouts = ("auto", "voicebank-demand", "librispeech", "folder")
    option("--layout", str, "of the corpus", "auto", choices=layouts)
    option(
        "--table",
        Path,
        "CSV with columns file and any of id, speaker, split, noisy, noise, snr (dB)",
    )
    option("--noise", Path, "folder of noises to mix in, a folder a type")
    option("--root", Path, "folder that holds corpus and noise; by default what they share")
    option("--train-snr", numbers, "SNRs in dB by active speech level", MIXING["train_snr"])
    option("--test-snr", numbers, "other ones", MIXING["test_snr"])
    option("--train-types", count, "types of noise to train with", MIXING["train_types"])
    option("--test-types", count, "other ones to test with", MIXING["test_types"])
    option("--audiograms", Path, f"{EARS_TABLE}. Without it ears are drawn")
    option("--test-audiograms", Path, "CSV of the ears for test")
    option("--ears", count, "an utterance", 2)
    text = (
        "proportions such as mild=1,moderate=1,severe=2, also none; by default equal ones of mild, moderate and severe, "
        "or as in the CSV"
    )
    option("--severities", shares, text)
    text = "active speech level in dB SPL that ears are given; two draw one in between for each utterance and ear"
    option("--level", number, text, [65.0], nargs="+")
    option("--rate", integer, "of the instances, Hz", 16000)
    option("--test-share", number, "of speakers, where the corpus has no splits of its own", 0.1)
    option("--valid-share", number, "of the speakers to train with", 0.0)
    option("--shortest", positive, "seconds; shorter files are left out", 0.5)
    parser.flag("--strict", "make a fault an error")
    parser.flag("--write", "make the instances too, 12 bytes a sample")
    parser.teacher("that says what is heard, with --write", MAKING["teacher"])
    text = "impulse is the paper's, with --write"
    option("--alignment", str, text, MAKING["alignment"], choices=ALIGNMENTS)
    parser.parallel()
    parser.seed()
    parser.out()


def _prepare(options: argparse.Namespace) -> None:
    if len(options.level) > 2:
        raise ValueError(f"--level {options.level}; allowed: one level, or lowest and highest")
    _refuse_without(options, "--noise", options.noise, MIXING)
    _refuse_without(options, "--write", options.write, MAKING)
    check_there(
        folders=(options.corpus, options.noise, options.root),
        files=(options.table, options.audiograms, options.test_audiograms),
    )
    from hlsim.data.plan import FAULTS, prepare
    from hlsim.data.plan_settings import PlanSettings
    from hlsim.data.teacher import check_grid, find_teacher
    from hlsim.data.writing import Recipe, write_instances

    settings = PlanSettings(
        corpus=options.corpus,
        layout=options.layout,
        table=options.table,
        noise=options.noise,
        root=options.root,
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
    if options.teacher == "pyclarity":
        need("pyclarity", "clarity")
    if options.write:
        check_grid(options.rate)  # before hours of checking files
    recipe = Recipe(options.alignment, find_teacher(options.teacher)) if options.write else None
    where = {
        "jobs": options.jobs,
        "backend": options.backend,
        "scheduler": options.scheduler,
    }
    prepared = prepare(
        settings,
        options.out,
        strict=options.strict,
        progress=show_progress("utterances"),
        **where,
    )
    print(prepared.to_text())
    if prepared.faults:
        print(f"{prepared.faults} faults are left out: {options.out / FAULTS}")
    if recipe is not None:
        count_made = write_instances(
            options.out, recipe, progress=show_progress("instances"), **where
        )
        print(f"{count_made} instances are in {options.out / 'instances'}")


def _refuse_without(
    options: argparse.Namespace, needed: str, there: object, defaults: dict[str, Any]
) -> None:
    """Options that another one has to be given with. A value that is the default's equal passes: it changes nothing."""
    given = [
        f"--{name.replace('_', '-')}"
        for name, default in defaults.items()
        if getattr(options, name) != default
    ]
    if given and not there:
        raise ValueError(f"{', '.join(given)} without {needed}; allowed: only with it")
