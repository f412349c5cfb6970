"""The commands ``train-simulator`` and ``train-compensator``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import check_paths_exist, read_ear, require_installed
from hlsim.cli.options import Parser, count, folder, natural, positive
from hlsim.cli.recipes import add_recipe, read_recipe
from hlsim.extras import require
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe


def train_simulator(parser: Parser) -> None:
    """Declare the options of ``train-simulator``."""
    parser.set_command(
        _train_simulator,
        "--speech speech/train --valid-speech speech/valid --out runs/simulator",
        "--recipe examples/neuro-msbg-light.yaml --recipe.batch 4 --manifest "
        "VoiceBank/manifest.csv --out runs/light",
    )
    parser.teacher("simulator whose output the network learns", "msbg")
    _declare_common(parser)
    add_recipe(parser, SimulatorRecipe, "examples/neuro-msbg.yaml")


def train_compensator(parser: Parser) -> None:
    """Declare the options of ``train-compensator``."""
    parser.set_command(
        _train_compensator,
        "--speech speech/train --valid-speech speech/valid --audiogram N3 --out runs/n3",
        "--recipe examples/hearing-aid.yaml --start hearing-aid --speech speech --noise noise "
        "--out runs/aid",
    )
    parser.audiogram(text="; without it, one compensator for all ears is trained")
    parser.option(
        "--simulator", str, "msbg (exact), or a checkpoint's name or folder", "neuro-msbg"
    )
    _declare_common(parser)
    add_recipe(parser, CompensatorRecipe, "examples/compensator.yaml")


def _declare_common(parser: Parser) -> None:
    """Declare the options that both commands have."""
    option = parser.option
    speech = parser.add_mutually_exclusive_group(required=True)
    option("--speech", Path, "folder of clean speech", group=speech)
    text = (
        "CSV file of 'hlsim prepare', instead of --speech and --valid-speech; the noise is "
        "that of its noisy speech"
    )
    option("--manifest", Path, text, group=speech)
    option(
        "--root",
        Path,
        "folder to which the manifest's paths are relative; by default the folder of the manifest",
    )
    option("--noise", Path, "folder of noise recordings that are mixed in")
    option(
        "--audiograms",
        Path,
        "CSV file of measured ears, or standard for Bisgaard's; used in addition to random ears",
    )
    option("--valid-speech", Path, "folder of clean speech by other speakers, for validation")
    option("--valid-noise", Path, "folder of noise recordings for validation")
    option(
        "--valid-audiograms",
        Path,
        "CSV file of measured ears for validation, or standard for Bisgaard's",
    )
    text = (
        "time limit in minutes, including the time before a resumption; the learning rate "
        "does not depend on it"
    )
    option("--max-minutes", positive, text)
    option("--device", str, "device of the training", "auto", choices=("auto", "cpu", "cuda"))
    option("--devices", count, "number of GPUs or processes; each draws its own batches", 1)
    option(
        "--workers",
        natural,
        "number of processes that draw batches, in addition to the one that trains",
        0,
    )
    parser.flag("--quiet", "print one line per validation, without a progress bar")
    parser.option("--out", folder, "folder for the results", required=True)


def _train_simulator(options: argparse.Namespace) -> None:
    _check_options(options)
    recipe = read_recipe(options, SimulatorRecipe)
    require("lightning", "train")  # A broken installation is reported here.
    from hlsim.training.simulator import train_simulator

    folder = train_simulator(recipe=recipe, teacher=options.teacher, **_common_arguments(options))
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and (options.audiograms or options.valid_audiograms):
        raise ValueError(
            "--audiogram excludes --audiograms and --valid-audiograms, because it trains for one "
            "ear; leave one or the other out"
        )
    _check_options(options)
    recipe = read_recipe(options, CompensatorRecipe)
    ear = read_ear(options.audiogram) if options.audiogram else None
    require("lightning", "train")
    from hlsim.training.compensator import train_compensator

    folder = train_compensator(
        recipe=recipe, audiogram=ear, simulator=options.simulator, **_common_arguments(options)
    )
    print(f"the best checkpoint is in {folder}")


def _check_options(options: argparse.Namespace) -> None:
    """Reject options that exclude each other, and missing files, before slow imports."""
    if options.manifest is not None and options.valid_speech is not None:
        raise ValueError(
            "--manifest excludes --valid-speech, because it includes validation "
            "speech; leave one out"
        )
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


def _common_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments that both training functions have."""
    from hlsim.training.batches import TrainingData

    attributes: dict[str, Any] = {
        "noise": options.noise,
        "audiograms": options.audiograms,
        "valid_noise": options.valid_noise,
        "valid_audiograms": options.valid_audiograms,
        "workers": options.workers,
    }
    if options.manifest is not None:
        data = TrainingData.from_manifest(options.manifest, options.root, **attributes)
    else:
        data = TrainingData(options.speech, valid_speech=options.valid_speech, **attributes)
    return {
        "data": data,
        "out": options.out,
        "max_minutes": options.max_minutes,
        "accelerator": "gpu" if options.device == "cuda" else options.device,
        "devices": options.devices,
        "progress": not options.quiet,
    }
