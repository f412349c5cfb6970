"""The commands ``train-simulator`` and ``train-compensator``."""

import argparse
from pathlib import Path
from typing import Any

from hlsim.cli.inputs import check_extras, parse_ear
from hlsim.cli.options import Parser, count, input_path, minutes, workers
from hlsim.cli.recipes import add_recipe, make_recipe
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe


def train_simulator(parser: Parser) -> None:
    """Declare the options of the command ``train-simulator``."""
    parser.set_command(
        _train_simulator,
        "--speech speech/train --valid-speech speech/valid --out runs/simulator",
        "--recipe examples/neuro-msbg-lstm.yaml --recipe.batch 4 --manifest "
        "VoiceBank/manifest.csv --out runs/lstm",
    )
    parser.teacher("simulator whose output the network learns")
    _declare_common(parser)
    add_recipe(parser, SimulatorRecipe, "examples/neuro-msbg.yaml")


def train_compensator(parser: Parser) -> None:
    """Declare the options of the command ``train-compensator``."""
    parser.set_command(
        _train_compensator,
        "--speech speech/train --valid-speech speech/valid --audiogram N3 --out runs/n3",
        "--recipe examples/hearing-aid.yaml --start hearing-aid --speech speech --noise noise "
        "--out runs/aid",
    )
    parser.audiogram(text="; without it, one compensator for all ears is trained")
    parser.simulator("neuro-msbg")
    _declare_common(parser)
    add_recipe(parser, CompensatorRecipe, "examples/compensator.yaml")


def _declare_common(parser: Parser) -> None:
    """Declare the options of both trainings, apart from those of their recipes."""
    option = parser.option
    speech = parser.add_mutually_exclusive_group(required=True)
    option("--speech", input_path, "folder of clean speech", group=speech)
    text = (
        "CSV file of 'hlsim prepare', instead of --speech; its validation speech and the noise of "
        "its noisy speech are used unless other options name some"
    )
    option("--manifest", input_path, text, group=speech)
    text = (
        "folder to which the manifest's paths are relative; by default the folder of the manifest"
    )
    option("--root", input_path, text)
    option("--noise", input_path, "folder of noise recordings that are mixed in")
    ears = "CSV file of measured ears, or standard for Bisgaard's"
    option("--audiograms", str, f"{ears}; used in addition to random ears")
    text = "folder of clean speech by other speakers, for validation"
    option("--valid-speech", input_path, text)
    option("--valid-noise", input_path, "folder of noise recordings for validation")
    option("--valid-audiograms", str, f"{ears}, for validation")
    text = (
        "time limit in minutes, including the time before a resumption; the learning rate "
        "does not depend on it"
    )
    option("--max-minutes", minutes, text)
    option("--device", str, "device of the training", "auto", choices=("auto", "cpu", "cuda"))
    option("--devices", count, "number of GPUs or processes; each draws its own batches", 1)
    text = "number of processes that draw batches, in addition to the one that trains"
    option("--workers", workers, text, 0)
    option("--out", Path, "folder for the results", required=True)


def _train_simulator(options: argparse.Namespace) -> None:
    check_extras("train")
    recipe = make_recipe(SimulatorRecipe, options.recipe, options.settings)
    from hlsim.training.simulator import train_simulator

    folder = train_simulator(recipe=recipe, teacher=options.teacher, **_common_arguments(options))
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    check_extras("train")
    recipe = make_recipe(CompensatorRecipe, options.recipe, options.settings)
    ear: Any = parse_ear(options)
    from hlsim.training.compensator import train_compensator

    folder = train_compensator(
        recipe=recipe,
        audiogram=ear,
        simulator=options.simulator,
        **_common_arguments(options),
    )
    print(f"the best checkpoint is in {folder}")


def _common_arguments(options: argparse.Namespace) -> dict[str, Any]:
    """Return the keyword arguments of ``train_simulator`` and ``train_compensator`` as a dict.

    They are the data and the settings that both functions have.

    Raises:
        ValueError: There is a root without a manifest, or the manifest is not valid.
    """
    from hlsim.training.batches import TrainingData

    names = ("noise", "audiograms", "valid_speech", "valid_noise", "valid_audiograms", "workers")
    sources = {name: getattr(options, name) for name in names}
    if options.root and not options.manifest:
        raise ValueError("--root has no effect without --manifest; leave it out")
    if options.manifest:
        data = TrainingData.from_manifest(options.manifest, options.root, **sources)
    else:
        data = TrainingData(options.speech, **sources)
    common = {name: getattr(options, name) for name in ("out", "max_minutes", "devices")}
    return {"data": data, "accelerator": options.device, **common}
