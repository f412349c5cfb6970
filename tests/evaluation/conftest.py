"""Fixtures of several evaluations: a table of ears, and quick scores."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hlsim.evaluation.measures import MEASURES
from tests.helpers import write_ears


@pytest.fixture
def ears_file(tmp_path: Path) -> Path:
    """Return a CSV file with the ears N3, N5 and S2."""
    return write_ears(tmp_path / "ears.csv", "N3", "N5", "S2")


@pytest.fixture
def quick_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace HASPI and HASQI, which take seconds, by scores that depend on the level only."""

    def score(name: str, highest: float) -> Any:
        return lambda item, output: {name: highest * float(output.std() / (output.std() + 0.1))}

    for name, highest in (("haspi", 1.0), ("hasqi", 0.5)):
        measure = replace(MEASURES[name], compute=score(name, highest))
        monkeypatch.setitem(MEASURES, name, measure)
