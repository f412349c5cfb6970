"""What works without an extra."""

import subprocess
import sys
from pathlib import Path

import pytest

import hlsim

SCRIPT = """
import importlib, pkgutil, sys
sys.modules |= dict.fromkeys(("clarity", "numba"))  # as if neither were installed
import compensators, hlsim
for package in (compensators, hlsim):
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
import torch
from hlsim.metrics.registry import MEASURES, check_measures
speech = torch.sin(torch.arange(16000) * 0.2) * 0.05
score = MEASURES["haspi"].score(speech, speech, hlsim.Audiogram.standard("N1"), 16000, 94.0, 0)
assert 0.0 < score <= 1.0
try:
    check_measures(["haspi"], "pyclarity")
except ImportError as error:
    assert "pip install 'hlsim[pyclarity]'" in str(error)
else:
    raise AssertionError("pyclarity's engine without pyclarity")
"""


def test_all_but_its_own_engine_does_without_pyclarity() -> None:
    for module in ("torchmetrics", "lightning", "joblib", "matplotlib", "pandas"):
        pytest.importorskip(module)
    command = [sys.executable, "-c", SCRIPT]
    ended = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(hlsim.__file__).parents[1]
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
