"""Where torch needs help: what its compiler and modes are to leave as it is, constants on devices, freed memory."""

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

P = ParamSpec("P")
Result = TypeVar("Result")


def not_compiled(method: Callable[P, Result]) -> Callable[P, Result]:
    """``torch.compiler.disable``, but asked for only by a compiler: it takes longer to import than all of hlsim."""

    @wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(method)(*args, **kwargs)
        return method(*args, **kwargs)

    return call


@contextmanager
def lasting() -> Iterator[None]:
    """For what is kept: plain tensors, also where inference mode or a transform of ``torch.func`` asks first."""
    with torch.inference_mode(False), torch._C._DisableFuncTorch():
        yield


def constant(make: Callable[..., Any], *arguments: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """What ``make`` returns for these arguments, an array or numbers, as a tensor that nobody may write into."""
    # what a trace or a mode, as that of fake tensors, makes is of no use to others
    if torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack():
        return _made(make, arguments, dtype, device)
    return _kept(make, arguments, dtype, device)


def _made(
    make: Callable[..., Any], arguments: tuple[Any, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    return torch.as_tensor(make(*arguments)).to(device=device, dtype=dtype)


@lru_cache(maxsize=128)
def _kept(
    make: Callable[..., Any], arguments: tuple[Any, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    with lasting():
        return _made(make, arguments, dtype, device)


# of glibc's malloc.h
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def keep_freed_memory() -> bool:
    """Let the process keep what it frees, for a training step asks for the same hundreds of megabytes as the one before.

    By default glibc returns them, and the next step pays for every page of 4 KiB anew: up to 40 % of its time on a CPU.
    For programs of our own; a library leaves the process to its host, which can set ``MALLOC_TRIM_THRESHOLD_`` and
    ``MALLOC_MMAP_MAX_`` in the environment.

    Returns: whether the C library is one that can.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # not glibc: musl, macOS, Windows
        return False
    return bool(mallopt(_TRIM_THRESHOLD, -1)) and bool(mallopt(_MMAP_MAX, 0))
