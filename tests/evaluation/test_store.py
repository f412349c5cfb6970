"""Stored scores: their file, and lines that are cut short."""

import json
import math
from pathlib import Path

import pytest

from hlsim.evaluation.running.store import ScoreStore


def test_records_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "scores.jsonl"
    store = ScoreStore(path)
    store.append("a", {"score": 0.1 + 0.2})
    store.append("b", {"file": "ü"})
    with pytest.raises(ValueError):
        store.append("c", {"score": math.nan})
    again = ScoreStore(path)
    assert again.scores == store.scores == {"a": {"score": 0.1 + 0.2}, "b": {"file": "ü"}}
    again.append("a", {"score": 0.5})
    assert ScoreStore(path).scores == {"a": {"score": 0.5}, "b": {"file": "ü"}}
    again.append("a", {"score": 0.5}, ["too short"])
    assert ScoreStore(path).warnings == again.warnings == {"a": ["too short"]}
    again.append("a", {"score": 0.75})
    assert ScoreStore(path).warnings == again.warnings == {}


@pytest.mark.parametrize("cut", [2, 20])
def test_lines_that_are_cut_short_or_no_records_are_ignored(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "scores.jsonl"
    store = ScoreStore(path)
    for key in ("a", "b"):
        store.append(key, {"score": 0.25})
    no_records = b'\n[1]\nnonsense\n{"no": "key"}\n"text"\n{"key": "d", "values": 5}\n'
    path.write_bytes(no_records + path.read_bytes()[:-cut])
    damaged = ScoreStore(path)
    assert damaged.scores == {"a": {"score": 0.25}}
    damaged.append("c", {"score": 0.75})
    assert ScoreStore(path).scores == {"a": {"score": 0.25}, "c": {"score": 0.75}}


def test_each_line_of_the_file_is_a_score(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    for key in ("a", "b"):
        ScoreStore(path).append(key, {"score": 0.25})
    lines = path.read_text().split("\n")
    assert lines.pop() == ""
    assert [json.loads(line)["key"] for line in lines] == ["a", "b"]


def test_a_score_that_cannot_be_written_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"scores\.jsonl: a score cannot be written: .*run again"):
        ScoreStore(tmp_path / "file" / "scores.jsonl").append("a", {"score": 0.25})
