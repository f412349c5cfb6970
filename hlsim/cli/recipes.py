"""Options of a recipe: ``--recipe FILE``, and ``--recipe.NAME VALUE`` for each of its settings."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, TypeVar

from hlsim.cli.options import Parser, input_file
from hlsim.extras import require
from hlsim.training.recipes import TrainingRecipe

Recipe = TypeVar("Recipe", bound=TrainingRecipe)


def add_recipe(parser: Parser, recipe: type[TrainingRecipe], example: str) -> None:
    """Declare ``--recipe`` and one option per setting of a recipe.

    Args:
        parser: Parser of the command.
        recipe: Class of the recipe.
        example: Path of a YAML file with a recipe, for the help.
    """
    text = (
        f"YAML file of a recipe, such as {example}; the settings below override those of the file"
    )
    parser.add_argument("--recipe", "--config", type=input_file, metavar="FILE", help=text)
    settings = parser.add_argument_group(
        "settings of the recipe",
        "model and weights also accept single settings, such as --recipe.model.channels 16",
    )
    descriptions = describe_settings(recipe)
    for setting in fields(recipe):
        text = descriptions[setting.name] + format_default(setting)
        names = [f"--recipe.{setting.name}"] + ["--start"] * (setting.name == "start")
        settings.add_argument(*names, metavar="VALUE", help=text.replace("%", "%%"))
    parser.accept_prefixes("--recipe.model.", "--recipe.weights.")


def describe_settings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return the first sentence about each setting of a recipe, from the docstrings of its classes.

    Args:
        recipe: Class of the recipe.

    Returns:
        Sentences without a full stop, by the name of the setting.
    """
    descriptions: dict[str, str] = {}
    for kind in reversed(recipe.mro()[:-1]):
        docstring = inspect.getdoc(kind) or ""
        for name, text in re.findall(r"^    (\w+): (.+(?:\n        .+)*)", docstring, re.M):
            sentence = " ".join(text.split()).replace("``", "").split(". ")[0]
            descriptions[name] = sentence[0].lower() + sentence[1:].rstrip(".")
    return descriptions


def format_default(setting: Field[Any]) -> str:
    """Describe the default of a setting for the help, such as ``" (default: 0.3)"``.

    Args:
        setting: Field of the recipe's class.

    Returns:
        Text in YAML with a leading blank; an empty text for an empty default.
    """
    factory = setting.default_factory
    default = setting.default if factory is MISSING else factory()
    if isinstance(default, dict):
        default = "{" + ", ".join(f"{name}: {value}" for name, value in default.items()) + "}"
    elif isinstance(default, tuple):
        default = list(default)
    return "" if default in ("", "{}") else f" (default: {default})"


def read_recipe(options: argparse.Namespace, recipe: type[Recipe]) -> Recipe:
    """Make the recipe of ``--recipe`` and of the options ``--recipe.NAME``.

    Args:
        options: Options of the command.
        recipe: Class of the recipe.

    Raises:
        ValueError: The file cannot be read, or a setting is unknown or invalid.
    """
    names = [setting.name for setting in fields(recipe)]
    values = {name: getattr(options, f"recipe.{name}") for name in names}
    arguments = [f"--recipe.{name}={value}" for name, value in values.items() if value is not None]
    return make_recipe(recipe, options.recipe, [*arguments, *options.undeclared])


def make_recipe(recipe: type[Recipe], file: Path | None, arguments: Sequence[str]) -> Recipe:
    """Make a recipe of a file and of arguments, which override the settings of the file.

    Args:
        recipe: Class of the recipe.
        file: YAML file; None uses the defaults.
        arguments: Arguments such as ``--recipe.babble=0.3``.

    Raises:
        ValueError: The file cannot be read, or a setting is unknown or invalid.
    """
    if file is not None:
        arguments = [f"--recipe={file}", *arguments]
    if not arguments:
        return recipe()  # type: ignore[call-arg]
    jsonargparse: Any = require("jsonargparse", "train")
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(recipe, "recipe")
    try:
        settings = parser.parse_args(arguments)
    except (argparse.ArgumentError, OverflowError) as error:
        text = re.sub(r"<class '(\w+)'>", r"\1", str(error))
        text = re.sub(r'Parser key "recipe":\s+Unable to load config', "cannot read", text)
        raise ValueError(
            f"recipe: {text}; write settings as 'batch: 4' in the file, or as --recipe.batch 4"
        ) from error
    result: Recipe = parser.instantiate(settings).recipe
    return result
