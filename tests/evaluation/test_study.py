"""A study's table: its rows, its failures, what is computed again, and what a kill costs."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim import Audiogram
from hlsim.evaluation import Condition, Item, Measure, ScoreStore, run_study
from hlsim.evaluation.measures import load_measure

pytest.importorskip("pandas")

N3 = Audiogram.standard("N3")


class Gain:
    """A condition that multiplies; its fingerprint is its factor."""

    def __init__(self, factor: float) -> None:
        self.fingerprint = self.factor = factor

    def __call__(self, signal: Tensor, ear: Audiogram) -> Tensor:
        if self.factor == 0.0:
            raise RuntimeError("no battery")
        return self.factor * signal


def peak(item: Item, output: Tensor) -> dict[str, float]:
    reference = item.once("reference", lambda: counted("reference", item.clean.abs().max()))
    return {"peak": float(counted("peak", output.abs().max())), "clean_peak": float(reference)}


def sign(item: Item, output: Tensor) -> dict[str, float]:
    if float(output[0]) < 0.0:
        raise ValueError("negative")
    return {"sign": 1.0}


calls: list[str] = []


def counted(what: str, value: Tensor) -> Tensor:
    calls.append(what)
    return value


MEASURES = [Measure("peak", peak), Measure("sign", sign)]


@pytest.fixture
def items() -> list[Item]:
    calls.clear()
    signals = [torch.full((8,), level) for level in (0.1, -0.2, 0.3)]
    return [
        Item(f"item {i}", signal, 2 * signal, N3, facts={"listener": f"L{i % 2}"})
        for i, signal in enumerate(signals)
    ]


def conditions(*factors: float) -> list[Condition]:
    return [Condition(f"times {factor:g}", Gain(factor)) for factor in factors]


def test_one_row_per_item_and_condition(items: list[Item]) -> None:
    seen: list[tuple[int, int]] = []
    table = run_study(items, conditions(1, 2), MEASURES, jobs=1, progress=lambda *n: seen.append(n))
    columns = ["item", "name", "listener", "condition", "peak", "clean_peak", "sign", "failure"]
    assert list(table.columns) == columns
    assert list(table.condition) == ["times 1", "times 2"] * 3
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.4, 0.8, 0.6, 1.2])
    reasons = ["", "", "negative", "negative", "", ""]
    assert table.failure.fillna("").tolist() == reasons
    assert calls.count("reference") == 3, "a reference is computed once per item"
    assert seen == [(0, 12), (4, 12), (8, 12), (12, 12)]


def test_an_error_is_the_reason_of_its_output_alone(items: list[Item]) -> None:
    table = run_study(items, conditions(0, 1), MEASURES, jobs=1)
    assert table.failure[table.condition == "times 0"].eq("RuntimeError: no battery").all()
    assert table.peak[table.condition == "times 1"].notna().all()


def test_only_what_is_missing_is_computed(items: list[Item], tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"

    def computed(*arguments: object) -> int:
        calls.clear()
        run_study(*arguments, store=ScoreStore(path), jobs=1)
        return calls.count("peak")

    first = run_study(items, conditions(1), MEASURES, store=ScoreStore(path), jobs=1)
    assert computed(items, conditions(1), MEASURES[:1]) == 0
    again = run_study(items, conditions(1), MEASURES, store=ScoreStore(path), jobs=1)
    assert again.equals(first)
    assert computed(items, conditions(1, 3), MEASURES[:1]) == 3, "one condition is new"
    renamed = [Condition("another name", Gain(1))]
    assert computed(items, renamed, MEASURES[:1]) == 0, "names do not count"
    changed = [
        replace(items[0], signal=items[0].signal + 1),
        replace(items[0], clean=items[0].clean + 1),
        replace(items[0], ear=Audiogram.standard("N4")),
        replace(items[0], seed=1),
    ]
    assert computed(changed, conditions(1), MEASURES[:1]) == 4
    assert computed(items, conditions(1), [replace(MEASURES[0], revision=2)]) == 3


def test_without_a_fingerprint_nothing_is_stored(items: list[Item]) -> None:
    store = ScoreStore()
    unknown = [Condition("mine", lambda signal, ear: signal)]
    with pytest.warns(UserWarning, match="scores with mine are not stored"):
        run_study(items, unknown, MEASURES[:1], store=store, jobs=1)
    assert len(store) == 0


def test_processes_change_nothing(items: list[Item]) -> None:
    pytest.importorskip("joblib")
    one, two = (run_study(items, conditions(1, 2), MEASURES, jobs=jobs) for jobs in (1, 2))
    assert two.equals(one)


def test_anyones_function_is_a_measure(
    items: list[Item], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("crest.py").write_text(
        "def crest(item, output):\n"
        "    return {'crest': output.abs().max() / output.square().mean().sqrt()}\n"
        "crest.fingerprint = '1'\n"
        "def wrong(item, output):\n"
        "    return 1.0\n"
    )
    measures = [load_measure("crest:crest"), load_measure("crest:wrong")]
    with pytest.warns(UserWarning, match="crest:wrong are not stored"):
        table = run_study(items, conditions(1), measures, jobs=2)
    assert table.crest.tolist() == pytest.approx([1.0] * 3)
    assert table.failure.str.contains("expected a dict of numbers").all()


SCRIPT = """
import sys, time, torch
from hlsim import Audiogram
from hlsim.evaluation import Condition, Item, Measure, ScoreStore, run_study

def slow(item, output):
    time.sleep(0.2)
    return {"sum": float(output.sum())}

def unchanged(signal, ear):
    return signal

unchanged.fingerprint = "unchanged"
ear = Audiogram.standard("N3")
items = [Item(str(i), torch.ones(8) * i, torch.ones(8) * i, ear) for i in range(12)]
conditions, measures = [Condition("unaided", unchanged)], [Measure("slow", slow)]
table = run_study(items, conditions, measures, store=ScoreStore(sys.argv[1]), jobs=1)
print(table["sum"].tolist())
"""


@pytest.mark.slow
def test_a_killed_run_continues_where_it_was(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SCRIPT, str(path)]
    with subprocess.Popen(command, env=environment) as process:
        end = time.monotonic() + 60
        while (not path.exists() or path.read_bytes().count(b"\n") < 3) and time.monotonic() < end:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    before = path.read_bytes()
    assert 3 <= before.count(b"\n") < 12
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert again.stdout.strip() == str([8.0 * i for i in range(12)])
    assert path.read_bytes().startswith(before) and path.read_bytes().count(b"\n") == 12
