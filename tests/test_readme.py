"""README, documentation and cards: examples of the README run, commands exist, links lead to files."""

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

from hlsim.calibration import level_spl
from hlsim.cli.main import parse_arguments

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "checkpoints").glob("*/README.md")),
]


def _commands(page: Path) -> list[str]:
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    text = re.sub(r"\\\n\s*", "", "".join(blocks))
    return re.findall(r"(?:^|&& |^time )(?:\.venv/bin/)?hlsim (.*)$", text, re.MULTILINE)


def _named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_examples_of_the_readme_simulate_and_train(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    text = README.read_text(encoding="utf-8")
    for example in re.findall(r"<!-- example -->\n```python\n(.*?)```", text, re.DOTALL):
        exec(compile(example, str(README), "exec"), names)
    levels = [float(level_spl(names[name])) for name in ("unaided", "aided", "speech")]
    unaided, aided, original = levels
    assert unaided < original - 30.0
    assert aided == pytest.approx(original, abs=1.0)
    losses = re.findall(r"loss ([\d.]+)$", capsys.readouterr().out, re.MULTILINE)
    stated = re.search(r"# from ([\d.]+) to about ([\d.]+)$", text, re.MULTILINE)
    assert stated is not None and len(losses) == 20
    assert float(losses[0]) == pytest.approx(float(stated[1]), abs=0.002)
    assert float(losses[-1]) == pytest.approx(float(stated[2]), abs=0.01)
    gradients = [parameter.grad for parameter in names["network"].parameters()]
    assert all(bool(gradient.abs().sum() > 0) for gradient in gradients)


@pytest.mark.usefixtures("every_path_exists")
@pytest.mark.parametrize("page", [page for page in PAGES if _commands(page)], ids=_named)
def test_commands_parse(page: Path) -> None:
    for command in _commands(page):
        parse_arguments(shlex.split(command, comments=True))


def test_demo_and_tests_are_one_line_each() -> None:
    for marker, last in (("demo", "hlsim demo"), ("tests", "pytest")):
        found = re.search(
            rf"<!-- {marker} -->\n```sh\n(.*)\n```", README.read_text(encoding="utf-8")
        )
        assert found is not None and found[1].endswith(f"&& .venv/bin/{last}")


def test_the_address_to_clone_is_that_of_the_metadata() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address = project["urls"]["Repository"]
    assert f"`git clone {address} && cd hlsim`" in README.read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f'repository-code: "{address}"' in citation


@pytest.mark.parametrize("page", PAGES, ids=_named)
def test_linked_files_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for path in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / path).is_file(), path


def test_links_of_the_listening_page_lead_to_sections() -> None:
    html = (ROOT / "docs" / "listen" / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="\.\./(guide/[\w-]+)/(?:#([\w-]+))?"', html)
    assert links
    for path, section in links:
        text = (ROOT / "docs" / f"{path}.md").read_text(encoding="utf-8")
        headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
        anchors = [heading.lower().replace(" ", "-") for heading in headings]
        assert not section or section in anchors, path


@pytest.mark.parametrize("card", sorted((ROOT / "checkpoints").glob("*/README.md")), ids=_named)
def test_cards_are_short(card: Path) -> None:
    _, _, text = card.read_text(encoding="utf-8").split("---\n", 2)  # without the Hub's metadata
    assert len(text.splitlines()) <= 61 and "CC BY 4.0" in text


def test_notebooks_are_stored_without_outputs() -> None:
    for path in (ROOT / "docs" / "tutorials").glob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            assert not cell.get("outputs") and cell.get("execution_count") is None, path


def test_cells_of_notebooks_that_train_or_score_show_their_progress() -> None:
    shown = 0
    for path in (ROOT / "docs" / "tutorials").glob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            source = "".join(cell["source"])
            if "backward()" in source or "haspi(" in source:
                assert "ProgressLine" in source and " progress(" in source, path
                shown += 1
    assert shown == 3


def test_recipes_are_readable() -> None:
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("lightning")
    from compensators.loading import TRAINED
    from hlsim.neuro import NeuroConfig
    from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

    for path in (ROOT / "examples").glob("*.yaml"):
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        if path.name.startswith(("neuro-msbg", "any-teacher")):
            NeuroConfig.from_dict(SimulatorRecipe(**settings).model)
        else:
            recipe = CompensatorRecipe(**settings)
            TRAINED[recipe.kind].config_class.from_dict(recipe.model)
