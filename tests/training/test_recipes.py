"""Recipes are equal in Python, in YAML and on the command line, and reject invalid settings."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from hlsim.cli.options import Parser
from hlsim.cli.recipes import add_recipe, describe_settings, make_recipe
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

ROOT = Path(__file__).parents[2]
AID_YAML = """
kind: hearing-aid
model: {width: 8, hidden: 16}
learning_rate: 1e-3
snr: [-5, 20]
"""
AID_OPTIONS = (
    "--recipe.kind=hearing-aid --recipe.model.width 8 --recipe.model.hidden=16 "
    "--recipe.learning_rate 1e-3 --recipe.snr [-5,20]"
)
AID_RECIPE = CompensatorRecipe(
    kind="hearing-aid", model={"width": 8, "hidden": 16}, learning_rate=1e-3, snr=(-5.0, 20.0)
)


def from_options(words: str) -> CompensatorRecipe:
    parser = Parser()
    add_recipe(parser, CompensatorRecipe, "an example")
    options = parser.parse_args(words.split())
    return make_recipe(CompensatorRecipe, options.recipe, options.settings)


def test_python_yaml_and_the_command_line_agree(tmp_path: Path) -> None:
    pytest.importorskip("jsonargparse")
    file = tmp_path / "aid.yaml"
    file.write_text(AID_YAML)
    assert make_recipe(CompensatorRecipe, file, []) == from_options(AID_OPTIONS) == AID_RECIPE
    assert from_options("") == CompensatorRecipe()
    options = f"--recipe.model.width 4 --recipe {file} --start hearing-aid --recipe.seed -3"
    recipe = from_options(options)  # Options come before the file.
    assert recipe.model == {"width": 4, "hidden": 16}
    assert (recipe.start, recipe.seed, recipe.snr) == ("hearing-aid", -3, (-5.0, 20.0))


RECIPES = [
    path for path in sorted((ROOT / "examples").rglob("*.yaml")) if "integrations" not in path.parts
]


@pytest.mark.parametrize("path", RECIPES, ids=str)
def test_every_example_is_a_recipe_that_states_its_steps(path: Path) -> None:
    pytest.importorskip("jsonargparse")
    is_aid = path.name.startswith(("compensator", "hearing-aid"))
    recipe: Any = CompensatorRecipe if is_aid else SimulatorRecipe
    assert f"\nsteps: {make_recipe(recipe, path, []).steps}" in path.read_text()


def test_the_help_describes_every_setting() -> None:
    for recipe in (SimulatorRecipe, CompensatorRecipe):
        assert describe_settings(recipe).keys() >= {setting.name for setting in fields(recipe)}


@pytest.mark.parametrize(
    ("recipe", "settings"),
    [
        (SimulatorRecipe, {"batch": 0}),
        (SimulatorRecipe, {"learning_rate": -1.0}),
        (SimulatorRecipe, {"weights": {"loudness": 1.0}}),
        (SimulatorRecipe, {"weights": {}}),
        (SimulatorRecipe, {"average": 1.0}),
        (SimulatorRecipe, {"sounds": 1.1}),
        (CompensatorRecipe, {"weights": {"bands": 0.0}}),
        (CompensatorRecipe, {"weights": {"denoising": 1.0}}),  # There is no noise reduction.
        (CompensatorRecipe, {"unreduced": 0.5}),
        (CompensatorRecipe, {"babble": 0.5, "batch": 1}),
        (CompensatorRecipe, {"limit_to_ear": True}),  # There are no bands to limit.
        (CompensatorRecipe, {"kind": "hearing-aid", "limit_to_ear": "yes"}),
        (CompensatorRecipe, {"weights": {"haspi": 1.0}}),  # Clips of 0.6 s are too short.
        (CompensatorRecipe, {"snr": (20.0, 0.0)}),
        (SimulatorRecipe, {"levels": (50.0, float("inf"))}),
        (CompensatorRecipe, {"mismatch": 0.2}),  # There is one microphone.
        (CompensatorRecipe, {"kind": "beamforming-aid", "babble": 0.5}),  # It has no effect.
        # The front end would learn to attenuate, because the amplification is not trained.
        (CompensatorRecipe, {"kind": "beamforming-aid", "loudness": -10.0}),
        (
            CompensatorRecipe,
            {"kind": "hearing-aid", "weights": {"denoising": 1.0}, "loudness": {65.0: -5.0}},
        ),
    ],
)
def test_invalid_settings_are_rejected(recipe: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        recipe(**settings)


@pytest.mark.parametrize(
    "text",
    ["", "- 1", "epochs: 3", "batch: two", "levels: loud", "weights: {bands: loud}", "kind: radio"],
)
def test_invalid_files_and_arguments_are_rejected(tmp_path: Path, text: str) -> None:
    pytest.importorskip("jsonargparse")
    (tmp_path / "recipe.yaml").write_text(text)
    with pytest.raises(ValueError):
        make_recipe(CompensatorRecipe, tmp_path / "recipe.yaml", [])
    with pytest.raises(ValueError):
        make_recipe(CompensatorRecipe, None, [f"--recipe.{text.replace(': ', '=') or '='}"])


def test_numbers_by_level_have_the_form_of_the_other_commands() -> None:
    assert from_options("--recipe.loudness 50:0,65:-5").loudness == {50.0: 0.0, 65.0: -5.0}
    assert from_options("--recipe.loudness 65:-5").loudness == {65.0: -5.0}


@pytest.mark.parametrize("text", ["loudness: 1:30", "loudness: {50:0, 65: 5}", "steps: 1:30"])
def test_numbers_that_yaml_reads_in_base_60_are_errors(tmp_path: Path, text: str) -> None:
    pytest.importorskip("jsonargparse")
    (tmp_path / "recipe.yaml").write_text(text)
    with pytest.raises(ValueError, match="space after the colon"):
        make_recipe(CompensatorRecipe, tmp_path / "recipe.yaml", [])
    with pytest.raises(ValueError, match="space after the colon"):
        make_recipe(CompensatorRecipe, None, ["--recipe.model.channels", "1:30"])


def test_a_setting_that_is_given_twice_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "recipe.yaml"
    file.write_text("batch: 4\nsteps: 10\nbatch: 8\n")
    with pytest.raises(ValueError, match="'batch' occurs twice"):
        make_recipe(CompensatorRecipe, file, [])
    with pytest.raises(ValueError, match=r"--recipe\.batch appears twice"):
        make_recipe(CompensatorRecipe, None, ["--recipe.batch=4", "--recipe.batch=2"])
    with pytest.raises(ValueError, match="50 occurs twice"):
        make_recipe(CompensatorRecipe, None, ["--recipe.loudness={50: 0, 50.0: -9}"])
