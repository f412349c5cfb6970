"""One function over many tasks: its results, its laziness, a process that dies, a cluster."""

import os
import signal
import time
from collections.abc import Iterator

import pytest

from hlsim.parallel import run_parallel

pytest.importorskip("joblib")


def square(number: int) -> int:
    return number * number


def die_at_three(number: int) -> int:
    if number == 3:
        time.sleep(0.3)  # others are under way
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def raise_at_three(number: int) -> int:
    if number == 3:
        raise RuntimeError("three")
    return number


# processes take seconds to start, for they import hlsim
JOBS = pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])


@JOBS
def test_every_task_comes_back_with_its_result(jobs: int) -> None:
    assert sorted(run_parallel(square, range(9), jobs=jobs)) == [(n, n * n) for n in range(9)]
    assert list(run_parallel(square, [], jobs=jobs)) == []


@pytest.mark.slow
def test_tasks_are_drawn_as_they_are_needed() -> None:
    drawn = []

    def tasks() -> Iterator[int]:
        for number in range(1000):
            drawn.append(number)
            yield number

    results = run_parallel(square, tasks(), jobs=2)
    next(results)
    assert len(drawn) < 100
    # joblib's word on what was under way, one or the other by how far it was
    with pytest.warns(UserWarning, match="not used|cancelled"):
        results.close()


@JOBS
def test_what_the_function_raises_is_the_callers(jobs: int) -> None:
    with pytest.raises(RuntimeError, match="three"):
        list(run_parallel(raise_at_three, range(8), jobs=jobs))


@pytest.mark.slow
def test_a_cluster_of_two_workers() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
    ):
        made = run_parallel(where, range(12), dask=cluster.scheduler_address)
        results = [result for _, result in made if result is not None]
        assert sorted(number for number, _ in results) == list(range(12))
        assert len({process for _, process in results} - {os.getpid()}) == 2


def where(number: int) -> tuple[int, int]:
    time.sleep(0.05)
    return number, os.getpid()


def test_fewer_than_one_process_is_rejected() -> None:
    with pytest.raises(ValueError, match="jobs is 0"):
        list(run_parallel(square, [1], jobs=0))


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("hlsim.parallel._PATIENCE", 0.5)
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_parallel(square, [1], dask="tcp://127.0.0.1:9"))


@pytest.mark.slow
def test_a_task_that_ends_its_process_is_found_and_the_others_go_on() -> None:
    results = dict(run_parallel(die_at_three, range(8), jobs=2))
    assert results == {n: None if n == 3 else n * n for n in range(8)}
