"""The store of scores: what it keeps, what a torn line costs, and what its keys depend on."""

import json
import math
from pathlib import Path

import pytest

from hlsim.evaluation.store import ScoreStore, content_hash, key_of


def test_what_is_appended_is_there_for_the_next(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "scores.jsonl"
    store = ScoreStore(path)
    assert not path.exists() and len(store) == 0
    store.append("a", {"score": 0.1 + 0.2})
    store.append("b", {"score": 1.0, "file": "ü"})
    assert path.read_text(encoding="utf-8").count("\n") == 2
    again = ScoreStore(path)
    assert again.get("a") == {"score": 0.1 + 0.2} == store.get("a")
    assert again.get("b") == {"score": 1.0, "file": "ü"} and again.get("c") is None
    again.append("a", {"score": 0.5})
    assert ScoreStore(path).get("a") == {"score": 0.5} and len(ScoreStore(path)) == 2


@pytest.mark.parametrize("cut", [1, 5, 20])
def test_a_line_cut_short_is_passed_over(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "scores.jsonl"
    store = ScoreStore(path)
    for key in ("a", "b"):
        store.append(key, {"score": 0.25})
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) - cut])
    torn = ScoreStore(path)
    # without its line end alone the record is whole
    assert torn.get("a") == {"score": 0.25} and (torn.get("b") is None) == (cut > 1)
    torn.append("c", {"score": 0.75})
    again = ScoreStore(path)
    assert (again.get("a"), again.get("c")) == ({"score": 0.25}, {"score": 0.75})


def test_lines_of_others_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    path.write_text('[1]\nnonsense\n{"no": "key"}\n"text"\n{"key": "a", "score": 1}\n')
    assert len(ScoreStore(path)) == 1


def test_without_a_path_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    store = ScoreStore()
    store.append("a", {"score": 1.0})
    assert store.get("a") == {"score": 1.0} and not list(tmp_path.iterdir())


def test_errors_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot store scores"):
        ScoreStore(tmp_path / "file" / "scores.jsonl").append("a", {"score": 1.0})
    with pytest.raises(ValueError, match="cannot read stored scores"):
        ScoreStore(tmp_path)
    with pytest.raises(ValueError, match="JSON"):
        ScoreStore(tmp_path / "x.jsonl").append("a", {"score": math.nan})
    with pytest.raises(ValueError, match=r"none\.wav: no such file"):
        content_hash(tmp_path / "none.wav")


def test_keys_and_hashes(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, the one-block example
    assert (
        content_hash(tmp_path / "a")
        == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
    assert key_of({"a": 1, "b": [1.0, 2.0]}) == key_of({"b": [1.0, 2.0], "a": 1})
    assert len({key_of({"a": value}) for value in (1, 2, "1", None)}) == 4
    assert json.loads(json.dumps(key_of({}))) == key_of({})
