"""One function over many items: on this machine's cores, or on a Dask cluster, in order and few at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import TypeVar

import torch

from hlsim.extras import require

BACKENDS = ("local", "dask")

Item = TypeVar("Item")
Result = TypeVar("Result")


def over_all(
    run: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    jobs: int | None = None,
    backend: str = "local",
    scheduler: str | None = None,
) -> Iterator[Result]:
    """``run`` of each item, in order; items are taken from the iterable only as they are wanted.

    Args:
        run: a function that pickles.
        jobs: processes on this machine; None takes all cores, 1 none but this one.
        backend: ``local``, or ``dask``: joblib's Dask backend.
        scheduler: address of Dask's scheduler, as tcp://host:8786. Its workers need hlsim and the same folders.

    Raises:
        ValueError: an unknown backend, a scheduler without it or the reverse, or one that does not answer.
        MissingExtraError: joblib (for more than one process) or dask is not installed.
    """
    if backend not in BACKENDS or (backend == "dask") != (scheduler is not None):
        raise ValueError(
            f"backend {backend!r} with scheduler {scheduler!r}; allowed: local, or dask with the scheduler's address"
        )
    if backend == "local" and jobs == 1:
        threads = torch.get_num_threads()
        try:
            for item in items:
                yield _alone(run, item)
        finally:
            torch.set_num_threads(threads)
        return
    joblib = require("joblib", "cluster")
    with ExitStack() as stack:
        count = -1 if jobs is None else jobs
        if scheduler is not None:
            distributed = require("distributed", "cluster")
            try:
                stack.enter_context(distributed.Client(scheduler, timeout="20s"))
            except (OSError, ValueError) as error:
                raise ValueError(f"{scheduler}: no Dask scheduler answers ({error})") from error
            stack.enter_context(joblib.parallel_config(backend="dask"))
        else:
            stack.enter_context(joblib.parallel_config(backend="loky", inner_max_num_threads=1))
        parallel = joblib.Parallel(n_jobs=count, return_as="generator", pre_dispatch="2*n_jobs", batch_size=1)
        yield from parallel(joblib.delayed(_alone)(run, item) for item in items)


def _alone(run: Callable[[Item], Result], item: Item) -> Result:
    torch.set_num_threads(1)  # workers share the machine; and one thread sums in one order
    return run(item)
