"""A study's table: its rows, its failures, stored values, and a run that is killed."""

import math
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hlsim import Audiogram
from hlsim.evaluation import Condition, Item, Measure, ScoreStore, run_study
from hlsim.evaluation.conditions import Enhanced, PluginAid, Unaided
from hlsim.evaluation.measures import load_measure
from hlsim.extras import MissingExtraError
from hlsim.plugins import WaveformPlugin, load_plugin

pytest.importorskip("pandas")

N3 = Audiogram.standard("N3")
CALLS: list[str] = []


class Gain:
    """Condition that multiplies. Its fingerprint is its factor."""

    def __init__(self, factor: float) -> None:
        self.fingerprint = self.factor = factor

    def __call__(self, signal: Tensor, ear: Audiogram) -> Tensor:
        if self.factor == 0.0:
            raise RuntimeError("no battery")
        return self.factor * signal


class Short:
    """Condition that loses a sample."""

    fingerprint = "short"

    def __call__(self, signal: Tensor, ear: Audiogram) -> Tensor:
        return signal[..., :-1]


def count_call(name: str, value: Tensor) -> Tensor:
    CALLS.append(name)
    return value


def peak(item: Item, output: Tensor) -> dict[str, float]:
    reference = item.once("reference", lambda: count_call("reference", item.clean.abs().max()))
    return {"peak": float(count_call("peak", output.abs().max())), "clean_peak": float(reference)}


def sign(item: Item, output: Tensor) -> dict[str, float]:
    if float(output[0]) < 0.0:
        raise ValueError("negative")
    return {"sign": 1.0}


MEASURES = [Measure("peak", peak), Measure("sign", sign)]


@pytest.fixture
def items() -> list[Item]:
    CALLS.clear()
    signals = [torch.full((8,), level) for level in (0.1, -0.2, 0.3)]
    return [
        Item(f"item {i}", signal, 2 * signal, N3, facts={"listener": f"L{i % 2}"})
        for i, signal in enumerate(signals)
    ]


def gains(*factors: float) -> list[Condition]:
    return [Condition(f"times {factor:g}", Gain(factor)) for factor in factors]


def test_there_is_one_row_per_item_and_condition(items: list[Item]) -> None:
    progress: list[tuple[int, int]] = []
    table = run_study(items, gains(1, 2), MEASURES, jobs=1, progress=lambda *n: progress.append(n))
    columns = ["item", "name", "listener", "condition", "peak", "clean_peak", "sign", "failure"]
    assert list(table.columns) == columns
    assert list(table.condition) == ["times 1", "times 2"] * 3
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.4, 0.8, 0.6, 1.2])
    assert table.failure.fillna("").tolist() == ["", "", "negative", "negative", "", ""]
    assert CALLS.count("reference") == 3, "a reference is computed once per item"
    assert (progress[0], progress[-1]) == ((0, 12), (12, 12))


def test_equal_names_and_empty_lists_are_rejected(items: list[Item]) -> None:
    valid: dict[str, Any] = {"items": items, "conditions": gains(1), "measures": MEASURES}
    for name, values, message in (
        ("conditions", gains(1, 1), "two of the conditions are called times 1"),
        ("measures", [MEASURES[0], replace(MEASURES[1], name="peak")], "measures are called peak"),
        ("items", [replace(items[0], facts={"item": "s01"})], "columns? .* called item"),
        ("items", [replace(items[0], facts={"failure": "none"})], "columns? .* called failure"),
        *((name, [], f"expected .*{name[:-1]}") for name in valid),
    ):
        with pytest.raises(ValueError, match=message):
            run_study(**{**valid, name: values}, jobs=1)


def test_changes_in_place_do_not_reach_other_conditions_and_measures(
    items: list[Item], tmp_path: Path
) -> None:
    def double(signal: Tensor, ear: Audiogram) -> Tensor:
        return signal.mul_(2.0)

    def silence(item: Item, output: Tensor) -> dict[str, float]:
        output.zero_()
        return {"zero": 0.0}

    file = tmp_path / "own.py"
    file.write_text("def silence(item, output): item.clean.zero_(); return {'clean': 0.0}")
    measures = [Measure("zero", silence), load_measure(f"{file}:silence"), MEASURES[0]]
    table = run_study(items, [Condition("in place", double), *gains(1)], measures, jobs=1)
    assert table["peak"].tolist() == pytest.approx([0.4, 0.2, 0.8, 0.4, 1.2, 0.6])
    assert table["clean_peak"].tolist() == pytest.approx([0.1, 0.1, 0.2, 0.2, 0.3, 0.3])


MODE = """
from torch import nn
class Mode(nn.Module):
    def forward(self, item, output):
        return {"training": self.training}
"""


