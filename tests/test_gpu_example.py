"""The measurement of a GPU runs on a CPU, continues where it stopped and survives failing rows."""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from torch import Tensor, nn

from tests.helpers import load_figure

SMALL = ["--device", "cpu", "--small", "--minutes", "5", "--out"]


@pytest.fixture
def example() -> ModuleType:
    return load_figure("gpu.py")


def rows_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_gpu_measurement_on_a_cpu(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paper = {"cnn": {"structure": "dual-path", "channels": 8, "blocks": 1}}
    monkeypatch.setattr(example, "simulator_names", lambda: ["neuro-msbg"])
    monkeypatch.setattr(example, "CRITERIA", ["interaural"])
    timed = example.speed_subjects()[::12]
    monkeypatch.setattr(example, "speed_subjects", lambda: timed)
    monkeypatch.setattr(example, "scores", list)
    monkeypatch.setattr(example, "PAPER_NETWORKS", paper)
    example.main([*SMALL, str(tmp_path)])
    first = rows_of(tmp_path)
    assert not [row for row in first if "error" in row]
    assert {row["section"] for row in first} == set(example.SECTIONS)
    assert "== equality" in (tmp_path / "summary.txt").read_text()
    equal = [row for row in first if row["section"] == "equality"]
    assert all(row["default"]["float32"] == [0.0, 0.0] for row in equal)

    # what is there is not measured again
    example.main([*SMALL, str(tmp_path)])
    assert rows_of(tmp_path) == first


def test_gpu_measurement_goes_on_after_a_failing_row(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def fail(module: nn.Module, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
        raise RuntimeError("no such kernel")

    subjects = [
        example.Subject("broken", nn.Identity, fail),
        example.Subject("sound", nn.Identity, lambda module, wave, clean, ears: module(wave)),
    ]
    monkeypatch.setattr(example, "speed_subjects", lambda: subjects)
    example.main([*SMALL, str(tmp_path), "--only", "operations"])
    broken, sound = rows_of(tmp_path)
    assert "no such kernel" in broken["error"][-1] and "error" not in sound
    assert "FAILED RuntimeError: no such kernel" in (tmp_path / "summary.txt").read_text()
