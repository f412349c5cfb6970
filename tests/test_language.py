"""Names, docstrings, comments and errors of finished folders keep the mechanical rules of the style guide."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Folders and files that keep the rules. Add yours when it is finished.
FINISHED = [
    "compensators",
    "examples/auditory_nerve.py",
    "examples/benchmark.py",
    "examples/delay.py",
    "examples/draw_alignment.py",
    "examples/enhancers.py",
    "examples/fit_words.py",
    "examples/gradients.py",
    "examples/haspi_study.py",
    "examples/heard.py",
    "examples/mbstoi_parity.py",
    "examples/noise_reduction.py",
    "examples/other_sounds.py",
    "examples/paper/haspi_table.py",
    "examples/parity.py",
    "examples/pyclarity_teacher.py",
    "examples/score_parity.py",
    "examples/sliders.py",
    "examples/train_compensator.py",
    "examples/training/accelerate_loop.py",
    "examples/training/conv_tasnet.py",
    "examples/training/dead_region.py",
    "examples/training/dead_region_aid.py",
    "examples/training/filter_bank.py",
    "examples/training/haspi_objective.py",
    "examples/training/lightning_bf16.py",
    "examples/training/networks.py",
    "examples/training/your_criterion.py",
    "examples/validity.py",
    "examples/gpu.py",
    "examples/memory.py",
    "hlsim/audio.py",
    "hlsim/audiogram",
    "hlsim/calibration.py",
    "hlsim/checks.py",
    "hlsim/cli",
    "hlsim/demo.py",
    "hlsim/dsp",
    "hlsim/evaluation",
    "hlsim/export.py",
    "hlsim/extras.py",
    "hlsim/files.py",
    "hlsim/live.py",
    "hlsim/losses",
    "hlsim/metrics",
    "hlsim/msbg",
    "hlsim/neuro",
    "hlsim/plugins.py",
    "hlsim/checkpoint.py",
    "hlsim/report",
    "hlsim/shortcuts.py",
    "hlsim/torchtools.py",
    "hlsim/training",
    "tests/audiogram",
    "tests/cli",
    "tests/compensators",
    "tests/dsp",
    "tests/losses",
    "tests/evaluation",
    "tests/golden.py",
    "tests/metrics",
    "tests/msbg",
    "tests/neuro",
    "tests/conftest.py",
    "tests/pretend_device.py",
    "tests/test_calibration.py",
    "tests/test_devices.py",
    "tests/robustness",
    "tests/test_audio.py",
    "tests/test_checks.py",
    "tests/test_export.py",
    "tests/test_extras.py",
    "tests/test_files.py",
    "tests/test_live.py",
    "tests/test_checkpoint.py",
    "tests/test_shortcuts.py",
    "tests/test_situations.py",
    "tests/test_torchtools.py",
    "tests/report",
    "tests/test_demo.py",
    "tests/test_doctests.py",
    "tests/pyclarity.py",
    "tests/test_examples.py",
    "tests/test_layers.py",
    "tests/test_private_names.py",
    "tests/test_gpu_example.py",
    "tests/test_plugins.py",
    "tests/test_training_examples.py",
    "tests/test_wheel.py",
    "tests/training",
]

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


def find_problems(source: str) -> Iterator[tuple[str, int, str]]:
    """Yield the rule, the line and the text of every violation in a module's source."""
    tree = ast.parse(source)
    docstrings = dict(_find_docstrings(tree))
    for line, text in docstrings.items():
        yield from _check_docstring(line, text)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and (match := PER.search(token.string)):
            yield "per", token.start[0], match.group()
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and node.lineno not in docstrings and "allowed:" in node.value:
            yield "error template", node.lineno, "allowed:"
        for name in _names_bound_by(node):
            if name.strip("_").lower() in BANNED_NAMES:
                yield "name", getattr(node, "lineno", 0), name
    for number, text in enumerate(source.splitlines(), 1):
        if len(text) > 100:
            yield "line length", number, f"{len(text)} columns"


def _find_docstrings(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of every string that is a statement of its own."""
    for node in ast.walk(tree):
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


def finished_files() -> list[Path]:
    files: set[Path] = set()
    for name in FINISHED:
        path = ROOT / name
        files.update([path] if path.is_file() else path.rglob("*.py"))
    return sorted(files)


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
