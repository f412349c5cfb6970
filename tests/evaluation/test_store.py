"""The store of scores: what it keeps, what a torn line costs, and what its keys depend on."""

import json
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from compensators import NALR
from hlsim import MSBG, Audiogram
from hlsim.evaluation.store import ScoreStore, content_hash, key_of, weights_hash
from hlsim.pretrained import SIMULATOR, load_pretrained, shipped


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
    with pytest.raises(ValueError, match="scores cannot be stored"):
        ScoreStore(tmp_path / "file" / "scores.jsonl").append("a", {"score": 1.0})
    with pytest.raises(ValueError, match="cannot be read"):
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


def test_modules_that_differ_in_a_setting_differ_in_their_scores_name() -> None:
    modules = [
        MSBG(sample_rate=16000),
        MSBG(sample_rate=16000, rescale_active=True),
        MSBG(Audiogram.standard("N3"), sample_rate=16000),
        NALR(sample_rate=16000),
        NALR(Audiogram.standard("N3"), sample_rate=16000),
    ]
    assert len({weights_hash(module) for module in modules}) == len(modules)
    assert weights_hash(MSBG(sample_rate=16000)) == weights_hash(modules[0])


@dataclass
class Options:
    gain: float


@pytest.mark.parametrize("name", [*shipped([SIMULATOR])])
def test_a_checkpoint_is_the_same_whenever_it_is_loaded(name: str) -> None:
    once, again = load_pretrained(name), load_pretrained(name)
    again(torch.full((1600,), 0.01), Audiogram.standard("N3"))  # nor does use change it
    assert weights_hash(once) == weights_hash(again)


class Own(torch.nn.Module):
    """A module whose settings are no numbers."""

    def __init__(self, gains: Any) -> None:
        super().__init__()
        self._gains = gains


def test_settings_of_any_kind_tell_modules_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = (
        [1.0],
        [2.0],
        {"a": 1.0},
        {"a": 2.0},
        None,
        np.ones(2),
        np.zeros(2),
        torch.ones(3),
        torch.float32,
        Options(0.0),
        Options(20.0),
        partial(max, 1.0),
        partial(max, 2.0),
        [torch.nn.Linear(1, 1)],
    )
    hashes = [weights_hash(Own(gains)) for gains in kinds]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [weights_hash(Own(gains)) for gains in kinds]
    # of what cannot be told, a function without a name, nothing that was scored counts
    assert weights_hash(Own(lambda: 1.0)) != weights_hash(Own(lambda: 1.0))
    # what a class of one's own does counts too
    monkeypatch.setattr("inspect.getsource", lambda kind: "changed")
    assert weights_hash(Own([1.0])) != hashes[0]
