"""Names, docstrings, comments and errors keep the mechanical rules of the style guide."""

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

FOLDERS = ("compensators", "docs/figures", "examples", "hlsim", "tests")

# Files that need not keep the rules. Remove yours when it is finished.
UNFINISHED = {
    "examples/machine_listener.py",
    "tests/test_language.py",  # It contains the phrases that it rejects.
    "tests/test_listening_page.py",
    "tests/test_machine_listener.py",
    "tests/test_readme.py",
}

# Rows of (file, rule, text) that may stay. A row that is no longer needed fails the test.
EXCEPTIONS: set[tuple[str, str, str]] = {
    ("hlsim/losses/hearing_loss.py", "name", "heard"),  # a public method
}

BANNED_NAMES = set(
    "given made told kept own found taken claimed held worn heard lasting begun one others each every "
    "tiny most never least faint far apart together nothing widest shown latest".split()
)
"""Participles, adjectives, pronouns and superlatives, which do not say what a variable holds."""

OPENING = re.compile(r"(What|Of|Its?|As|That|With|Whichever|How)\b")
"""Words with which no docstring and no description of a parameter can stand alone."""

PER = re.compile(
    r"\b(ones?|rows?|samples|values?|levels?|signals?|filters?|weights?|gains?|lines?|folders?|ears?"
    r"|listeners?|banks?|channels?|tones?|steps?|bytes?|numbers?|columns?|tensors?|items?|files?"
    r"|frequency|frequencies|severity|severities)"
    r" (an (item|ear|utterance|hour)|a (file|row|channel|step|frame|degree|bin|frequency|severity"
    r"|folder|line|type|hertz|second|machine))\b"
)
"""A noun followed by "an item" or "a file" where English says "per item" or "for each file"."""

DESCRIPTION = re.compile(r"^\s*[a-z_]\w*(?:, \w+)*: (?P<text>[A-Za-z]\w*)")
"""A parameter or an attribute in a docstring, and the first word of its description."""


def test_no_file_has_the_marks_of_a_conflict() -> None:
    folders = ("hlsim", "compensators", "checkpoints", "docs", "examples", "tests")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*")]
    texts = [*ROOT.glob("*.*"), *(path for path in files if path.suffix in {".md", ".py", ".js"})]
    mark = re.compile(r"^(<{7}|>{7}) ", re.MULTILINE)
    marked = [path for path in texts if path.is_file() and mark.search(path.read_text("utf-8"))]
    assert marked == []


def find_problems(source: str) -> Iterator[tuple[str, int, str]]:
    """Yield the rule, the line and the text of every violation in a module's source."""
    nodes = list(ast.walk(ast.parse(source)))
    docstrings = dict(_find_docstrings(nodes))
    for line, text in docstrings.items():
        yield from _check_docstring(line, text)
    if PER.search(source):  # or no comment can contain it, and tokens take most of the time
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT and (match := PER.search(token.string)):
                yield "per", token.start[0], match.group()
    for node in nodes:
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and node.lineno not in docstrings and "allowed:" in node.value:
            yield "error template", node.lineno, "allowed:"
        for name in _names_bound_by(node):
            if name.strip("_").lower() in BANNED_NAMES:
                yield "name", getattr(node, "lineno", 0), name
    for number, text in enumerate(source.splitlines(), 1):
        if len(text) > 100:
            yield "line length", number, f"{len(text)} columns"


def _find_docstrings(nodes: Iterable[ast.AST]) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of every string that is a statement of its own."""
    for node in nodes:
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield node.lineno, value.value


def _check_docstring(line: int, text: str) -> Iterator[tuple[str, int, str]]:
    opening = OPENING.match(text.lstrip())
    if opening:
        yield "opening", line, opening.group()
    for number, row in enumerate(text.splitlines()):
        description = DESCRIPTION.match(row)
        if description and OPENING.match(description["text"].capitalize()):
            yield "description", line + number, row.strip()
    for match in PER.finditer(" ".join(text.split())):
        yield "per", line, match.group()


def _names_bound_by(node: ast.AST) -> Iterator[str]:
    """Yield the names that a node binds: variables, parameters, functions and classes."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        yield node.id
    elif isinstance(node, ast.arg):
        yield node.arg
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        yield node.name


def test_docstrings_name_the_error_of_a_missing_extra() -> None:
    silent = []
    for path in sorted((ROOT / "hlsim").rglob("*.py")):
        functions = [n for n in ast.walk(ast.parse(path.read_text())) if type(n) is ast.FunctionDef]
        for function in functions:
            names = {node.id for node in ast.walk(function) if isinstance(node, ast.Name)}
            docstring = ast.get_docstring(function)
            if "require" in names and docstring and "MissingExtraError" not in docstring:
                silent.append(f"{path.name}:{function.lineno} {function.name}")
    assert silent == []


def finished_files() -> list[Path]:
    files = {path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    return sorted(files - {ROOT / name for name in UNFINISHED})


@pytest.mark.parametrize("path", finished_files(), ids=lambda path: str(path.relative_to(ROOT)))
def test_finished_file_keeps_the_rules(path: Path) -> None:
    file = str(path.relative_to(ROOT))
    allowed = {(rule, text) for name, rule, text in EXCEPTIONS if name == file}
    problems = list(find_problems(path.read_text()))
    unexpected = [
        f"{file}:{line}: {rule}: {text}"
        for rule, line, text in problems
        if (rule, text) not in allowed
    ]
    assert unexpected == []
    assert allowed <= {(rule, text) for rule, _, text in problems}, "an exception is not needed"
