"""Names and defaults of the command line agree with those of the library."""

import inspect
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest

from hlsim.audiogram import STANDARD
from hlsim.cli import options
from hlsim.cli.main import COMMANDS, GROUPS, main
from hlsim.cli.options import Parser, join_negative_values
from hlsim.losses.criteria import CRITERIA, CriterionName
from hlsim.training.teacher import TEACHERS


def declared(command: str) -> Parser:
    parser = Parser(prog=command)
    getattr(import_module(f"hlsim.cli.{COMMANDS[command][0]}"), command.replace("-", "_"))(parser)
    return parser


@pytest.mark.parametrize("command", COMMANDS)
def test_help_ends_with_two_examples_that_the_command_takes(command: str) -> None:
    parser = declared(command)
    text, examples = parser.format_help().split("\nexamples:\n")
    assert text.startswith(f"usage: {command}")
    lines = examples.splitlines()
    assert len(lines) == 2
    for words in map(str.split, lines):
        assert words[0] == command and parser.parse_args(words[1:]).run
        recipes = [word for word in words if word.endswith(".yaml")]
        assert all((Path(__file__).parents[2] / recipe).is_file() for recipe in recipes)


def test_names_that_are_written_twice_agree() -> None:
    assert tuple(STANDARD) == options.STANDARD_EARS
    assert options.TEACHERS == TEACHERS
    assert tuple(CRITERIA) == get_args(CriterionName)


def _parameters() -> dict[str, dict[str, Any]]:
    """Return the defaults of each command's function by the names of its arguments."""
    pytest.importorskip("lightning")
    from hlsim.demo import demo
    from hlsim.evaluation import haspi_report
    from hlsim.evaluation.compensators import evaluate_compensators
    from hlsim.evaluation.simulators import evaluate_simulators
    from hlsim.training.compensator import train_compensator
    from hlsim.training.corpora.layouts import prepare
    from hlsim.training.simulator import train_simulator
    from hlsim.training.trainer import TrainerOptions

    functions: dict[str, Callable[..., Any]] = {
        "prepare": prepare,
        "demo": demo,
        "haspi-report": haspi_report,
        "evaluate-compensator": evaluate_compensators,
        "evaluate-simulator": evaluate_simulators,
        "train-compensator": train_compensator,
        "train-simulator": train_simulator,
    }
    defaults: dict[str, dict[str, Any]] = {}
    for command, function in functions.items():
        parameters = inspect.signature(function).parameters
        defaults[command] = {name: parameter.default for name, parameter in parameters.items()}
        if command.startswith("train-"):
            defaults[command] |= dict.fromkeys(TrainerOptions.__annotations__)
    return defaults


def test_defaults_of_the_program_are_the_functions() -> None:
    compared = 0
    for command, parameters in _parameters().items():
        parser = declared(command)
        for name, expected in parameters.items():
            default = parser.get_default(name)
            if default is None or expected in (None, inspect.Parameter.empty):
                continue  # The value is required, or is converted before the call.
            if name == "measures":
                default = default.split(",")
            if isinstance(default, list | tuple):
                default, expected = list(default), list(expected)
            assert default == expected, (command, name)
            compared += 1
    assert compared > 20


def test_required_options_are_a_group_of_their_own() -> None:
    text = declared("evaluate-simulator").format_help()
    assert text.index("required options:") < text.index("folder of clean speech")
    assert "None" not in text and "(default: 50 60 65 70 80)" in " ".join(text.split())


def test_every_command_is_in_one_group(capsys: pytest.CaptureFixture[str]) -> None:
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(COMMANDS)
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in COMMANDS)


def test_lists_that_begin_with_a_minus_are_values() -> None:
    assert join_negative_values(["--audiogram", "-10,0,5", "--levels", "-5"]) == [
        "--audiogram=-10,0,5",
        "--levels",
        "-5",
    ]
