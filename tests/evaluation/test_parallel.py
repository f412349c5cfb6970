"""One function applied to many tasks: results, errors, a process that ends, and a Dask cluster."""

import os
import signal
import time

import pytest

from hlsim.evaluation.parallel import run_parallel

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


@pytest.mark.slow  # Processes take seconds to start, because they import hlsim.
def test_a_process_that_ends_ends_the_run_with_a_reason() -> None:
    with pytest.raises(ValueError, match="run again with fewer jobs"):
        list(run_parallel(end_process_at_three, range(8), jobs=2))


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
    monkeypatch.setattr("hlsim.evaluation.parallel.CONNECTION_TIMEOUT", 0.2)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_parallel(abs, [1], dask="tcp://127.0.0.1:9"))