def test_a_module_that_measures_is_in_evaluation_mode(items: list[Item], tmp_path: Path) -> None:
    file = tmp_path / "mode.py"
    file.write_text(MODE)
    measures = [load_measure(f"{file}:Mode"), Measure("mode", load_plugin(f"{file}:Mode", "mode"))]
    for measure in measures:
        assert run_study(items, gains(1), [measure], jobs=1)["training"].tolist() == [0.0] * 3


def test_a_module_is_in_evaluation_mode(items: list[Item]) -> None:
    class Random(torch.nn.Dropout):
        def forward(self, signal: Tensor, ear: Any = None) -> Tensor:
            return super().forward(signal)

    table = run_study(items, [Condition("aid", Random(1.0).train())], MEASURES[:1], jobs=1)
    assert table["peak"].tolist() == pytest.approx([0.2, 0.4, 0.6])


class ItemOfFile(Item):
    """Item whose clean signal has the name of its listener."""

    @property
    def clean_name(self) -> str:
        return str(self.facts["listener"])


def test_items_with_the_same_clean_signal_are_measured_after_each_other(items: list[Item]) -> None:
    order = []

    def note(item: Item, output: Tensor) -> dict[str, float]:
        order.append(item.name)
        return {"note": 1.0}

    sources = [
        ItemOfFile(item.name, item.clean, item.signal, N3, facts=item.facts) for item in items
    ]
    table = run_study(sources, gains(1), [Measure("note", note)], jobs=1)
    assert order == ["item 0", "item 2", "item 1"]
    assert list(table.name) == ["item 0", "item 1", "item 2"]


@pytest.mark.parametrize("kind", [float, np.float32, torch.tensor])
def test_numbers_of_any_type_are_stored_and_must_be_finite(
    items: list[Item], kind: Callable[[float], Any]
) -> None:
    store = ScoreStore()
    values = iter([1.0, math.nan, 3.0])
    measure = Measure("own", lambda item, output: {"own": kind(next(values))})
    table = run_study(items, gains(1), [measure], store=store, jobs=1)
    assert sorted(values["own"] for values in store.scores.values()) == [1.0, 3.0]
    assert table["own"].isna().tolist() == table["failure"].notna().tolist() == [False, True, False]


def resize(samples: int) -> Callable[[Tensor, Audiogram], Tensor]:
    """Return a condition whose output is longer, or shorter if the number is negative."""
    return lambda signal, ear: torch.cat((signal, torch.ones(1601)))[: len(signal) + samples]


@pytest.mark.parametrize(
    ("process", "failure"),
    [
        (Gain(0), "RuntimeError: no battery"),
        (lambda signal, ear: signal / 0.0, "NaN or infinite"),
        (lambda signal, ear: signal.numpy(), "floating-point output of shape (8,), got ndarray"),
        (resize(1601), "a difference of 0.1 s"),
    ],
)
def test_an_error_ends_only_its_output(items: list[Item], process: Any, failure: str) -> None:
    table = run_study(items[:1], [Condition("c", process), *gains(1)], MEASURES, jobs=1)
    assert failure in table.failure[0] and table.peak[1] == pytest.approx(0.2)


@pytest.mark.parametrize("samples", [-3, 1, 1600])
def test_item_and_output_are_cut_to_the_shorter_length_with_a_warning(
    items: list[Item], samples: int
) -> None:
    with pytest.warns(UserWarning, match="both are cut to the shorter length"):
        table = run_study(items, [Condition("c", resize(samples))], MEASURES[:1], jobs=1)
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.6])


def test_a_column_that_exists_is_rejected(items: list[Item]) -> None:
    measure = Measure("copy", lambda item, output: {"listener": 1.0}, settings="1")
    with pytest.raises(ValueError, match="listener, a column that exists already"):
        run_study(items, gains(1), [measure], jobs=1)


def test_a_measure_without_a_value_for_one_item_is_a_failure_of_this_item(
    items: list[Item],
) -> None:
    def compute(item: Item, output: Tensor) -> dict[str, float]:
        return {"own": 1.0} if item.name == items[0].name else {}

    table = run_study(items, gains(1), [MEASURES[0], Measure("mine", compute)], jobs=1)
    assert table["failure"].isna().tolist() == [True, False, False]
    assert table["failure"].iloc[0] is None
    assert table["failure"].iloc[-1] == "mine has returned no own"
    assert table["peak"].notna().all()


