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


def add_recipe(parser: Parser, recipe: type[TrainingRecipe], example: str) -> None:
    """Declare the options of a recipe.

    Args:
        parser: parser of the command.
        recipe: class of the recipe.
        example: path of a recipe that the help names.
    """
    text = f"YAML file of a recipe, such as {example}; the settings below replace its own"
    parser.add_argument("--recipe", "--config", type=Path, metavar="FILE", help=text)
    settings = parser.add_argument_group(
        "settings of the recipe",
        "those of model and weights also one by one: --recipe.model.channels 16",
    )
    descriptions = describe_settings(recipe)
    for setting in fields(recipe):
        text = descriptions[setting.name] + show_default(setting)
        names = [f"--recipe.{setting.name}", *ALIASES.get(setting.name, [])]
        settings.add_argument(*names, metavar="VALUE", help=text.replace("%", "%%"))
    parser.passes_on("--recipe.model.", "--recipe.weights.")


def describe_settings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return the first sentence about each setting, from the docstrings of a recipe's class and its bases."""
    descriptions: dict[str, str] = {}
    for kind in reversed(recipe.mro()[:-1]):
        for name, text in re.findall(
            r"^    (\w+): (.+(?:\n        .+)*)", inspect.getdoc(kind) or "", re.M
        ):
            sentence = " ".join(text.split()).replace("``", "").split(". ")[0]
            descriptions[name] = sentence[0].lower() + sentence[1:].rstrip(".")
    return descriptions


def show_default(setting: Field[Any]) -> str:
    """Return the default of a setting as YAML has it, for the help; nothing if it is empty."""
    factory = setting.default_factory
    default = setting.default if factory is MISSING else factory()
    if isinstance(default, dict):
        default = "{" + ", ".join(f"{name}: {value}" for name, value in default.items()) + "}"
    elif isinstance(default, tuple):
        default = list(default)
    return "" if default in ("", "{}") else f" (default: {default})"


def read_recipe(options: argparse.Namespace, recipe: type[Recipe]) -> Recipe:
    """Make the recipe that the options of a command describe. Raises ValueError as ``make_recipe``."""
    values = {
        setting.name: getattr(options, f"recipe.{setting.name}") for setting in fields(recipe)
    }
    arguments = [f"--recipe.{name}={value}" for name, value in values.items() if value is not None]
    return make_recipe(recipe, options.recipe, [*arguments, *options.passed_on])


def make_recipe(recipe: type[Recipe], file: Path | None, arguments: Sequence[str]) -> Recipe:
    """Make a recipe from a file and from arguments, which come before the file's settings.

    Args:
        recipe: class of the recipe.
        file: YAML file.
        arguments: such as ``--recipe.babble=0.3``.

    Raises:
        ValueError: the file cannot be read, or a setting is unknown or has a value that is not allowed.
    """
    if file is None and not arguments:
        return recipe()  # type: ignore[call-arg]
    jsonargparse: Any = require("jsonargparse", "train")
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(recipe, "recipe")
    settings = None
    if file is not None:
        with plain_errors(str(file)):
            settings = parser.parse_object({"recipe": read_yaml(file)})
    with plain_errors("command line"):
        settings = parser.parse_args(arguments, namespace=settings)
    made: Recipe = parser.instantiate(settings).recipe
    return made


@contextmanager
def plain_errors(source: str) -> Iterator[None]:
    """Raise jsonargparse's errors as ValueErrors that name the source of the settings."""
    try:
        yield
    except (argparse.ArgumentError, OverflowError) as error:
        text = re.sub(r"<class '(\w+)'>", r"\1", str(error))
        raise ValueError(f"{source}: {text}") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the settings in a YAML file. Raises ValueError if it holds none, or one without a value."""
    yaml: Any = require("yaml", "train")
    try:
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not a YAML file: {error}") from error
    if not isinstance(settings, dict):
        raise ValueError(f"{path}: holds no settings; write lines such as 'batch: 4'")
    empty = [str(name) for name, value in settings.items() if value is None]
    if empty:
        raise ValueError(f"{path}: {empty[0]} has no value; give it one or delete the line")
    return settings
