"""The library uses no private name of torch, which the next release may rename."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = sorted([*(ROOT / "hlsim").rglob("*.py"), *(ROOT / "compensators").rglob("*.py")])


def names_of_torch(tree: ast.AST) -> Iterator[str]:
    """Find dotted names that begin with torch, such as ``torch.fft.rfft``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def private_part(name: str) -> str | None:
    """The name up to its first private part, or None."""
    match = re.match(r"torch(\.[a-zA-Z]\w*)*\._(?!_)\w+", name)
    return match and match[0]


def test_no_private_name_of_torch_is_used() -> None:
    names = set()
    for path in SOURCES:
        for name in names_of_torch(ast.parse(path.read_text())):
            if private := private_part(name):
                names.add((str(path.relative_to(ROOT)), private))
    assert not names
