"""Stored scores: their file, lines that are cut short, and keys."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from hlsim.evaluation.store import ScoreStore, content_hash, settings_hash


def test_records_are_read_again(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "scores.jsonl"
    store = ScoreStore(path)
    assert not path.exists() and len(store.records) == 0
    store.append("a", {"score": 0.1 + 0.2})
    store.append("b", {"score": 1.0, "file": "ü"})
    again = ScoreStore(path)
    assert again.get("a") == {"score": 0.1 + 0.2} == store.get("a")
    assert again.get("b") == {"score": 1.0, "file": "ü"} and again.get("c") is None
    again.append("a", {"score": 0.5})
    assert ScoreStore(path).get("a") == {"score": 0.5} and len(ScoreStore(path).records) == 2


@pytest.mark.parametrize("cut", [1, 5, 20])
def test_a_line_that_is_cut_short_is_ignored(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "scores.jsonl"
    store = ScoreStore(path)
    for key in ("a", "b"):
        store.append(key, {"score": 0.25})
    path.write_bytes(path.read_bytes()[:-cut])
    damaged = ScoreStore(path)
    assert damaged.get("a") == {"score": 0.25} and damaged.get("b") is None
    damaged.append("c", {"score": 0.75})
    again = ScoreStore(path)
    assert (again.get("a"), again.get("c")) == ({"score": 0.25}, {"score": 0.75})


def test_other_lines_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    path.write_text('[1]\nnonsense\n{"no": "key"}\n"text"\n{"key": "a", "score": 1}\n')
    assert len(ScoreStore(path).records) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda folder: ScoreStore(folder), "cannot read stored scores"),
        (lambda folder: ScoreStore(folder / "file" / "s").append("a", {}), "cannot store scores"),
        (lambda folder: ScoreStore(folder / "new").append("a", {"score": math.nan}), "JSON"),
        (lambda folder: content_hash(folder / "none.wav"), r"none\.wav: no such file"),
    ],
)
def test_errors(tmp_path: Path, call: Callable[[Path], object], message: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=message):
        call(tmp_path)


def test_hashes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, the example of one block
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert content_hash(tmp_path / "a") == expected
    first = settings_hash({"a": 1, "b": [1.0, 2.0]})
    assert first == settings_hash({"b": [1.0, 2.0], "a": 1})
    assert len({settings_hash({"a": value}) for value in (1, 2, "1", None)}) == 4
