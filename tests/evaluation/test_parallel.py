"""One function applied to many tasks: results, errors, a process that ends, and a Dask cluster."""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest

from hlsim.evaluation import haspi_report, run_study
from hlsim.evaluation.clarity import evaluate_scenes
from hlsim.evaluation.compensators import evaluate_compensators
from hlsim.evaluation.running.parallel import Crash, run_parallel
from hlsim.evaluation.simulators import evaluate_simulators
from hlsim.extras import MissingExtraError

pytest.importorskip("joblib")


def end_process_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def process_of(number: int) -> tuple[int, int]:
    return number, os.getpid()


def warn_of(number: int) -> int:
    warnings.warn(f"the number is {number}", stacklevel=1)
    return number


def test_tasks_come_back_with_their_results_and_an_exception_ends_the_run() -> None:
    assert list(run_parallel(abs, range(-9, 0), jobs=1)) == [(-n, n) for n in range(9, 0, -1)]
    with pytest.raises(TypeError, match="bad operand"):
        list(run_parallel(abs, [1, "three"], jobs=1))


def test_a_single_task_needs_no_other_process() -> None:
    assert list(run_parallel(process_of, [7])) == [(7, (7, os.getpid()))]


# Processes take seconds to start, because they import hlsim. test_study.py has several tasks in
# another process, one of which ends it.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "settings"),
    [
        (range(4), {"jobs": 2}),
        ([3], {"in_processes": True}),
    ],
)
def test_a_process_that_ends_costs_only_its_task(
    numbers: Sequence[int], settings: dict[str, Any]
) -> None:
    results = dict(run_parallel(end_process_at_three, numbers, **settings))
    assert isinstance(results.pop(3), Crash)
    assert results == {number: number**2 for number in numbers if number != 3}


@pytest.mark.slow  # as above
def test_a_single_core_is_no_reason_to_run_in_this_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    results = list(run_parallel(process_of, [5, 7], in_processes=True))
    assert [task for task, _ in results] == [5, 7]
    assert all(process != os.getpid() for _, (_, process) in results)  # type: ignore[misc]


@pytest.mark.slow  # as above
def test_warnings_of_other_processes_are_repeated() -> None:
    with pytest.warns(UserWarning, match="the number is 7"):
        assert list(run_parallel(warn_of, [5, 7], jobs=2)) == [(5, 5), (7, 7)]


@pytest.mark.slow
def test_a_cluster_has_the_tasks() -> None:
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with distributed.LocalCluster(host="127.0.0.1", **settings) as cluster:
        process = cluster.workers[0].pid
        pairs = list(run_parallel(process_of, range(4), dask=cluster.scheduler_address))
    assert pairs == [(number, (number, process)) for number in range(4)]


def test_an_address_without_a_scheduler_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("hlsim.evaluation.running.parallel.CONNECTION_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_parallel(abs, [1], dask="tcp://127.0.0.1:9"))


def test_an_evaluation_looks_for_its_scheduler_before_anything_else() -> None:
    """The other arguments are wrong, and would be an error when they are read."""
    evaluations: list[Callable[..., Any]] = [
        partial(evaluate_scenes, {}, scenes="gone", listeners="gone", out="gone"),
        partial(evaluate_compensators, {"gone": "gone"}, speech="gone"),
        partial(evaluate_simulators, {"gone": "gone"}, speech="gone", audiograms="gone"),
        partial(haspi_report, "gone", after="gone"),
        partial(run_study, [], [], []),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "distributed", None)
        for evaluate in evaluations:
            with pytest.raises(MissingExtraError, match="distributed is not installed"):
                evaluate(dask="tcp://127.0.0.1:9")
