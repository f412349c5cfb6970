"""Options of a recipe: ``--recipe FILE``, and ``--recipe.NAME VALUE`` for each of its settings."""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any, TypeVar

from hlsim.cli.options import Parser
from hlsim.extras import require
from hlsim.training.recipes import TrainingRecipe

Recipe = TypeVar("Recipe", bound=TrainingRecipe)

ALIASES = {"start": ["--start"]}
"""Other names of options by setting."""


def add_recipe(parser: Parser, recipe: type[TrainingRecipe], example: str) -> None:
    """Declare the options of a recipe.

    Args:
        parser: Parser of the command.
        recipe: Class of the recipe.
        example: Path of a recipe, for the help.
    """
    text = (
        f"YAML file of a recipe, such as {example}; the settings below override those of the file"
    )
    parser.add_argument("--recipe", "--config", type=Path, metavar="FILE", help=text)
    settings = parser.add_argument_group(
        "settings of the recipe",
        "model and weights also accept single settings, such as --recipe.model.channels 16",
    )
    descriptions = describe_settings(recipe)
    for setting in fields(recipe):
        text = descriptions[setting.name] + format_default(setting)
        names = [f"--recipe.{setting.name}", *ALIASES.get(setting.name, [])]
        settings.add_argument(*names, metavar="VALUE", help=text.replace("%", "%%"))
    parser.accept_prefixes("--recipe.model.", "--recipe.weights.")


def describe_settings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return the first sentence about each setting from the docstrings of a recipe's classes."""
    descriptions: dict[str, str] = {}
    for kind in reversed(recipe.mro()[:-1]):
        docstring = inspect.getdoc(kind) or ""
        for name, text in re.findall(r"^    (\w+): (.+(?:\n        .+)*)", docstring, re.M):
            sentence = " ".join(text.split()).replace("``", "").split(". ")[0]
            descriptions[name] = sentence[0].lower() + sentence[1:].rstrip(".")
    return descriptions


def format_default(setting: Field[Any]) -> str:
    """Format the default of a setting as YAML, for the help. An empty default gives an empty
    text."""
    factory = setting.default_factory
    default = setting.default if factory is MISSING else factory()
    if isinstance(default, dict):
        default = "{" + ", ".join(f"{name}: {value}" for name, value in default.items()) + "}"
    elif isinstance(default, tuple):
        default = list(default)
    return "" if default in ("", "{}") else f" (default: {default})"


def read_recipe(options: argparse.Namespace, recipe: type[Recipe]) -> Recipe:
    """Make a recipe of the options of a command.

    Raises:
        ValueError: The file cannot be read, or a setting is unknown or invalid.
    """
    values = {
        setting.name: getattr(options, f"recipe.{setting.name}") for setting in fields(recipe)
    }
    arguments = [f"--recipe.{name}={value}" for name, value in values.items() if value is not None]
    return make_recipe(recipe, options.recipe, [*arguments, *options.undeclared])


def make_recipe(recipe: type[Recipe], file: Path | None, arguments: Sequence[str]) -> Recipe:
    """Make a recipe of a file and of arguments, which override the settings of the file.

    Args:
        recipe: Class of the recipe.
        file: YAML file, if there is one.
        arguments: Arguments such as ``--recipe.babble=0.3``.

    Raises:
        ValueError: The file cannot be read, or a setting is unknown or invalid.
    """
    if file is None and not arguments:
        return recipe()  # type: ignore[call-arg]
    jsonargparse: Any = require("jsonargparse", "train")
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(recipe, "recipe")
    settings = None
    if file is not None:
        with value_errors(str(file)):
            settings = parser.parse_object({"recipe": read_yaml(file)})
    with value_errors("command line"):
        settings = parser.parse_args(arguments, namespace=settings)
    result: Recipe = parser.instantiate(settings).recipe
    return result


@contextmanager
def value_errors(source: str) -> Iterator[None]:
    """Turn errors of jsonargparse into ValueErrors that name the source of the settings."""
    try:
        yield
    except (argparse.ArgumentError, OverflowError) as error:
        text = re.sub(r"<class '(\w+)'>", r"\1", str(error))
        raise ValueError(f"{source}: {text}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the settings in a YAML file.

    Raises:
        ValueError: The file is not YAML, or a setting has no value.
    """
    yaml: Any = require("yaml", "train")
    try:
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: expected a YAML file: {error}") from error
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: expected settings, one per line, such as 'batch: 4'")
    for name, value in settings.items():
        if value is None:
            raise ValueError(f"{path}: {name} has no value; add one or delete the line")
    return settings
