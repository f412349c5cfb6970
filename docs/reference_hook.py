"""Hook of mkdocs that fills pages of the reference: commands, recipes and the Python API.

The pages hold comments where generated text belongs, so that they are readable without being built.
"""

import argparse
import inspect
import re
from collections.abc import Callable
from dataclasses import fields

from hlsim.cli.main import COMMANDS, make_parser
from hlsim.cli.recipes import format_default
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe, TrainingRecipe

_GENERATED = re.compile(r"<!-- generated: (.+) -->")
_API = re.compile(r"<!-- api: (\S+)(?: (\{.*\}))? -->")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the comments of a page by what they stand for."""
    markdown = _GENERATED.sub(lambda match: GENERATORS[match[1]](), markdown)
    return _API.sub(_api_directive, markdown)


def _api_directive(match: re.Match[str]) -> str:
    """Return the directive of mkdocstrings for a name and its options."""
    options = f"\n    options: {match[2]}" if match[2] else ""
    return f"::: {match[1]}{options}"


def describe_commands() -> str:
    """Return a section for each command, with its options."""
    return "\n\n".join(map(_describe_command, COMMANDS))


def _describe_command(name: str) -> str:
    parser, description = make_parser(name), COMMANDS[name][1]
    text = f"{description[0].upper()}{description[1:]}."
    parts = [f"## hlsim {name}", text]
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.dest != "help"]
        rows = [_describe_option(action) for action in actions if not _is_setting(action)]
        if rows:
            kind = "argument" if group.title == "positional arguments" else "option"
            parts.append("\n".join([f"| {kind} | meaning |", "|---|---|", *rows]))
    if any(_is_setting(action) for action in parser._actions):
        parts.append(
            "`--recipe.NAME VALUE` sets one [field of the recipe](recipes.md), also inside of "
            "`model` and `weights`, as in `--recipe.model.channels 16`."
        )
    examples = parser.format_help().partition("\nexamples:\n")[2]
    parts.append(f"```sh\n{inspect.cleandoc(examples)}\n```")
    return "\n\n".join(parts)


def _is_setting(action: argparse.Action) -> bool:
    """Return whether an option is a field of a recipe, which has a page of its own."""
    return action.dest == "settings"


def _describe_option(action: argparse.Action) -> str:
    """Return the row of an option or argument."""
    name = ", ".join(action.option_strings)
    value = action.metavar or ("" if action.nargs == 0 else action.dest.upper())
    if action.choices:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    label = f"{name} {value}".strip() if action.option_strings else action.dest
    text = (action.help or "").replace("%%", "%").replace("|", "\\|").replace("<", "&lt;")
    return f"| `{label}` | {text} |"


def describe_recipes() -> str:
    """Return a table of the fields of each recipe."""
    kinds = {"train-simulator": SimulatorRecipe, "train-compensator": CompensatorRecipe}
    return "\n\n".join(_describe_recipe(command, kind) for command, kind in kinds.items())


def _describe_recipe(command: str, recipe: type[TrainingRecipe]) -> str:
    descriptions: dict[str, str] = {}
    for kind in reversed(recipe.mro()[:-1]):
        docstring = inspect.getdoc(kind) or ""
        for name, text in re.findall(r"^    (\w+): (.+(?:\n        .+)*)", docstring, re.M):
            descriptions[name] = " ".join(text.split()).replace("``", "`")
    rows = ["| field | default | meaning |", "|---|---|---|"]
    for setting in fields(recipe):
        default = format_default(setting)
        rows.append(f"| `{setting.name}` | `{default}` | {descriptions[setting.name]} |")
    return f"## hlsim {command}\n\n" + "\n".join(rows)


GENERATORS: dict[str, Callable[[], str]] = {
    "command line": describe_commands,
    "recipes": describe_recipes,
}
