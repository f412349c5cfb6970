"""Simulators compared with their teacher: values, failures, statistics, and the page."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.cli.main import main
from hlsim.evaluation.simulators import evaluate_simulators
from hlsim.metrics.fidelity import snr_db, stoi
from hlsim.report.simulators_page import simulators_page

pandas = pytest.importorskip("pandas")
for module in ("pystoi", "pesq", "matplotlib"):
    pytest.importorskip(module)


class Unimpaired(nn.Module):
    """Normal ear, which fails for losses of more than a limit at 4 kHz."""

    fingerprint = "1"

    def __init__(self, highest: float = math.inf) -> None:
        super().__init__()
        self.highest = highest

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform * math.nan if audiogram.thresholds[5] > self.highest else waveform


@pytest.fixture
def options(speech_dir: Path, ears_file: Path) -> dict[str, Any]:
    folders = {"speech": speech_dir / "valid", "noise": speech_dir / "train"}
    return {**folders, "audiograms": ears_file, "items": 8, "seconds": 1.0, "jobs": 1}


@pytest.mark.parametrize("setting", [{"sample_rate": 44100}, {"full_scale_spl": 100.0}])
def test_a_simulator_for_other_signals_is_rejected(
    options: dict[str, Any], setting: dict[str, Any]
) -> None:
    with pytest.raises(ValueError, match="expected a simulator with"):
        evaluate_simulators({"mine": MSBG(**setting)}, **options)


def test_values_failures_and_page(options: dict[str, Any]) -> None:
    simulators = {"light": load_pretrained("neuro-msbg"), "none": Unimpaired(60.0)}
    study = evaluate_simulators(simulators, **options, inputs=("as-is", "louder"), listen=1)
    table = study.table
    row, item = table[table.condition == "light"].iloc[0], study.items[0].load()
    with torch.no_grad():
        expected = MSBG()(item.signal, item.ear)
        output = study.conditions[0].output(item)
    assert row.snr == snr_db(expected, output) > 15.0
    assert row.stoi_teacher == stoi(expected, item.clean, 16000)
    assert row.stoi_simulator == stoi(output, item.clean, 16000)
    assert row.pesq_teacher == pytest.approx(row.pesq_simulator, abs=0.3)
    exceeds = table.audiogram.map(lambda thresholds: thresholds[5] > 60.0)
    failed = (table.condition == "none") & exceeds
    assert failed.any() and table.failure[failed].str.contains("NaN").all()
    assert table.snr[failed].isna().all() and table.snr[~failed].notna().all()
    (comparison,) = study.groups["as-is"].comparisons
    assert (comparison.before, comparison.after) == ("light", "none")
    assert comparison.overall.delta < -10.0
    page = simulators_page(replace(study, notes=["3 items end in silence."]))
    paragraphs = [section.paragraphs for section in page.sections[:2]]
    assert paragraphs == [["3 items end in silence."], []]
    assert page.verdict.startswith("Speech as it is: light has a median SNR")
    titles = [section.title for section in page.sections[:3]]
    assert titles == ["Speech as it is", "20 dB louder", "Listen"]
    (sounds,) = study.sounds
    assert ": as-is, " in sounds.name
    labels = [sound.label for sound in page.sections[2].sections[0].player.sounds[:3]]
    assert labels == ["input", "teacher", "light"]
    assert "Failures" in page.markdown() and "NaN" in page.markdown()


class Soft(nn.Module):
    """Simulator that rejects loud signals."""

    def forward(self, waveform: Tensor, ear: Any) -> Tensor:
        if float(waveform.abs().max()) > 3.0:
            raise ValueError("too loud")
        return waveform


def test_a_treatment_without_any_value_does_not_prevent_the_page(options: dict[str, Any]) -> None:
    settings = {**options, "items": 1, "levels": [80.0], "inputs": ("louder", "as-is")}
    study = evaluate_simulators({"soft": Soft()}, **settings, listen=1)
    assert study.groups["louder"].table["snr"].isna().all()
    assert ": as-is, " in study.sounds[0].name
    page = simulators_page(study)
    assert page.verdict.startswith("Speech as it is: soft has a median SNR")
    assert page.markdown().count("too loud") == 1
    quiet = evaluate_simulators({"soft": Soft()}, **{**settings, "levels": [50.0]}, listen=1)
    assert quiet.sounds[0].name.endswith("louder, clean, 70 dB SPL")


def test_an_evaluation_without_any_snr_names_the_reason(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any) -> float:
        raise ValueError("the score is broken")

    (tmp_path / "mine.py").write_text("def count(item, output):\n    return {'count': len(output)}")
    monkeypatch.setattr("hlsim.metrics.fidelity.snr_db", fail)
    settings = {**options, "items": 1, "measures": [f"{tmp_path}/mine.py:count"]}
    with pytest.raises(ValueError, match=r"none of 1 items has a value of snr; .*score is broken"):
        evaluate_simulators({"soft": Soft()}, **settings)


TEACHERS = """
def same(waveform, audiogram):
    return waveform
def half(waveform, audiogram):
    return waveform / 2
same.fingerprint = half.fingerprint = "1"
"""


def test_each_teacher_has_its_own_values(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("teachers.py").write_text(TEACHERS)
    store = tmp_path / "scores.jsonl"
    options |= {"items": 1, "store": store}
    for lines, teacher in ((1, "teachers:same"), (2, "teachers:half"), (2, "teachers:half")):
        study = evaluate_simulators({"none": Unimpaired()}, **options, teacher=teacher)
        assert store.read_text().count("\n") == lines
    assert study.table.snr.iloc[0] == pytest.approx(0.0, abs=1e-6)


def test_command(
    options: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, light = tmp_path / "out", "neuro-msbg"
    command = ["evaluate-simulator", "exact=msbg", light, "--speech", options["speech"]]
    command += ["--audiograms", options["audiograms"], "--items", 2, "--seconds", 1, "--jobs", 1]
    assert main([str(part) for part in (*command, "--out", out)]) == 0
    printed = capsys.readouterr().out
    assert f"The page: {(out / 'report.html').as_uri()}" in printed
    result = json.loads((out / "report.json").read_text())
    exact = [row["snr"] for row in result["rows"] if row["condition"] == "exact"]
    assert len(exact) == 2 and min(exact) > 100.0
    assert light in (out / "report.md").read_text()
