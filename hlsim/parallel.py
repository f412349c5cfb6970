"""One function over many tasks: in this process, over the cores or over a Dask cluster, and not over what is stored."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, get_args

from hlsim.extras import require

Backend = Literal["loky", "dask"]

Task = TypeVar("Task")
Result = TypeVar("Result")

Progress = Callable[[int, int], None]
"""Called with how many are done and how many there are."""

_DIED = "the process that made it died (a crash in compiled code, or memory ran out)"
_PATIENCE = 10.0  # seconds for a scheduler to answer


class Failed(NamedTuple):
    """Why there is no record."""

    reason: str


class Store(Protocol):
    """Where records are kept; what is appended is there for the next process, however this one ends."""

    def get(self, key: str) -> Mapping[str, Any] | None: ...

    def append(self, key: str, record: Mapping[str, Any]) -> None: ...


def make_missing(
    function: Callable[[Task, Sequence[str]], Mapping[str, Mapping[str, Any] | Failed]],
    tasks: Sequence[Task],
    keys: Callable[[Task], Sequence[str]],
    store: Store | None,
    *,
    progress: Progress | None = None,
    **parallel: Any,
) -> dict[str, str]:
    """Make the records that a store lacks, each stored as it is made: a run that was stopped goes on where it was.

    Args:
        function: of a task and those of its keys that are missing; returns a record, or why there is none, for each.
        keys: of a task's records; quick, for it is asked three times. A key that counts as several stands so often.
        store: None where ``function`` itself keeps its records, and knows those that are there.
        progress: called with the keys done and all, first where some were there, and after each task.
        parallel: ``jobs``, ``backend`` and ``scheduler`` of ``run_parallel``.

    Returns: the reason of each record that could not be made; a later run tries it again.

    Raises:
        ValueError, MissingExtraError: as ``run_parallel``, or the store cannot be written.
    """

    def left() -> Iterator[tuple[Task, list[str]]]:
        for task in tasks:
            missing = [key for key in keys(task) if store is None or store.get(key) is None]
            if missing:
                yield task, missing

    show = progress or (lambda done, total: None)
    total = sum(len(keys(task)) for task in tasks)
    done = total - sum(len(missing) for _, missing in left())
    failed: dict[str, str] = {}
    if done == total:
        return failed
    if done:
        show(done, total)
    for (_, missing), made in run_parallel(partial(_make, function), left(), **parallel):
        if made is None:
            made = dict.fromkeys(missing, Failed(_DIED))
        for key, record in made.items():
            if isinstance(record, Failed):
                failed[key] = record.reason
            elif store is not None:
                store.append(key, record)
        done += len(missing)
        show(done, total)
    if done < total:  # two tasks of one key
        show(total, total)
    return failed


def reason_of(error: Exception) -> str:
    """What an exception says, in one line, with its kind unless it is a ValueError."""
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch with one thread: it sums in one order, and where tasks are small or parallel, more would wait."""
    import torch  # here, for the command line takes its options' names from this module

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def check_parallel(jobs: int | None, backend: Backend, scheduler: str | None) -> None:
    """Raise ValueError unless ``run_parallel`` can take these, and MissingExtraError where a package lacks."""
    if jobs is not None and jobs < 1:
        raise ValueError(f"jobs is {jobs}; allowed: 1 or more")
    if backend not in get_args(Backend):
        raise ValueError(f"no backend {backend!r}; allowed: {', '.join(get_args(Backend))}")
    if (backend == "dask") != (scheduler is not None):
        raise ValueError(
            "backend dask needs the scheduler's address, such as tcp://host:8786, and no other does"
        )
    if jobs != 1 or backend == "dask":
        require("joblib", "eval")
    if backend == "dask":
        require("distributed", "cluster")


def run_parallel(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    jobs: int | None = None,
    backend: Backend = "loky",
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
        MissingExtraError: joblib (eval), which one process does without, or distributed (cluster) is not installed.
    """
    check_parallel(jobs, backend, scheduler)
    processes = jobs or int(require("joblib", "eval").cpu_count())
    if backend == "loky" and processes == 1:
        for task in tasks:
            yield task, function(task)
        return
    joblib = require("joblib", "eval")
    with ExitStack() as stack:
        # each process one thread of linear algebra: the files are what is parallel
        options: dict[str, Any] = {"inner_max_num_threads": 1}
        if backend == "dask":
            processes, options = -1, {"client": stack.enter_context(_connect(str(scheduler)))}
        stack.enter_context(joblib.parallel_config(backend=backend, **options))
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
            for one in list(under_way.items()):
                outcome: Result | None = None
                try:
                    ((_, outcome),) = _pool(joblib, processes, function, [one], {})
                except Exception as error:
                    if not _died(error):
                        raise
                yield one[1], outcome


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


def _make(
    function: Callable[[Task, Sequence[str]], Result], task: tuple[Task, Sequence[str]]
) -> Result:
    return function(*task)


def _indexed(function: Callable[[Task], Result], index: int, task: Task) -> tuple[int, Result]:
    return index, function(task)


def _died(error: Exception) -> bool:
    """Whether the error says that a worker process has gone, not that the function raised."""
    return type(error).__name__ in ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker")


def _connect(scheduler: str) -> Any:
    try:
        return require("distributed", "cluster").Client(
            scheduler, set_as_default=False, timeout=_PATIENCE
        )
    except (OSError, ValueError) as error:
        raise ValueError(f"no Dask scheduler answers at {scheduler} ({error})") from error
