"""Simulators are compared without the extra that needs a compiler."""

import math
import re
import sys
import tomllib
from pathlib import Path

import pytest
from torch import nn

import hlsim
import hlsim.export
from hlsim.extras import MissingExtraError
from tests.helpers import write_ears

ROOT = Path(__file__).parents[1]


def test_messages_ask_for_extras_of_users_only() -> None:
    """The extra dev has everything that the tests need, and docs what the site needs."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for package in ("hlsim", "compensators"):
        for path in (ROOT / package).rglob("*.py"):
            source = path.read_text()
            named = set(re.findall(r"""require\([\w."]+, (?:extra=)?"(\w+)"\)""", source))
            assert named <= extras.keys() - {"dev", "docs"}, path


def test_export_without_onnx_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    simulator = hlsim.load_pretrained("neuro-msbg")
    with pytest.raises(MissingExtraError, match=r"pip install 'hlsim\[onnx\]'"):
        hlsim.export.export_onnx(simulator, tmp_path / "ear.onnx", seconds=0.1)


def test_a_study_names_the_extra_of_stoi_before_it_begins(
    speech_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pandas")
    from hlsim.evaluation.measures import find_measures
    from hlsim.evaluation.simulators import evaluate_simulators

    monkeypatch.setitem(sys.modules, "pystoi", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'hlsim\[eval\]'"):
        find_measures(["haspi", "stoi"])
    with pytest.raises(MissingExtraError, match=r"pip install 'hlsim\[eval\]'"):
        evaluate_simulators({"exact": "msbg"}, speech=speech_dir, audiograms="standard", items=1)


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
    assert math.isnan(agreement(study.table, "pesq")["lcc"])
    page = simulators_page(study).markdown()
    assert "PESQ was left out" in page and "pip install 'hlsim[pesq]'" in page
