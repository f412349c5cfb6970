"""The README's example runs as it stands there, and its commands exist."""

import re
import shlex
from pathlib import Path

import pytest

from hlsim.cli.main import _parser

README = Path(__file__).parent.parent / "README.md"


def _block(marker: str) -> str:
    found = re.search(rf"<!-- {marker} -->\n```\w+\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found[1]


def test_example_trains() -> None:
    names: dict[str, object] = {}
    exec(compile(_block("example"), str(README), "exec"), names)
    assert float(names["value"]) > 0  # type: ignore[arg-type]
    gradients = [parameter.grad for parameter in names["compensator"].parameters()]  # type: ignore[attr-defined]
    assert any(gradient is not None and bool(gradient.abs().sum() > 0) for gradient in gradients)


def test_example_is_about_ten_lines() -> None:
    assert len([line for line in _block("example").splitlines() if line.strip()]) <= 13


def test_commands_parse() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    text = re.sub(r"\\\n\s*", "", "".join(blocks))
    commands = re.findall(r"^(?:\.venv/bin/)?hlsim (.*)$", text, re.MULTILINE)
    assert len(commands) >= 3
    for command in commands:
        _parser().parse_args(shlex.split(command))


@pytest.mark.parametrize("path", re.findall(r"\]\(([\w/.-]+)\)", README.read_text(encoding="utf-8")))
def test_linked_files_exist(path: str) -> None:
    assert (README.parent / path).is_file()


def test_recipes_are_readable() -> None:
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("lightning")
    from compensators.pretrained import CONFIGS
    from hlsim.neuro import NeuroConfig
    from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

    for path in (README.parent / "examples").glob("*.yaml"):
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        if path.name.startswith(("neuro-msbg", "any-teacher")):
            NeuroConfig.from_dict(SimulatorRecipe.from_dict(settings).model)
        else:
            recipe = CompensatorRecipe.from_dict(settings)
            CONFIGS[recipe.kind].from_dict(recipe.model)
