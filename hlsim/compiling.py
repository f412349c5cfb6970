"""What torch's compiler, modes and transforms are to leave as it is."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

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
