"""One function applied to many tasks: results, errors, a process that ends, and a Dask cluster."""

import os
import signal
import time

import pytest

from hlsim.evaluation.parallel import run_parallel

pytest.importorskip("joblib")


def square(number: int) -> int:
    return number * number


def end_process_at_three(number: int) -> int:
    if number == 3:
        time.sleep(0.3)  # until other tasks have started
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def raise_at_three(number: int) -> int:
    if number == 3:
        raise RuntimeError("three")
    return number


def process_of(number: int) -> tuple[int, int]:
    time.sleep(0.05)
    return number, os.getpid()


# Processes take seconds to start, because they import hlsim.
JOBS = pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])


@JOBS
def test_tasks_come_back_with_their_results(jobs: int) -> None:
    assert sorted(run_parallel(square, range(9), jobs=jobs)) == [(n, n * n) for n in range(9)]
    assert list(run_parallel(square, [], jobs=jobs)) == []


@JOBS
def test_an_exception_of_the_function_ends_the_run(jobs: int) -> None:
    with pytest.raises(RuntimeError, match="three"):
        list(run_parallel(raise_at_three, range(8), jobs=jobs))


@pytest.mark.slow
def test_only_the_task_that_ends_its_process_has_no_result() -> None:
    results = dict(run_parallel(end_process_at_three, range(8), jobs=2))
    assert results == {n: None if n == 3 else n * n for n in range(8)}


@pytest.mark.slow
def test_a_cluster_of_two_workers() -> None:
    distributed = pytest.importorskip("distributed")
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(host="127.0.0.1", **settings) as cluster:
        pairs = list(run_parallel(process_of, range(12), dask=cluster.scheduler_address))
    results = [result for _, result in pairs if result is not None]
    assert sorted(number for number, _ in results) == list(range(12))
    assert len({process for _, process in results} - {os.getpid()}) == 2


def test_invalid_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("hlsim.evaluation.parallel.CONNECTION_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_parallel(square, [1], dask="tcp://127.0.0.1:9"))
    with pytest.raises(ValueError, match="got 0"):
        list(run_parallel(square, [1], jobs=0))
