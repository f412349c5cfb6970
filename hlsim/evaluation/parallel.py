"""One function applied to many tasks: in this process, on several cores, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar

import torch

from hlsim.extras import require

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""Function of the number of finished tasks and of all tasks."""

CONNECTION_TIMEOUT = 10.0
"""Time in seconds in which a Dask scheduler has to answer."""

DEAD_PROCESS_ERRORS = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")
"""Types of the errors that joblib and Dask raise when a process has ended."""


def describe_error(error: Exception) -> str:
    """Describe an exception in one line, with its type unless it is a ValueError.

    >>> describe_error(RuntimeError("no battery"))
    'RuntimeError: no battery'
    """
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread in a ``with`` block or a decorated function.

    In small tasks, several threads wait for each other.

    >>> with one_thread():
    ...     torch.get_num_threads()
    1
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def run_parallel(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    jobs: int | None = None,
    dask: str | None = None,
) -> Iterator[tuple[Task, Result | None]]:
    """Call a function for each task, and yield the tasks with their results, in the same order.

    If a process ends (after a crash in compiled code, or because memory ran out), the tasks that
    were running are repeated one by one. The task that ends its process again yields None.

    Args:
        function: Function of a task, which can be pickled. An exception that it raises ends the
            run.
        tasks: Arguments of the function.
        jobs: Number of processes; all cores by default. With 1, tasks run in this process.
        dask: Address of a Dask scheduler, whose workers replace the processes. The workers must be
            able to import hlsim and to read the same files.

    Raises:
        ValueError: ``jobs`` is less than 1, or no scheduler answers.
        MissingExtraError: joblib (extra ``eval``) or distributed (extra ``cluster``) is not
            installed.

    >>> list(run_parallel(abs, [-1, 2], jobs=1))
    [(-1, 1), (2, 2)]
    """
    if jobs is not None and jobs < 1:
        raise ValueError(f"expected jobs to be 1 or more, or None for all cores, got {jobs}")
    if dask is None and jobs == 1:
        for task in tasks:
            yield task, function(task)
        return
    joblib = require("joblib", "eval")
    tasks = list(tasks)
    with ExitStack() as stack:
        settings: dict[str, Any] = {"backend": "loky", "inner_max_num_threads": 1}
        if dask is not None:
            settings = {"backend": "dask", "client": stack.enter_context(_connect(dask))}
        stack.enter_context(joblib.parallel_config(**settings))
        pool = joblib.Parallel(
            n_jobs=jobs if jobs and dask is None else -1,
            return_as="generator",
            # A batch of several tasks would be lost as a whole if its process ends.
            batch_size=1,
        )
        finished = 0
        while finished < len(tasks):
            numbers = iter(range(finished, len(tasks)))  # which joblib reads to start tasks
            try:
                for result in pool(joblib.delayed(function)(tasks[number]) for number in numbers):
                    yield tasks[finished], result
                    finished += 1
            except Exception as error:
                _check_process_ended(error)
            for task in tasks[finished : next(numbers, len(tasks))]:
                repeated: Result | None = None
                try:
                    (repeated,) = pool([joblib.delayed(function)(task)])
                except Exception as error:
                    _check_process_ended(error)
                yield task, repeated
                finished += 1


def _check_process_ended(error: Exception) -> None:
    """Raise an error again unless it reports the end of a process."""
    if type(error).__name__ not in DEAD_PROCESS_ERRORS:
        raise error


def _connect(scheduler: str) -> Any:
    """Return a client of the Dask scheduler at an address."""
    distributed = require("distributed", "cluster")
    try:
        return distributed.Client(scheduler, set_as_default=False, timeout=CONNECTION_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"no Dask scheduler answers at {scheduler} ({error}); check the address"
        ) from error
