"""The core works without the extras, and a missing extra is named in the error."""

import subprocess
import sys
from pathlib import Path

import pytest
from torch import nn

import hlsim
from tests.helpers import write_ears

SCRIPT = """
import importlib, pkgutil, sys
sys.modules |= dict.fromkeys(("clarity", "numba"))  # as if neither were installed
import compensators, hlsim
for package in (compensators, hlsim):
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
import torch
from hlsim.evaluation import MEASURES, Item
speech = torch.sin(torch.arange(16000) * 0.2) * 0.05
item = Item("speech", speech, speech, hlsim.Audiogram.standard("N1"))
assert 0.0 < MEASURES["haspi"].compute(item, speech)["haspi"] <= 1.0
"""


def test_everything_works_without_pyclarity() -> None:
    for module in ("torchmetrics", "lightning", "joblib", "matplotlib", "pandas"):
        pytest.importorskip(module)
    command = [sys.executable, "-c", SCRIPT]
    ended = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(hlsim.__file__).parents[1]
    )
    assert ended.returncode == 0, ended.stderr[-2000:]


def test_simulators_are_compared_without_pesq(
    speech_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("joblib", "matplotlib", "pandas", "pystoi"):
        pytest.importorskip(module)
    from hlsim.evaluation.simulators import agreement, evaluate_simulators
    from hlsim.report.simulators import simulators_page

    monkeypatch.setitem(sys.modules, "pesq", None)
    ears = write_ears(tmp_path / "ears.csv", "N3")
    simulators: dict[str, nn.Module] = {"exact": hlsim.MSBG(sample_rate=16000)}
    speech = speech_dir / "valid"
    study = evaluate_simulators(
        simulators, speech=speech, audiograms=ears, items=4, seconds=1.0, jobs=1
    )
    assert study.table.stoi_simulator.notna().all() and "pesq_simulator" not in study.table
    assert agreement(study.table, "pesq")["lcc"] is None
    page = simulators_page(study).markdown()
    assert "PESQ was left out" in page and "pip install 'hlsim[pesq]'" in page
