"""One function applied to many tasks: results, errors, a process that ends, and a Dask cluster."""

import os
import signal
import time
from typing import Any

import pytest

from hlsim.evaluation.running.parallel import Crash, run_parallel

pytest.importorskip("joblib")


def end_process_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def process_of(number: int) -> tuple[int, int]:
    time.sleep(0.05)
    return number, os.getpid()


def test_tasks_come_back_with_their_results_and_an_exception_ends_the_run() -> None:
    assert list(run_parallel(abs, range(-9, 0), jobs=1)) == [(-n, n) for n in range(9, 0, -1)]
    with pytest.raises(TypeError, match="bad operand"):
        list(run_parallel(abs, [1, "three"], jobs=1))


def test_a_single_task_needs_no_other_process() -> None:
    assert list(run_parallel(process_of, [7])) == [(7, (7, os.getpid()))]


@pytest.mark.slow  # Processes take seconds to start, because they import hlsim.
@pytest.mark.parametrize("settings", [{"jobs": 2}, {"jobs": 1, "in_processes": True}])
def test_a_process_that_ends_costs_only_its_task(settings: dict[str, Any]) -> None:
    results = dict(run_parallel(end_process_at_three, range(4), **settings))
    assert isinstance(results.pop(3), Crash)
    assert results == {number: number**2 for number in (0, 1, 2)}


@pytest.mark.slow
def test_a_cluster_of_two_workers() -> None:
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(host="127.0.0.1", **settings) as cluster:
        pairs = list(run_parallel(process_of, range(12), dask=cluster.scheduler_address))
    assert [result[0] for _, result in pairs] == list(range(12))
    assert len({process for _, (_, process) in pairs} - {os.getpid()}) == 2


def test_an_address_without_a_scheduler_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("hlsim.evaluation.running.parallel.CONNECTION_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_parallel(abs, [1], dask="tcp://127.0.0.1:9"))
