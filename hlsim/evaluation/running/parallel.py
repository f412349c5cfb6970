"""One function applied to many tasks: in this process, on several cores, or on a Dask cluster."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, TypeVar

from hlsim.extras import require

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""Function that is called with the number of finished tasks and the number of all tasks."""

CONNECTION_TIMEOUT = 10.0
"""Time in seconds in which a Dask scheduler has to answer."""

DEAD_PROCESS_ERRORS = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")
"""Types of the errors that joblib and Dask raise when a process has ended."""

CRASH = "the process ended, after a crash in compiled code or because memory ran out"
"""Reason why a task has no result after a ``Crash``."""

_TASKS_IN_FLIGHT = 8
"""Number of tasks per core that are repeated one by one after a process has ended.

The task that ended it is usually among them.
"""


class Crash:
    """Result of a task whose process has ended.

    >>> isinstance(Crash(), Crash)
    True
    """


def describe_error(error: Exception) -> str:
    """Describe an exception in one line, with its type unless it is a ValueError.

    >>> describe_error(RuntimeError("no battery"))
    'RuntimeError: no battery'
    """
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


def run_parallel(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    jobs: int | None = None,
    dask: str | None = None,
    in_processes: bool = False,
) -> Iterator[tuple[Task, Result | Crash]]:
    """Call a function for each task, and yield the tasks with their results, in the same order.

    If a process crashes, the next tasks are repeated one by one in another process, so that only
    the result of the task that crashes is a ``Crash``. Warnings of the function for users
    (``UserWarning``) are repeated in this process, where callers can record them.

    Args:
        function: Function of a task, which can be pickled. An exception that it raises ends the
            run.
        tasks: Arguments of the function.
        jobs: Number of processes; by default one per core. With 1, and for a single task, tasks run
            in this process, which a crash ends, unless ``in_processes`` is true.
        dask: Address of a Dask scheduler, whose workers run all tasks instead of processes. They
            must be able to import hlsim and to read the same files.
        in_processes: Whether tasks run in another process even if ``jobs`` is 1.

    Raises:
        ValueError: No scheduler answers.
        MissingExtraError: joblib (extra ``eval``) or distributed (extra ``cluster``) is not
            installed.

    >>> list(run_parallel(abs, [-1, 2], jobs=1))
    [(-1, 1), (2, 2)]
    """
    joblib = require("joblib", "eval")
    if len(tasks) == 1:
        jobs = 1  # A process takes seconds to start.
    with ExitStack() as stack:
        settings: dict[str, Any] = {"backend": "loky", "inner_max_num_threads": 1}
        if dask is not None:
            settings = {"backend": "dask", "client": stack.enter_context(_connect(dask))}
            jobs = None
        stack.enter_context(joblib.parallel_config(**settings))
        pool = joblib.Parallel(n_jobs=jobs or -1, return_as="generator")
        call = joblib.delayed(partial(_call_and_record, function))
        calls = [call(task) for task in tasks]
        finished = 0
        # With one process, such as on a single core, joblib computes in this one.
        is_sequential = dask is None and joblib.effective_n_jobs(jobs or -1) == 1
        alone = len(tasks) if in_processes and is_sequential else 0
        while finished < len(tasks):
            if not alone:
                results = pool(calls[finished:])
            elif dask is None:
                results = _run_in_one_process(calls[finished : finished + alone])
            else:
                results = pool(calls[finished : finished + 1])
            try:
                for result, texts in results:
                    for text in texts:
                        warnings.warn(text, stacklevel=2)
                    yield tasks[finished], result
                    finished += 1
                    alone = max(0, alone - 1)
            except Exception as error:
                if type(error).__name__ not in DEAD_PROCESS_ERRORS:
                    raise
                if not alone:
                    alone = _TASKS_IN_FLIGHT * joblib.cpu_count()
                    continue
                yield tasks[finished], Crash()
                finished += 1
                alone -= 1


def check_scheduler(address: str | None) -> None:
    """Connect with a Dask scheduler once, so that an evaluation fails before it computes anything.

    Args:
        address: Address of the scheduler; None, for an evaluation without one, is accepted.

    Raises:
        ValueError: No scheduler answers.
        MissingExtraError: joblib (extra ``eval``) or distributed (extra ``cluster``) is not
            installed.

    >>> check_scheduler(None)
    """
    if address is not None:
        require("joblib", "eval")
        _connect(address).close()


@contextmanager
def record_warnings(texts: list[str]) -> Iterator[None]:
    """Append the texts of warnings for users (``UserWarning``) to a list when the context ends.

    Warnings are not shown, and those of other types are lost.

    >>> texts = []
    >>> with record_warnings(texts):
    ...     warnings.warn("the battery is low")
    >>> texts
    ['the battery is low']
    """
    with warnings.catch_warnings(record=True) as caught:
        try:
            yield
        finally:
            texts += [str(w.message) for w in caught if w.category is UserWarning]


def _call_and_record(function: Callable[[Task], Result], task: Task) -> tuple[Result, list[str]]:
    """Return the result of a function for a task, and the texts of its warnings for users."""
    texts: list[str] = []
    with record_warnings(texts):
        result = function(task)
    return result, texts


def _run_in_one_process(calls: Sequence[Any]) -> Iterator[Any]:
    """Yield the results of joblib's delayed calls, which another process computes one by one.

    joblib cannot do this: with one job, it computes in this process. An error of a call is raised,
    and ``BrokenProcessPool`` if the other process ends.
    """
    from joblib.externals.loky import ProcessPoolExecutor

    environment = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    executor = ProcessPoolExecutor(1, env=environment)
    try:
        for function, arguments, options in calls:
            yield executor.submit(function, *arguments, **options).result()
    finally:
        executor.shutdown(kill_workers=True)


def _connect(scheduler: str) -> Any:
    """Return a client of the Dask scheduler at an address.

    Raises:
        ValueError: No scheduler answers.
        MissingExtraError: distributed is not installed.
    """
    distributed = require("distributed", "cluster")
    try:
        return distributed.Client(scheduler, set_as_default=False, timeout=CONNECTION_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"no Dask scheduler answers at {scheduler} ({error}); check the address"
        ) from error
