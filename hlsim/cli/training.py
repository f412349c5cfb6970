"""The commands ``train-simulator`` and ``train-compensator``."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hlsim.cli.options import (
    Commands,
    add_command,
    audiogram_option,
    count,
    integer,
    natural,
    out_option,
    positive,
    read_ear,
    read_recipe,
)
from hlsim.extras import require
from hlsim.torchtools import keep_freed_memory

FOLDERS = ("speech", "noise", "audiograms", "valid_speech", "valid_noise", "valid_audiograms")


def add(commands: Commands) -> None:
    sub = add_command(
        commands, "train-simulator", _train_simulator, "train a Neuro-MSBG on targets from the exact MSBG"
    )
    sub.add_argument(
        "--config", type=Path, required=True, help="recipe, a YAML file (examples/neuro-msbg.yaml)"
    )
    sub.add_argument(
        "--manifest", type=Path, help="manifest.csv that 'hlsim prepare' wrote, instead of folders and files"
    )
    sub.add_argument("--root", type=Path, help="folder of the manifest's paths, if not where it was prepared")
    sub.add_argument("--prepared", action="store_true", help="train on what 'hlsim prepare --write' wrote")
    sub.add_argument("--workers", type=natural, help="processes that read the manifest's files; 1 by default")
    training_options(sub, minutes=60.0, speech_required=False)

    sub = add_command(
        commands, "train-compensator", _train_compensator, "train a compensator through a frozen simulator"
    )
    sub.add_argument("--config", type=Path, help="recipe, a YAML file (examples/compensator.yaml)")
    audiogram_option(sub, default=None, text="; without it one compensator for all ears is trained")
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="msbg (exact), or a checkpoint's name or folder"
    )
    training_options(sub, minutes=10.0)


def _train_simulator(options: argparse.Namespace) -> None:
    _require_extras()
    keep_freed_memory()
    from hlsim.training.recipes import SimulatorRecipe
    from hlsim.training.simulator import train_simulator

    if options.manifest is not None:
        _train_planned(options)
        return
    planned = {"--root": options.root, "--prepared": options.prepared or None, "--workers": options.workers}
    if given := [name for name, value in planned.items() if value is not None]:
        raise ValueError(f"{', '.join(given)} without --manifest; allowed: with it alone")
    if options.speech is None:
        raise ValueError(
            "nothing to train on; allowed: --speech, a folder, or --manifest, of 'hlsim prepare'"
        )
    folder = train_simulator(
        training_data(options), SimulatorRecipe.from_dict(recipe(options)), **training_arguments(options)
    )
    print(f"the best checkpoint is in {folder}")


def _train_planned(options: argparse.Namespace) -> None:
    from hlsim.training.batches import PlannedSource
    from hlsim.training.recipes import SimulatorRecipe
    from hlsim.training.simulator import train_simulator

    if given := _given(options, FOLDERS):
        raise ValueError(
            f"--manifest with {', '.join(given)}; allowed: one or the other, for a manifest has it all"
        )
    folder = train_simulator(
        PlannedSource(
            options.manifest,
            options.root,
            options.prepared,
            workers=1 if options.workers is None else options.workers,
        ),
        SimulatorRecipe.from_dict(recipe(options)),
        **training_arguments(options),
    )
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    _require_extras()
    if options.audiogram and (given := _given(options, ("audiograms", "valid_audiograms"))):
        raise ValueError(f"--audiogram with {', '.join(given)}; allowed: one ear, or a CSV of ears, not both")
    keep_freed_memory()
    from hlsim.training.compensator import train_compensator
    from hlsim.training.recipes import CompensatorRecipe

    folder = train_compensator(
        training_data(options),
        CompensatorRecipe.from_dict(recipe(options)),
        audiogram=read_ear(options.audiogram) if options.audiogram else None,
        simulator=options.simulator,
        **training_arguments(options),
    )
    print(f"the best checkpoint is in {folder}")


def _require_extras() -> None:
    for module in ("lightning", "tensorboard"):
        require(module, "train")


def _given(options: argparse.Namespace, names: Iterable[str]) -> list[str]:
    """Those of the options that were given, as they are written."""
    return [f"--{name.replace('_', '-')}" for name in names if getattr(options, name) is not None]


def training_options(
    parser: argparse.ArgumentParser, *, minutes: float, speech_required: bool = True
) -> None:
    parser.add_argument(
        "--speech", type=Path, required=speech_required, help="folder of clean speech to train on"
    )
    parser.add_argument("--noise", type=Path, help="folder of noises to mix in")
    parser.add_argument("--audiograms", type=Path, help="CSV of measured ears to join the drawn ones")
    parser.add_argument("--valid-speech", type=Path, help="folder of other speakers to validate on")
    parser.add_argument("--valid-noise", type=Path, help="folder of noises to validate with")
    parser.add_argument("--valid-audiograms", type=Path, help="CSV of ears to validate with")
    parser.add_argument(
        "--start", metavar="NAME", help="checkpoint whose weights to start from, instead of random ones"
    )
    parser.add_argument(
        "--max-minutes", type=positive, default=minutes, help="of training, resumed parts included"
    )
    parser.add_argument("--max-steps", type=integer, default=-1, help="stop earlier; -1 for no such limit")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train")
    parser.add_argument("--devices", type=count, default=1, help="GPUs or processes a machine")
    parser.add_argument("--nodes", type=count, default=1, help="machines")
    parser.add_argument("--strategy", default="auto", help="Lightning's, e.g. ddp")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, only a line a validation")
    out_option(parser)


def recipe(options: argparse.Namespace) -> dict[str, Any]:
    """What the recipe's file holds, and what options say instead."""
    start = {} if options.start is None else {"start": options.start}
    return read_recipe(options.config) | start


def training_data(options: argparse.Namespace) -> Any:
    from hlsim.training.batches import TrainingData

    return TrainingData(**{name: getattr(options, name) for name in FOLDERS})


def training_arguments(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "out": options.out,
        "max_minutes": options.max_minutes,
        "max_steps": options.max_steps,
        "accelerator": "gpu" if options.device == "cuda" else options.device,
        "devices": options.devices,
        "nodes": options.nodes,
        "strategy": options.strategy,
        "progress": not options.quiet,
    }