# A page would write PEAK for the columns peak and Peak.
@pytest.mark.parametrize(
    "column", ["failure", "condition", "gap", "level_over_nal_r", "peak", "Peak"]
)
def test_a_column_of_the_table_is_rejected_at_the_first_value(
    items: list[Item], column: str
) -> None:
    calls = []

    def compute(item: Item, output: Tensor) -> dict[str, float]:
        calls.append(item.name)
        return {column: 1.0}

    with pytest.raises(ValueError, match=f"own returns {column}, a column that exists already"):
        run_study(items, gains(1), [MEASURES[0], Measure("own", compute)], jobs=1)
    assert len(calls) == 1


def test_columns_of_one_measure_that_differ_only_in_case_are_rejected(items: list[Item]) -> None:
    measure = Measure("own", lambda item, output: {"Score": 1.0, "score": 2.0})
    with pytest.raises(ValueError, match="own returns score, a column that exists already"):
        run_study(items[:1], gains(1)[:1], [measure], jobs=1)


def test_a_change_of_the_code_or_of_facts_that_a_measure_uses_computes_scores_again(
    items: list[Item], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, calls = tmp_path / "scores.jsonl", []

    def compute(item: Item, output: Tensor) -> dict[str, float]:
        calls.append(item.name)
        return {"words": float(len(item.facts["text"]))}

    def count_calls(text: str, **changes: Any) -> int:
        calls.clear()
        item = replace(items[0], facts={"text": text})
        measure = replace(Measure("words", compute, settings="1"), **changes)
        table = run_study([item], gains(1), [measure], store=ScoreStore(path), jobs=1)
        assert table.words[0] == len(text) or not calls
        return len(calls)

    assert [count_calls(text) for text in ("one", "one", "two", "one")] == [1, 0, 1, 0]
    assert count_calls("one", uses_facts=False) == 1
    assert count_calls("two", uses_facts=False) == 0, "a measure that uses no facts"
    monkeypatch.setattr("hlsim.evaluation.running.fingerprint._hash_sources", "{}".format)
    assert count_calls("one") == 1


def end_process(item: Item, output: Tensor) -> dict[str, float]:
    if item.name == "item 1":
        os.kill(os.getpid(), signal.SIGKILL)
    return {"fragile": 1.0}


@pytest.mark.slow  # Processes take seconds to start.
def test_a_crash_costs_only_its_score(items: list[Item]) -> None:
    measures = [MEASURES[0], Measure("fragile", end_process, may_crash=True)]
    table = run_study(items, gains(1), measures, jobs=1)
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.6])
    assert table.fragile.isna().tolist() == [False, True, False]
    assert "crash in compiled code" in table.failure[1]


