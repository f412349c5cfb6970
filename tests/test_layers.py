"""Imports point downwards only, and there are no circles: CONTRIBUTING.md draws the floors."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# From the top. A room is a module or a package of hlsim, or the package compensators.
FLOORS = {
    "public names": "hlsim",
    "interface": "__main__ cli demo live shortcuts",
    "lab": "training evaluation report",
    "goals": "losses metrics",
    "models": "compensators neuro msbg export",
    "ground": (
        "audiogram dsp calibration audio checks files extras torchtools checkpoint plugins version"
    ),
}
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS.values()) for room in rooms.split()}

# Rows of a file and a room above it that it imports. A row that is not needed fails the test.
KNOWN_EXCEPTIONS: set[tuple[str, str]] = set()

# Rows of two rooms that import each other; the imports of the first one should be removed.
KNOWN_CIRCLES: set[tuple[str, str]] = set()

MOST_FILES = 16


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


def test_imports_point_downwards() -> None:
    upward = {
        (str(path.relative_to(ROOT)), room_of(imported))
        for module, path in MODULES.items()
        for imported in imported_modules(path)
        if FLOOR_OF[room_of(imported)] < FLOOR_OF[room_of(module)]
    }
    assert upward == KNOWN_EXCEPTIONS


def test_rooms_form_no_circle() -> None:
    below: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        rooms = {room_of(imported) for imported in imported_modules(path)}
        below.setdefault(room_of(module), set()).update(rooms - {room_of(module)})
    for file, room in KNOWN_EXCEPTIONS:
        below[room_of(module_of(ROOT / file))].discard(room)
    for room, other in KNOWN_CIRCLES:
        below[room].remove(other)
    TopologicalSorter(below).prepare()  # raises CycleError


def test_files_form_no_circle() -> None:
    imports = {module: set(imported_modules(path)) - {module} for module, path in MODULES.items()}
    TopologicalSorter(imports).prepare()  # raises CycleError


@pytest.mark.parametrize("room", sorted({path.parent for path in MODULES.values()}))
def test_folder_holds_at_most_16_files(room: Path) -> None:
    files = [path for path in room.iterdir() if path.is_file() and path.name != "py.typed"]
    assert len(files) <= MOST_FILES
