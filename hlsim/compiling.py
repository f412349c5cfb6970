"""What ``torch.compile`` is to leave as it is."""

from collections.abc import Callable
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
