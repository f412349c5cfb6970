"""Imports point downwards only, and there are no circles: CONTRIBUTING.md draws the floors."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From the top. A room is a module or a package of hlsim, or the package compensators.
FLOORS = [
    "hlsim __main__",
    "cli shortcuts",
    "report training",
    "evaluation losses export",
    "compensators simulators",
    "neuro",
    "data metrics msbg",
    "audiogram dsp calibration audio checkpoint",
    "checks files extras progress torchtools plugins version",
]
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms.split()}

MOST_FILES = 16
MOST_ARROWS = 130  # Each is a pair of rooms, one of which imports the other.


def source_files() -> list[Path]:
    return sorted([*(ROOT / "hlsim").rglob("*.py"), *(ROOT / "compensators").rglob("*.py")])


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path): path for path in source_files()}


def room_of(module: str) -> str:
    top, _, below = module.partition(".")
    return below.partition(".")[0] if top == "hlsim" and below else top


def imported_modules(path: Path) -> Iterator[str]:
    """Return the modules of the project that a file imports, in functions and for types, too."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import"
            submodules = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else str(node.module) for name in submodules]
        yield from (name for name in names if name in MODULES)


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """Modules of the project that each module imports."""
    return {module: set(imported_modules(path)) - {module} for module, path in MODULES.items()}


def test_imports_between_rooms_point_downwards(imports: dict[str, set[str]]) -> None:
    upward = {
        (module, imported)
        for module, names in imports.items()
        for imported in names
        if room_of(imported) != room_of(module)
        and FLOOR_OF[room_of(imported)] <= FLOOR_OF[room_of(module)]
    }
    assert upward == set()


def test_rooms_and_files_form_no_circle(imports: dict[str, set[str]]) -> None:
    rooms: dict[str, set[str]] = {}
    for module, names in imports.items():
        rooms.setdefault(room_of(module), set()).update(map(room_of, names))
    TopologicalSorter({room: below - {room} for room, below in rooms.items()}).prepare()
    TopologicalSorter(imports).prepare()  # raises CycleError


def test_few_rooms_import_each_other(imports: dict[str, set[str]]) -> None:
    pairs = {(room_of(module), room_of(name)) for module in imports for name in imports[module]}
    arrows = {(room, below) for room, below in pairs if room != below}
    assert len([room for room, _ in arrows if room not in ("hlsim", "__main__")]) <= MOST_ARROWS


@pytest.mark.parametrize("room", sorted({path.parent for path in MODULES.values()}))
def test_folder_holds_at_most_16_files(room: Path) -> None:
    files = [path for path in room.iterdir() if path.is_file() and path.name != "py.typed"]
    assert len(files) <= MOST_FILES


def test_contributing_draws_these_floors() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    picture = text.split("```text\n")[1].split("```")[0].splitlines()
    assert len(picture) == len(FLOORS)
    for line, rooms in zip(picture, FLOORS, strict=True):
        assert set(rooms.split()) - {"__main__"} <= set(line.split())
