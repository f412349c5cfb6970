"""The commands ``train-simulator`` and ``train-compensator``."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import check_there, need, read_ear, read_recipe
from hlsim.cli.options import Parser, count, natural, positive
from hlsim.extras import require

FOLDERS = ("speech", "noise", "audiograms", "valid_speech", "valid_noise", "valid_audiograms")


def train_simulator(parser: Parser) -> None:
    parser.runs(
        _train_simulator,
        "--config examples/neuro-msbg.yaml --speech speech/train --valid-speech speech/valid --out runs/simulator",
        "--config examples/neuro-msbg.yaml --manifest plan/manifest.csv --out runs/simulator",
    )
    parser.option("--config", Path, "recipe, a YAML file (examples/neuro-msbg.yaml)", required=True)
    text = "manifest.csv that 'hlsim prepare' wrote, instead of folders and files"
    parser.option("--manifest", Path, text)
    parser.option("--root", Path, "folder of the manifest's paths, if not where it was prepared")
    parser.flag("--prepared", "train on what 'hlsim prepare --write' wrote")
    parser.teacher("that says what is heard", "msbg")
    parser.option("--workers", natural, "processes that read the manifest's files; 1 by default")
    _training_options(parser)


def train_compensator(parser: Parser) -> None:
    parser.runs(
        _train_compensator,
        "--speech speech/train --valid-speech speech/valid --audiogram N3 --out runs/n3",
        "--config examples/hearing-aid.yaml --start hearing-aid --speech speech --noise noise --out runs/aid",
    )
    parser.option("--config", Path, "recipe, a YAML file (examples/compensator.yaml)")
    parser.audiogram(text="; without it one compensator for all ears is trained")
    parser.option(
        "--simulator", str, "msbg (exact), or a checkpoint's name or folder", "neuro-msbg"
    )
    _training_options(parser, required=True)


def _training_options(parser: Parser, *, required: bool = False) -> None:
    option = parser.option
    option("--speech", Path, "folder of clean speech to train on", required=required)
    option("--noise", Path, "folder of noises to mix in")
    option("--audiograms", Path, "CSV of measured ears to join the drawn ones")
    option("--valid-speech", Path, "folder of other speakers to validate on")
    option("--valid-noise", Path, "folder of noises to validate with")
    option("--valid-audiograms", Path, "CSV of ears to validate with")
    text = "checkpoint whose weights to start from, instead of random ones"
    option("--start", str, text, metavar="NAME")
    text = "minutes after which to stop, those before a resumption included; the learning rate does not depend on them"
    option("--max-minutes", positive, text)
    text = "step after which to stop, before the recipe's steps are done; the learning rate does not depend on it"
    option("--max-steps", count, text)
    option("--device", str, "where to train", "auto", choices=("auto", "cpu", "cuda"))
    option("--devices", count, "GPUs or processes a machine", 1)
    option("--nodes", count, "machines", 1)
    option("--strategy", str, "Lightning's, e.g. ddp", "auto")
    parser.flag("--quiet", "no progress bar, only a line a validation")
    parser.out()


def _train_simulator(options: argparse.Namespace) -> None:
    if options.manifest is None:
        planned = {
            "root": options.root,
            "prepared": options.prepared or None,
            "workers": options.workers,
        }
        if given := _given(planned, planned):
            raise ValueError(f"{given} without --manifest; allowed: with it alone")
        if options.speech is None:
            raise ValueError(
                "nothing to train on; allowed: --speech, a folder, or --manifest, of 'hlsim prepare'"
            )
    elif given := _given(vars(options), FOLDERS):
        raise ValueError(
            f"--manifest with {given}; allowed: one or the other, for a manifest has it all"
        )
    elif not options.manifest.exists():
        raise ValueError(
            f"{options.manifest}: not prepared (no such file); 'hlsim prepare' makes it"
        )
    _check(options)
    from hlsim.training.batches import PlannedSource
    from hlsim.training.recipes import SimulatorRecipe
    from hlsim.training.simulator import train_simulator

    arguments = _arguments(options) | {"teacher": options.teacher}
    if options.manifest is not None:
        workers = 1 if options.workers is None else options.workers
        arguments["data"] = PlannedSource(
            options.manifest, options.root, options.prepared, workers=workers
        )
    folder = train_simulator(recipe=SimulatorRecipe.from_dict(_recipe(options)), **arguments)
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    if options.audiogram and (given := _given(vars(options), ("audiograms", "valid_audiograms"))):
        raise ValueError(f"--audiogram with {given}; allowed: one ear, or a CSV of ears, not both")
    _check(options)
    ear = read_ear(options.audiogram) if options.audiogram else None
    from hlsim.training.compensator import train_compensator
    from hlsim.training.recipes import CompensatorRecipe

    recipe = CompensatorRecipe.from_dict(_recipe(options))
    folder = train_compensator(
        recipe=recipe, audiogram=ear, simulator=options.simulator, **_arguments(options)
    )
    print(f"the best checkpoint is in {folder}")


def _check(options: argparse.Namespace) -> None:
    need("train", "lightning", "tensorboard")
    check_there(
        folders=(options.speech, options.noise, options.valid_speech, options.valid_noise),
        files=(options.config, options.audiograms, options.valid_audiograms),
    )
    require("lightning", "train")  # one that is there may be broken


def _given(options: dict[str, Any], names: Iterable[str]) -> str:
    """Those of the options that were given, as they are written."""
    return ", ".join(f"--{name.replace('_', '-')}" for name in names if options[name] is not None)


def _recipe(options: argparse.Namespace) -> dict[str, Any]:
    """What the recipe's file holds, and what options say instead."""
    return read_recipe(options.config) | ({} if options.start is None else {"start": options.start})


def _arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Arguments that ``train_simulator`` and ``train_compensator`` have in common."""
    from hlsim.torchtools import keep_freed_memory
    from hlsim.training.batches import TrainingData

    keep_freed_memory()
    data = None
    if options.speech is not None:
        data = TrainingData(
            speech=options.speech,
            noise=options.noise,
            audiograms=options.audiograms,
            valid_speech=options.valid_speech,
            valid_noise=options.valid_noise,
            valid_audiograms=options.valid_audiograms,
        )
    return {
        "data": data,
        "out": options.out,
        "max_minutes": options.max_minutes,
        "max_steps": options.max_steps,
        "accelerator": "gpu" if options.device == "cuda" else options.device,
        "devices": options.devices,
        "nodes": options.nodes,
        "strategy": options.strategy,
        "progress": not options.quiet,
    }
