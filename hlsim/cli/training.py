"""The commands ``train-simulator`` and ``train-compensator``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import check_paths_exist, read_ear, require_installed
from hlsim.cli.options import Parser, count, natural, positive
from hlsim.cli.recipes import add_recipe, read_recipe
from hlsim.extras import require
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe


def train_simulator(parser: Parser) -> None:
    parser.runs(
        _train_simulator,
        "--speech speech/train --valid-speech speech/valid --out runs/simulator",
        "--recipe examples/neuro-msbg-light.yaml --recipe.batch 4 --manifest VoiceBank/manifest.csv --out runs/light",
    )
    parser.teacher("simulator whose output is learned", "msbg")
    _training_options(parser)
    add_recipe(parser, SimulatorRecipe, "examples/neuro-msbg.yaml")


def train_compensator(parser: Parser) -> None:
    parser.runs(
        _train_compensator,
        "--speech speech/train --valid-speech speech/valid --audiogram N3 --out runs/n3",
        "--recipe examples/hearing-aid.yaml --start hearing-aid --speech speech --noise noise --out runs/aid",
    )
    parser.audiogram(text="; without it one compensator for all ears is trained")
    parser.option(
        "--simulator", str, "msbg (exact), or a checkpoint's name or folder", "neuro-msbg"
    )
    _training_options(parser)
    add_recipe(parser, CompensatorRecipe, "examples/compensator.yaml")


def _training_options(parser: Parser) -> None:
    option = parser.option
    speech = parser.add_mutually_exclusive_group(required=True)
    option("--speech", Path, "folder of clean speech to train on", group=speech)
    text = "CSV file of 'hlsim prepare', instead of --speech and --valid-speech; its noisy speech gives the noise"
    option("--manifest", Path, text, group=speech)
    option("--root", Path, "folder that the manifest's paths are relative to; its own by default")
    option("--noise", Path, "folder of noises to mix in")
    option(
        "--audiograms",
        Path,
        "CSV file of measured ears to join the drawn ones, or standard for Bisgaard's",
    )
    option("--valid-speech", Path, "folder of other speakers to validate on")
    option("--valid-noise", Path, "folder of noises to validate with")
    option("--valid-audiograms", Path, "CSV file of ears to validate with, or standard")
    text = "minutes after which to stop, those before a resumption included; the learning rate does not depend on them"
    option("--max-minutes", positive, text)
    option("--device", str, "where to train", "auto", choices=("auto", "cpu", "cuda"))
    option("--devices", count, "number of GPUs or processes; each draws batches of its own", 1)
    option("--workers", natural, "processes that draw batches, beside the one that trains", 0)
    parser.flag("--quiet", "no progress bar, only a line per validation")
    parser.out()


def _train_simulator(options: argparse.Namespace) -> None:
    _check(options)
    recipe = read_recipe(options, SimulatorRecipe)
    require("lightning", "train")  # if it is broken, this says so
    from hlsim.training.simulator import train_simulator

    folder = train_simulator(recipe=recipe, teacher=options.teacher, **_arguments(options))
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and (options.audiograms or options.valid_audiograms):
        raise ValueError(
            "--audiogram trains for one ear; leave out either it or --audiograms and --valid-audiograms"
        )
    _check(options)
    recipe = read_recipe(options, CompensatorRecipe)
    ear = read_ear(options.audiogram) if options.audiogram else None
    require("lightning", "train")
    from hlsim.training.compensator import train_compensator

    folder = train_compensator(
        recipe=recipe, audiogram=ear, simulator=options.simulator, **_arguments(options)
    )
    print(f"the best checkpoint is in {folder}")


def _check(options: argparse.Namespace) -> None:
    """Reject options that exclude each other and files that do not exist, before slow imports."""
    if options.manifest is not None and options.valid_speech is not None:
        raise ValueError("--manifest has its own validation speech; leave out --valid-speech")
    if options.manifest is None and options.root is not None:
        raise ValueError("--root has no effect without --manifest; leave it out")
    require_installed("train", "lightning", "tensorboard")
    check_paths_exist(
        folders=(
            options.speech,
            options.noise,
            options.valid_speech,
            options.valid_noise,
            options.root,
        ),
        files=(options.recipe, options.manifest, options.audiograms, options.valid_audiograms),
    )


def _arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments that ``train_simulator`` and ``train_compensator`` have in common."""
    from hlsim.training.batches import TrainingData

    more: dict[str, Any] = {
        "noise": options.noise,
        "audiograms": options.audiograms,
        "valid_noise": options.valid_noise,
        "valid_audiograms": options.valid_audiograms,
        "workers": options.workers,
    }
    if options.manifest is not None:
        data = TrainingData.from_manifest(options.manifest, options.root, **more)
    else:
        data = TrainingData(options.speech, valid_speech=options.valid_speech, **more)
    return {
        "data": data,
        "out": options.out,
        "max_minutes": options.max_minutes,
        "accelerator": "gpu" if options.device == "cuda" else options.device,
        "devices": options.devices,
        "progress": not options.quiet,
    }
