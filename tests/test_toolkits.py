"""The programs of the guide to toolkits run where the toolkit is installed."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your-toolkit.md"


@pytest.mark.slow
@pytest.mark.parametrize("toolkit", ["speechbrain", "asteroid"])
def test_a_program_of_the_guide_trains(toolkit: str, tmp_path: Path) -> None:
    pytest.importorskip(toolkit, exc_type=ImportError)
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (program,) = [text for text in programs if toolkit in text]
    subprocess.run([sys.executable, "-c", program], check=True, cwd=tmp_path, timeout=600)
