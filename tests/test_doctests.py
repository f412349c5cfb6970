"""Examples in docstrings print what they say, and every public function and class has one."""

import doctest
import importlib
import inspect
import re
from pkgutil import walk_packages

import pytest

import compensators
import hlsim
from tests.helpers import mostly_slow

# Modules in which a public function or class may lack an example, such as those of commands and
# pages, whose results are files. Remove yours when each has one.
WITHOUT_EXAMPLES = re.compile(
    r"hlsim\.(audiogram\.published|cli\..*|evaluation\.(clarity|demo)"
    r"|report\.(compensators|demo)_page|training\.trainer|version)"
)

MODULES = [
    module.name
    for package in (compensators, hlsim)
    for module in walk_packages(package.__path__, f"{package.__name__}.")
    if not module.ispkg and module.name != "hlsim.__main__"  # which would run a command
]

WITH_EXAMPLES = [name for name in MODULES if not WITHOUT_EXAMPLES.fullmatch(name)]


@pytest.fixture
def one_position(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure the look-ahead of aids at one position; all of them take most of the time."""
    monkeypatch.setattr("hlsim.evaluation.aid_properties.CHANGE_POSITIONS", [24001])


# The examples of these modules take a second or more, and the tests of the modules call the same.
SLOW_MODULES = {
    "hlsim.evaluation.compensators",
    "hlsim.evaluation.digits.speech_reception",
    "hlsim.export",
    "hlsim.metrics.haaqi_score",
    "hlsim.metrics.torchmetric",
    "hlsim.report.recordings_page",
    "hlsim.report.tables",
}


def test_slow_modules_exist() -> None:
    assert set(MODULES) >= SLOW_MODULES


@pytest.mark.usefixtures("one_position")
@pytest.mark.parametrize("name", mostly_slow(MODULES, set(MODULES) - SLOW_MODULES))
def test_examples_print_what_they_say(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0 or name not in WITH_EXAMPLES
    assert results.failed == 0  # pytest shows the differences, which doctest prints


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_every_public_function_and_class_has_an_example(name: str) -> None:
    module = importlib.import_module(name)
    without_example = [
        f"{name}.{member}"
        for member, value in vars(module).items()
        if callable(value)
        and getattr(value, "__module__", None) == name
        and not member.startswith("_")
        and ">>>" not in (inspect.getdoc(value) or "")
    ]
    assert without_example == []
