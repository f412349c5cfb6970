"""Simulators are compared without the extra that needs a compiler."""

import sys
from pathlib import Path

import pytest
from torch import nn

import hlsim
from tests.helpers import write_ears


def test_simulators_are_compared_without_pesq(
    speech_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("joblib", "matplotlib", "pandas", "pystoi"):
        pytest.importorskip(module)
    from hlsim.evaluation.simulators import agreement, evaluate_simulators
    from hlsim.report.simulators_page import simulators_page

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
