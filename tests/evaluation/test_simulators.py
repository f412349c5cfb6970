"""Simulators against their teacher: what is measured, what fails, how it is summarised, and the page."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.cli.main import main
from hlsim.evaluation import Evaluation
from hlsim.evaluation.simulators import agreement, evaluate_simulators, example_item
from hlsim.metrics.fidelity import snr_db, stoi
from hlsim.report.results import ordered
from hlsim.report.simulators import COLUMNS, simulators_page

pandas = pytest.importorskip("pandas")
for module in ("pystoi", "pesq", "matplotlib"):
    pytest.importorskip(module)


class Unimpaired(nn.Module):
    """No simulator at all; it fails for ears with a loss of more than 60 dB at 4 kHz."""

    fingerprint = "1"

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        if audiogram.thresholds[5] > 60.0:
            return waveform * math.nan
        return waveform


class Same(nn.Module):
    """The input itself."""

    fingerprint = "1"

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        return waveform


@pytest.fixture
def options(tmp_path: Path, speech_dir: Path) -> dict[str, Any]:
    rows = [Audiogram.standard(name).to_row() for name in ("N2", "N5")]
    ears = tmp_path / "ears.csv"
    ears.write_text("\n".join([",".join(rows[0]), *(",".join(row.values()) for row in rows)]))
    folders = {"speech": speech_dir / "valid", "noise": speech_dir / "train", "audiograms": ears}
    return {**folders, "items": 8, "seconds": 1.0, "jobs": 1}


@pytest.fixture
def study(options: dict[str, Any]) -> Evaluation:
    simulators = {"light": load_pretrained("neuro-msbg-light"), "none": Unimpaired()}
    return evaluate_simulators(simulators, **options, inputs=("as-is", "louder"))


def test_values_are_those_of_the_metrics_against_the_exact_model(study: Evaluation) -> None:
    light = study.conditions[0]
    row = study.table[study.table.condition == "light"].iloc[0]
    item = study.items[0].load()
    with torch.no_grad():
        expected = MSBG(sample_rate=16000)(item.signal, item.ear)
        output = light.output(item)
    assert row.snr == snr_db(expected, output) > 15.0
    assert row.stoi_teacher == stoi(item.clean, expected, 16000).value
    assert row.stoi_simulator == stoi(item.clean, output, 16000).value
    assert row.pesq_teacher == pytest.approx(row.pesq_simulator, abs=0.3)


def test_a_simulator_that_fails_or_is_none_is_seen(study: Evaluation) -> None:
    table = study.table
    deaf = table.audiogram.map(lambda thresholds: thresholds[5] > 60.0)
    failed = (table.condition == "none") & deaf
    assert failed.any() and table.failure[failed].str.contains("NaN").all()
    assert table.snr[failed].isna().all() and table.snr[~failed].notna().all()
    (comparison,) = study.groups["as-is"].comparisons
    assert (comparison.before, comparison.after) == ("light", "none")
    assert comparison.overall.delta < -10.0
    page = simulators_page(study, listen=1)
    assert page.verdict.startswith("Speech as it is: light has a median SNR")
    assert [section.title for section in page.sections[:3]] == [
        "Speech as it is",
        "20 dB louder",
        "Listen",
    ]
    listen = page.sections[2]
    item, teacher = example_item(study)
    assert item.facts["treatment"] == "as-is" and teacher.shape == item.signal.shape
    assert [player.label.split(",")[0] for player in listen.players[:3]] == [
        "input",
        "teacher",
        "light",
    ]
    assert "Failures" in page.markdown() and "NaN" in page.markdown()


def test_another_teacher_has_its_own_values(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = "def {name}(waveform, audiogram):\n    return {factor} * waveform\n{name}.fingerprint = '1'\n"
    Path("teachers.py").write_text(
        text.format(name="same", factor=1.0) + text.format(name="half", factor=0.5)
    )
    store = tmp_path / "scores.jsonl"
    options |= {"items": 1, "store": store}
    for lines, teacher in ((1, "teachers:same"), (2, "teachers:half"), (2, "teachers:half")):
        study = evaluate_simulators({"none": Same()}, **options, teacher=teacher)
        assert store.read_text().count("\n") == lines
    assert study.table.snr.iloc[0] == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(ValueError, match="teachers"):
        evaluate_simulators({"none": Same()}, **options, teacher="teachers:nobody")


def rows(count: int) -> Any:
    generator = np.random.default_rng(0)
    table = pandas.DataFrame(
        {
            "severity": ["severe", "mild"] * (count // 2),
            "input_level": [50.0, 65.0, 65.0, 80.0] * (count // 4),
            "snr": generator.uniform(10.0, 30.0, count),
            "band_error": generator.uniform(0.0, 1.0, count),
            "stoi_teacher": generator.uniform(0.0, 1.0, count),
        }
    )
    table["raw_mse"] = 10.0 ** (-table.snr / 10.0)
    table["stoi_simulator"] = 0.9 * table.stoi_teacher
    return table


def test_columns_are_those_of_the_rows_that_have_values() -> None:
    table = rows(8)
    table.loc[0, ["snr", "stoi_teacher"]] = math.nan
    values = {title: get(table) for title, (get, _) in COLUMNS.items()}
    assert values["n"] == 7 and values["SNR median (dB)"] == table.snr[1:].median()
    assert values["SNR worst tenth (dB)"] == pytest.approx(np.percentile(table.snr[1:], 10))
    assert values["STOI LCC"] == values["STOI SRCC"] == pytest.approx(1.0)
    assert agreement(table, "pesq") == {"lcc": None, "srcc": None, "mse": None}
    assert ordered(table.severity.unique()) == ["mild", "severe"]


@pytest.mark.parametrize(
    "changes",
    [
        {"simulators": {}},
        {"items": 0},
        {"inputs": ("as-is", "as-is")},
        {"inputs": ("softer",)},
        {"inputs": ("compensated",)},
        {"seconds": 0.01},
        {"teacher": "nobody"},
    ],
)
def test_what_cannot_be_compared_is_rejected(
    options: dict[str, Any], changes: dict[str, Any]
) -> None:
    settings = {"simulators": {"none": Unimpaired()}, **options, **changes}
    with pytest.raises(ValueError):
        evaluate_simulators(**settings)


def test_command(options: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [
        "evaluate-simulator",
        "exact=msbg",
        "neuro-msbg-light",
        "--speech",
        options["speech"],
    ]
    command += [
        "--audiograms",
        options["audiograms"],
        "--items",
        "2",
        "--seconds",
        "1",
        "--jobs",
        "1",
    ]
    assert main([str(part) for part in (*command, "--out", out)]) == 0
    result = json.loads((out / "report.json").read_text())
    exact = [row["snr"] for row in result["rows"] if row["condition"] == "exact"]
    assert len(exact) == 2 and min(exact) > 100.0
    assert "neuro-msbg-light" in (out / "report.md").read_text()