def test_code_of_a_user_runs_in_another_process_unless_there_is_one_job(
    items: list[Item], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(
        "def measure(item, output):\n    return {'one': 1.0}\n\n"
        "def process(waveform, *ear):\n    return waveform\n"
    )
    own_aid = Condition("own", PluginAid("own:process", 16000))
    own_enhancer = Enhanced(WaveformPlugin("own:process", "enhancer"), Unaided())
    own_measure = load_measure("own:measure")
    isolated = []

    def run_here(function: Any, tasks: list[Any], **running: Any) -> Iterator[tuple[Any, Any]]:
        isolated.append(running["in_processes"])
        return ((task, function(task)) for task in tasks)

    monkeypatch.setattr("hlsim.evaluation.study.run_parallel", run_here)
    for jobs in (None, 1):
        for condition, measure in (
            (gains(1)[0], MEASURES[0]),
            (gains(1)[0], own_measure),
            (own_aid, MEASURES[0]),
            (Condition("enhanced", own_enhancer), MEASURES[0]),
        ):
            table = run_study(items[:1], [condition], [measure], jobs=jobs)
            assert table.failure.isna().all()
    assert isolated == [False, True, True, True, False, False, False, False]


def test_only_missing_values_are_computed(items: list[Item], tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    first = run_study(items, gains(1), MEASURES, store=ScoreStore(path), jobs=1)
    assert run_study(items, gains(1), MEASURES, store=ScoreStore(path), jobs=1).equals(first)
    changed_items = [
        replace(items[0], signal=items[0].signal + 1),
        replace(items[0], clean=items[0].clean + 1),
        replace(items[0], ear=Audiogram.standard("N4")),
        replace(items[0], seed=1),
    ]
    for computed, arguments in (
        (0, (items, gains(1), MEASURES[:1])),
        (3, (items, gains(1, 3), MEASURES[:1])),
        (0, (items, [Condition("another name", Gain(1))], MEASURES[:1])),
        (4, (changed_items, gains(1), MEASURES[:1])),
        (3, (items, gains(1), [replace(MEASURES[0], settings="2")])),
    ):
        CALLS.clear()
        run_study(*arguments, store=ScoreStore(path), jobs=1)
        assert CALLS.count("peak") == computed


def test_warnings_of_stored_scores_are_repeated(items: list[Item], tmp_path: Path) -> None:
    def warn(item: Item, output: Tensor) -> dict[str, float]:
        count_call("odd", output)
        warnings.warn(f"{item.name} is odd", stacklevel=1)
        return {"odd": 1.0}

    def run(*conditions: Condition) -> list[str]:
        store = ScoreStore(tmp_path / "scores.jsonl")
        measures = [MEASURES[0], Measure("odd", warn)]
        with pytest.warns(UserWarning) as warned:
            run_study(items, conditions, measures, store=store, jobs=1)
        return sorted(str(warning.message) for warning in warned)

    short, whole = Condition("short", Short()), *gains(1)
    texts = run(short, whole)
    odd = [f"{item.name} is odd" for item in items]
    assert [text for text in texts if "both are cut" not in text] == odd
    assert len(texts) == len(odd) + 1 and CALLS.count("odd") == 6
    assert run(short, whole) == texts
    assert run(whole) == odd
    assert CALLS.count("odd") == 6, "all scores were stored"


def test_scores_of_recorded_outputs_are_stored_by_the_output(items: list[Item]) -> None:
    def find_recording(name: str) -> Tensor:
        return {"before": items[0].clean, "after": 2.0 * items[0].clean}[name]

    item = replace(items[0], recorded=find_recording)
    conditions, store = [Condition("before"), Condition("after"), *gains(4)], ScoreStore()
    measures = [replace(MEASURES[0], scores=["peak"])]
    for calls in (3, 1):  # The output of a function is not stored beside recorded ones.
        CALLS.clear()
        table = run_study([item], conditions, measures, store=store, jobs=1)
        assert table["peak"].tolist() == pytest.approx([0.1, 0.2, 0.8])
        assert CALLS.count("peak") == calls


def test_a_measure_whose_package_is_missing_is_rejected(items: list[Item]) -> None:
    measure = Measure("mine", lambda item, output: {"mine": 0.0}, ["no-such-package"])
    with pytest.raises(MissingExtraError, match="measure mine requires no-such-package"):
        run_study(items, [Condition("unaided", Unaided())], [measure], jobs=1)


def test_a_condition_without_a_function_needs_recorded_outputs(items: list[Item]) -> None:
    table = run_study(items, [Condition("mine")], MEASURES, jobs=1)
    assert table["failure"].str.contains("expected the condition mine to have a function").all()


def test_a_module_may_be_trained_between_two_studies(items: list[Item]) -> None:
    class Gain(torch.nn.Dropout):
        def __init__(self) -> None:
            super().__init__(1.0)
            self.gain = torch.nn.Parameter(torch.ones(()))

        def forward(self, signal: Tensor, ear: Any = None) -> Tensor:
            return super().forward(self.gain * signal)

    aid, store = Gain(), ScoreStore()
    condition = Condition("aid", aid)
    for gain in (1.0, 2.0):
        torch.nn.init.constant_(aid.train().gain, gain)
        table = run_study(items[:1], [condition], MEASURES[:1], store=store, jobs=1)
        assert table["peak"].tolist() == pytest.approx([0.2 * gain])
    assert len(store.scores) == 2


def test_values_without_a_fingerprint_are_not_stored(items: list[Item]) -> None:
    store = ScoreStore()
    unknown = [Condition("mine", lambda signal, ear: signal)]
    run_study(items, unknown, MEASURES[:1], store=store, jobs=1)
    assert not store.scores


CREST = """
def crest(item, output):
    return {'crest': output.abs().max() / output.square().mean().sqrt()}
crest.fingerprint = '1'
def wrong(item, output):
    return 1.0
"""


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_function_of_a_user_is_a_measure(
    items: list[Item], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("crest.py").write_text(CREST)
    measures = [*MEASURES, load_measure("crest:crest"), load_measure("crest:wrong")]
    table = run_study(items, gains(1), measures, jobs=jobs)
    assert table.crest.tolist() == pytest.approx([1.0] * 3)
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.6])
    assert table.failure.str.contains("expected a dict of numbers").all()


def test_an_interrupted_run_continues(items: list[Item], tmp_path: Path) -> None:
    store = tmp_path / "scores.jsonl"

    def stop(finished: int, total: int) -> None:
        if finished == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(items, gains(1), MEASURES[:1], store=ScoreStore(store), jobs=1, progress=stop)
    CALLS.clear()
    table = run_study(items, gains(1), MEASURES[:1], store=ScoreStore(store), jobs=1)
    assert table.peak.tolist() == pytest.approx([0.2, 0.4, 0.6]) and CALLS.count("peak") == 1
