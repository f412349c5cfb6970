"""Recipes: what they refuse."""

from typing import Any

import pytest

from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

AID = {"kind": "hearing-aid"}


@pytest.mark.parametrize(
    ("recipe", "settings"),
    [
        (SimulatorRecipe, {"batch": 0}),
        (SimulatorRecipe, {"steps": 0}),
        (SimulatorRecipe, {"learning_rate": -1.0}),
        (SimulatorRecipe, {"epochs": 3}),
        (SimulatorRecipe, {"weights": {"loudness": 1.0}}),
        (SimulatorRecipe, {"precision": "float16"}),
        (SimulatorRecipe, {"average": 1.0}),
        (SimulatorRecipe, {"unit_power": "both"}),
        (SimulatorRecipe, {"seed": 2**62}),
        (SimulatorRecipe, {"levels": [80, 60]}),
        (SimulatorRecipe, {"sounds": 1.1}),
        (SimulatorRecipe, {"start": 3}),
        (SimulatorRecipe, {"learning_rate": "1e-3"}),  # text to YAML, which asks for 1.0e-3
        (SimulatorRecipe, {"learning_rate": float("nan")}),
        (SimulatorRecipe, {"learning_rate": True}),
        (SimulatorRecipe, {"batch": 2.5}),
        (SimulatorRecipe, {"batch": None}),
        (SimulatorRecipe, {"levels": 65}),
        (SimulatorRecipe, {"levels": [50, "loud"]}),
        (SimulatorRecipe, {"weights": None}),
        (SimulatorRecipe, {"weights": {"snr": "1"}}),
        (SimulatorRecipe, {"model": "small"}),
        (SimulatorRecipe, {"treated": "no way"}),
        (SimulatorRecipe, {1: 2}),
        (CompensatorRecipe, {"snr": 5}),
        (CompensatorRecipe, {"sounds": -0.5}),
        (CompensatorRecipe, {"noisy": 1.5}),
        (CompensatorRecipe, {"weights": {"bands": 0.0}}),
        (CompensatorRecipe, {"weights": {"haspi": 1.0}}),  # of clips too short for a score
        (CompensatorRecipe, {"kind": "vocoder"}),
        (CompensatorRecipe, {"weights": {"denoising": 1.0}}),  # without noise reduction
        (CompensatorRecipe, {"unreduced": 0.5}),
        (CompensatorRecipe, AID | {"weights": {"denoising": 1.0}, "noisy": 0.0}),
        (CompensatorRecipe, AID | {"babble": 0.5, "batch": 1}),
    ],
)
def test_bad_recipes(recipe: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        recipe.from_dict(settings)


def test_numbers_of_a_recipe_may_be_whole() -> None:
    recipe = SimulatorRecipe(weights={"snr": 2}, learning_rate=1, levels=[50, 60])  # type: ignore[arg-type]
    assert recipe.levels == (50, 60)
