"""Options of a recipe: ``--recipe FILE``, and ``--recipe.NAME VALUE`` for each of its settings."""

import argparse
import inspect
import json
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, fields
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from hlsim.cli.options import Parser, input_path
from hlsim.extras import require
from hlsim.files import reject_duplicates
from hlsim.training.recipes import TrainingRecipe

Recipe = TypeVar("Recipe", bound=TrainingRecipe)

_NUMBERS_BY_NAME = re.compile(r"[\w.-]+:-?[\d.]+(,[\w.-]+:-?[\d.]+)*")


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
    parser.option("--recipe", input_path, text)
    group = parser.add_argument_group(
        "settings of the recipe",
        "model and weights also accept single settings, such as --recipe.model.channels 16",
    )
    parser.prefix = "--recipe."
    descriptions = describe_settings(recipe)
    for setting in fields(recipe):
        name = f"--recipe.{setting.name}"
        names = [name, "--start"] if setting.name == "start" else [name]
        text = f"{descriptions[setting.name]} (default: {format_default(setting)})"
        group.add_argument(
            *names,
            dest="settings",
            action="append",
            type=partial(_write_setting, name),
            default=[],
            metavar="VALUE",
            help=text.replace("%", "%%"),
        )


def _write_setting(name: str, value: str) -> str:
    """Return a text such as ``--recipe.steps=100``, which jsonargparse reads as YAML.

    Numbers by name or level, such as 50:0,65:-5, become a mapping of YAML.
    """
    if _NUMBERS_BY_NAME.fullmatch(value):
        value = f"{{{value.replace(':', ': ')}}}"
    return f"{name}={value}"


def describe_settings(recipe: type[TrainingRecipe]) -> dict[str, str]:
    """Return the first sentence about each setting of a recipe, from the docstrings of its classes.

    Args:
        recipe: Class of the recipe.

    Returns:
        Sentences by the name of the setting, with a small first letter and without full stop and
        backticks.
    """
    descriptions: dict[str, str] = {}
    for kind in reversed(recipe.mro()[:-1]):
        docstring = inspect.getdoc(kind) or ""
        for name, text in re.findall(r"^    (\w+): (.+(?:\n        .+)*)", docstring, re.M):
            sentence = " ".join(text.split()).replace("``", "").split(". ")[0]
            descriptions[name] = sentence[0].lower() + sentence[1:].rstrip(".")
    return descriptions


def format_default(setting: Field[Any]) -> str:
    """Return the default of a setting of a recipe in JSON, which is also YAML.

    Args:
        setting: Field of the recipe's class.
    """
    factory = setting.default_factory
    return json.dumps(setting.default if factory is MISSING else factory())


def make_recipe(recipe: type[Recipe], file: Path | None, settings: Sequence[str]) -> Recipe:
    """Build a recipe from a file and from settings, which override those of the file.

    Args:
        recipe: Class of the recipe.
        file: YAML file; None uses the defaults.
        settings: Arguments such as ``--recipe.babble=0.3``.

    Raises:
        ValueError: The file cannot be read, or a setting is unknown, invalid or given twice.
        OSError: There is no such file.
        MissingExtraError: jsonargparse or PyYAML is not installed, unless defaults are used alone.
    """
    arguments = [*settings] if file is None else [f"--recipe={file}", *settings]
    if not arguments:
        return recipe()  # type: ignore[call-arg]
    jsonargparse: Any = require("jsonargparse", "train")
    names = [setting.partition("=")[0] for setting in settings if setting.startswith("--")]
    if repeated := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"recipe: {repeated[0]} appears twice; leave one out")
    texts = [setting.partition("=")[2] or setting for setting in settings]
    if file is not None:
        texts.append(file.read_text(encoding="utf-8", errors="replace"))
    for text in texts:
        _check_yaml(text)
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(recipe, "recipe")
    try:
        parsed = parser.parse_args(arguments)
    except (argparse.ArgumentError, OverflowError) as error:
        raise ValueError(
            f"recipe: {error}; write settings as 'batch: 4' in the file, or as --recipe.batch 4"
        ) from error
    result: Recipe = parser.instantiate(parsed).recipe
    return result


def _check_yaml(text: str) -> None:
    """Raise ValueError if YAML reads a text in another way than a user expects.

    If a mapping has a key twice, the last one would count, and 1:30 would be the number 90.

    A text that is not valid YAML passes, because jsonargparse rejects it. Without PyYAML, the error
    is MissingExtraError.
    """
    yaml: Any = require("yaml", "train")

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            return reject_duplicates(self.construct_pairs(node, deep=True))

        def construct_object(self, node: Any, deep: bool = False) -> Any:
            if node.tag.endswith(("int", "float")) and ":" in node.value:
                raise ValueError(
                    f"recipe: got {node.value}; put a space after the colon of a mapping, such as "
                    "{50: 0, 65: -5}, and write numbers without a colon"
                )
            return super().construct_object(node, deep)

    with suppress(yaml.YAMLError, TypeError):  # TypeError: a key is a list
        yaml.load(text, Loader=Loader)
