"""Names and defaults of the command line agree with those of the library."""

import inspect
from importlib import import_module
from pathlib import Path

import pytest

from hlsim.cli.main import COMMANDS, main, make_parser

FUNCTIONS = {
    "simulate": "hlsim.shortcuts",
    "compensate": "hlsim.shortcuts",
    "demo": "hlsim.cli.demo_run:run_demo",
    "haspi-report": "hlsim.evaluation",
    "evaluate-compensator": "hlsim.evaluation.compensators:evaluate_compensators",
    "evaluate-simulator": "hlsim.evaluation.simulators:evaluate_simulators",
    "clarity": "hlsim.evaluation.clarity:evaluate_scenes",
    "srt": "hlsim.evaluation.digits:reception_threshold",
    "prepare": "hlsim.data.layouts",
    "train-compensator": "hlsim.training.compensator",
    "train-simulator": "hlsim.training.simulator",
}
"""Module of each command's function, and its name if it is not that of the command."""


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.usefixtures("every_path_exists")
def test_help_ends_with_two_examples_that_the_command_takes(command: str) -> None:
    parser = make_parser(command)
    text, examples = parser.format_help().split("\nexamples:\n")
    assert text.startswith(f"usage: hlsim {command}") and "None" not in text
    lines = examples.splitlines()
    assert len(lines) == 2
    recipes = [word for word in examples.split() if word.endswith(".yaml")]
    assert all((Path(__file__).parents[2] / recipe).is_file() for recipe in recipes)
    for words in map(str.split, lines):
        assert words[:2] == ["hlsim", command] and parser.parse_args(words[2:]).run


@pytest.mark.parametrize("command", FUNCTIONS)
def test_defaults_of_a_command_are_those_of_its_function(command: str) -> None:
    pytest.importorskip("lightning")
    module, _, name = FUNCTIONS[command].partition(":")
    function = getattr(import_module(module), name or command.replace("-", "_"))
    parser, compared = make_parser(command), 0
    for name, parameter in inspect.signature(function).parameters.items():
        default, expected = parser.get_default(name), parameter.default
        if default is None or expected in (None, inspect.Parameter.empty):
            continue  # The value is required, or is converted before the call.
        if isinstance(default, list | tuple):
            default, expected = list(default), list(expected)
        assert default == expected, name
        compared += 1
    assert compared or command.startswith("train")


def test_the_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([])
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in COMMANDS)


@pytest.mark.parametrize(
    "words",
    [
        "simulate a.wav b.wav --audiogram N2 N4",
        "listen --audiogram 500:30,1000:40 n4 a.wav --out b.html",
        "demo --audiogram N2 N4",
    ],
)
def test_two_ears_after_one_option_are_an_error_that_says_so(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    (line,) = capsys.readouterr().err.splitlines()
    assert "--audiogram takes one ear, got" in line and "repeat the option" in line


@pytest.mark.parametrize(
    "words",
    [
        "train-compensator --speech . --speech .",
        "export-gains --audiogram N3 --audiogram N4",
        "haspi-report --measures stoi --measures haspi",
        "clarity . --enhancer a:b --enhancer c:d",
    ],
)
def test_an_option_of_which_the_last_would_count_may_not_be_repeated(
    capsys: pytest.CaptureFixture[str], words: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words.split())
    assert "appears twice" in capsys.readouterr().err


def test_lists_that_begin_with_a_minus_are_values() -> None:
    words = "--levels -5 -10 --audiogram -10,0,5,10,20,30,40,50 msbg --speech . --out o".split()
    parsed = make_parser("evaluate-compensator").parse_args(words)
    assert parsed.audiogram == [-10.0, 0.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert parsed.levels == [-5.0, -10.0] and parsed.names == ["msbg"]


@pytest.mark.parametrize("words", ["65,80", "65 80"])
def test_values_are_separated_by_commas_or_spaces(words: str) -> None:
    command = f"msbg --speech . --out o --gain-ears n3,s2 --levels {words}"
    parsed = make_parser("evaluate-compensator").parse_args(command.split())
    assert parsed.levels == [65.0, 80.0] and parsed.gain_ears == ["N3", "S2"]


def test_aids_of_clarity_may_follow_options_or_be_left_out(tmp_path: Path) -> None:
    options = [str(tmp_path), "--listeners", str(tmp_path), "--out", "judged"]
    parser = make_parser("clarity")
    assert parser.parse_args([*options, "nalr", "wdrc"]).names == ["nalr", "wdrc"]
    assert parser.parse_args([options[0], "nalr", *options[1:]]).names == ["nalr"]
    assert parser.parse_args(options).names == []
