"""One function over many tasks: in this process, over the cores, or over the machines of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from itertools import chain
from typing import Any, TypeVar

from hlsim.extras import require

BACKENDS = ("loky", "dask")

Task = TypeVar("Task")
Result = TypeVar("Result")

_PATIENCE = 10.0  # seconds for a scheduler to answer


def check_parallel(jobs: int | None, backend: str, scheduler: str | None) -> None:
    """Raise ValueError unless ``run_parallel`` can take these, and MissingExtraError where a package lacks."""
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs is {jobs}; allowed: 1 or more")
    if backend not in BACKENDS:
        raise ValueError(f"no backend {backend!r}; allowed: {', '.join(BACKENDS)}")
    if (backend == "dask") != (scheduler is not None):
        raise ValueError(
            "backend dask needs the scheduler's address, such as tcp://host:8786, and no other does"
        )
    require("joblib", "eval")
    if backend == "dask":
        require("distributed", "cluster")


def run_parallel(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    jobs: int | None = None,
    backend: str = "loky",
    scheduler: str | None = None,
) -> Iterator[tuple[Task, Result | None]]:
    """Yield each task with its result, in the order in which they are done; tasks are drawn as they are needed.

    With more than one process a task that ends its process (a crash in compiled code, memory run out) is found by
    running again, one by one, those that were under way: it yields None, and the others go on.

    Args:
        function: importable by name; raises nothing that the caller would rather live with.
        jobs: processes of this machine; None takes all cores. 1 runs in this process, which a crash then ends. A cluster
            takes all its workers.
        backend, scheduler: ``"loky"``, processes of this machine, or ``"dask"`` with the scheduler's address; its
            workers import hlsim and see the same files.

    Raises:
        ValueError: ``jobs`` or ``backend`` is none that is allowed, or no scheduler answers.
        MissingExtraError: joblib (eval) or distributed (cluster) is not installed.
    """
    check_parallel(jobs, backend, scheduler)
    joblib = require("joblib", "eval")
    processes = jobs or int(joblib.cpu_count())
    if backend == "loky" and processes == 1:
        for task in tasks:
            yield task, function(task)
        return
    with ExitStack() as stack:
        if backend == "dask":
            client = stack.enter_context(_connect(str(scheduler)))
            stack.enter_context(joblib.parallel_config(backend="dask", client=client))
            processes = -1
        else:
            # each process one thread of linear algebra: the files are what is parallel
            stack.enter_context(joblib.parallel_config(backend="loky", inner_max_num_threads=1))
        pending = enumerate(tasks)
        while True:
            under_way: dict[int, Task] = {}
            try:
                for index, result in _pool(joblib, processes, function, pending, under_way):
                    yield under_way.pop(index), result
                return
            except Exception as error:
                if not _died(error):
                    raise
            for index, task in list(under_way.items()):
                try:
                    ((_, result),) = _pool(joblib, processes, function, [(index, task)], {})
                    yield task, result
                except Exception as error:
                    if not _died(error):
                        raise
                    yield task, None


def _pool(
    joblib: Any,
    processes: int,
    function: Callable[[Task], Result],
    tasks: Iterable[tuple[int, Task]],
    under_way: dict[int, Task],
) -> Iterator[tuple[int, Result]]:
    def calls() -> Iterator[Any]:
        for index, task in tasks:
            under_way[index] = task
            yield joblib.delayed(_indexed)(function, index, task)

    calling = calls()
    first = next(calling, None)
    if first is None:  # a pool of nothing would still start its processes
        return iter(())
    # one task at a time: joblib would put quick ones in batches, and a batch is lost as a whole
    pool = joblib.Parallel(n_jobs=processes, return_as="generator_unordered", batch_size=1)
    results: Iterator[tuple[int, Result]] = pool(chain([first], calling))
    return results


def _indexed(function: Callable[[Task], Result], index: int, task: Task) -> tuple[int, Result]:
    return index, function(task)


def _died(error: Exception) -> bool:
    """Whether the error says that a worker process has gone, not that the function raised."""
    return type(error).__name__ in ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")


def _connect(scheduler: str) -> Any:
    try:
        return require("distributed", "cluster").Client(scheduler, set_as_default=False, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler} ({error})") from error
