"""One function over many tasks: in this process, on several cores, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import chain
from typing import Any, TypeVar

import torch

from hlsim.extras import require

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""Function of the number of tasks that are done and of all."""

_PATIENCE = 10.0  # seconds in which a scheduler has to answer


def reason_of(error: Exception) -> str:
    """Return the text of an exception in one line, with its type unless it is a ValueError."""
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


@contextmanager
def one_thread() -> Iterator[None]:
    """Give torch one thread, as more threads would wait for each other in small tasks."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def check_jobs(jobs: int | None) -> None:
    """Raise ValueError unless ``run_parallel`` can take this number of processes."""
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs is {jobs}; expected 1 or more, or None for all cores")


def run_parallel(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    jobs: int | None = None,
    dask: str | None = None,
) -> Iterator[tuple[Task, Result | None]]:
    """Yield each task with its result as it finishes; tasks are drawn when they are needed.

    If a task ends its process (a crash in compiled code, no memory left), the tasks that were
    running are repeated one by one: the one at fault yields None, and the others go on.

    Args:
        function: can be pickled; an exception that it raises ends the run.
        jobs: number of processes; None takes all cores. With 1 the tasks run in this process.
        dask: address of a Dask scheduler, whose workers take the place of processes. They import
            hlsim and see the same files.

    Raises:
        ValueError: ``jobs`` is less than 1, or no scheduler answers.
        MissingExtraError: joblib (extra ``eval``) or distributed (extra ``cluster``) is not
            installed.
    """
    check_jobs(jobs)
    if dask is None and jobs == 1:
        for task in tasks:
            yield task, function(task)
        return
    joblib = require("joblib", "eval")
    with ExitStack() as stack:
        backend: dict[str, Any] = {"backend": "loky", "inner_max_num_threads": 1}
        if dask is not None:
            backend = {"backend": "dask", "client": stack.enter_context(_connect(dask))}
        stack.enter_context(joblib.parallel_config(**backend))
        processes = -1 if jobs is None or dask is not None else jobs
        pending = enumerate(tasks)
        while True:
            running: dict[int, Task] = {}
            try:
                for number, result in _run(joblib, processes, function, pending, running):
                    yield running.pop(number), result
                return
            except Exception as error:
                if not _process_ended(error):
                    raise
            for suspect in list(running.items()):
                yield suspect[1], _run_alone(joblib, processes, function, suspect)


def _run(
    joblib: Any,
    processes: int,
    function: Callable[[Task], Result],
    tasks: Iterable[tuple[int, Task]],
    running: dict[int, Task],
) -> Iterator[tuple[int, Result]]:
    """Run numbered tasks, and keep those that are not finished in ``running``."""

    def calls() -> Iterator[Any]:
        for number, task in tasks:
            running[number] = task
            yield joblib.delayed(_numbered)(function, number, task)

    calling = calls()
    first = next(calling, None)
    if first is None:  # without tasks no processes are started
        return iter(())
    # one task at a time: a batch of quick ones would be lost as a whole
    pool = joblib.Parallel(n_jobs=processes, return_as="generator_unordered", batch_size=1)
    results: Iterator[tuple[int, Result]] = pool(chain([first], calling))
    return results


def _run_alone(
    joblib: Any, processes: int, function: Callable[[Task], Result], task: tuple[int, Task]
) -> Result | None:
    """Run one task; return None if it ends its process."""
    try:
        ((_, result),) = _run(joblib, processes, function, [task], {})
    except Exception as error:
        if not _process_ended(error):
            raise
        return None
    return result


def _numbered(function: Callable[[Task], Result], number: int, task: Task) -> tuple[int, Result]:
    return number, function(task)


def _process_ended(error: Exception) -> bool:
    return type(error).__name__ in ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")


def _connect(scheduler: str) -> Any:
    distributed = require("distributed", "cluster")
    try:
        return distributed.Client(scheduler, set_as_default=False, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler} ({error})") from error
