"""Stored scores: their file, lines that are cut short, and keys."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from hlsim.evaluation.store import ScoreStore, content_hash


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
def test_lines_that_are_cut_short_or_no_records_are_ignored(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "scores.jsonl"
    store = ScoreStore(path)
    for key in ("a", "b"):
        store.append(key, {"score": 0.25})
    no_records = b'\n[1]\nnonsense\n{"no": "key"}\n"text"\n'
    path.write_bytes(no_records + path.read_bytes()[:-cut])
    damaged = ScoreStore(path)
    assert damaged.records == {"a": {"score": 0.25}}
    damaged.append("c", {"score": 0.75})
    assert ScoreStore(path).records == {"a": {"score": 0.25}, "c": {"score": 0.75}}


@pytest.mark.parametrize(
    "call",
    [
        lambda folder: ScoreStore(folder),
        lambda folder: ScoreStore(folder / "file" / "s").append("a", {}),
        lambda folder: ScoreStore(folder / "new").append("a", {"score": math.nan}),
        lambda folder: content_hash(folder / "none.wav"),
    ],
)
def test_errors(tmp_path: Path, call: Callable[[Path], object]) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError):
        call(tmp_path)


def test_the_hash_of_a_file_is_its_sha_256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, the example of one block
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert content_hash(tmp_path / "a") == expected
