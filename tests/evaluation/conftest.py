"""A table of ears for several evaluations."""

from pathlib import Path

import pytest

from tests.helpers import write_ears


@pytest.fixture
def ears_file(tmp_path: Path) -> Path:
    """Return a CSV file with the ears N3, N5 and S2."""
    return write_ears(tmp_path / "ears.csv", "N3", "N5", "S2")
