"""Where torch needs help: what its compiler leaves as it is, and tensors that are made once."""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

P = ParamSpec("P")
Result = TypeVar("Result")


def not_compiled(method: Callable[P, Result]) -> Callable[P, Result]:
    """``torch.compiler.disable``, but asked for only by a compiler: it takes longer to import than all of hlsim."""

    @wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            # with fullgraph=True this is the error, and the next one's would not tell its reason
            torch._dynamo.graph_break(
                msg="hlsim runs eagerly here: leave fullgraph out, or compile the network alone"
            )
            return torch.compiler.disable(method)(*args, **kwargs)
        return method(*args, **kwargs)

    return call


@contextmanager
def lasting() -> Iterator[None]:
    """For what is kept: plain tensors, also where inference mode or a transform of ``torch.func`` asks first."""
    with torch.inference_mode(False), torch._C._DisableFuncTorch():
        yield


def constant(
    make: Callable[..., Any], *arguments: Any, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """What ``make`` returns for these arguments as a tensor that nobody may write into, made once.

    Args:
        make: a function of a module, which returns an array or numbers.
        dtype: the tensor's, or, where the values are complex, the real type of its parts.
    """
    tensor: Tensor = made_once(_constant, make, arguments, dtype, device)
    return tensor


def constant_like(like: Tensor, make: Callable[..., Any], *arguments: Any) -> Tensor:
    """``constant`` of the type, complex or not, and on the device of a tensor."""
    dtype = like.dtype.to_real() if like.is_complex() else like.dtype
    return constant(make, *arguments, dtype=dtype, device=like.device)


def made_once(make: Callable[..., Any], *arguments: Any) -> Any:
    """What ``make`` returns for these arguments: a tensor or another object with ``nbytes``.

    The process keeps what was asked for last, no model does: nothing of it is stored or copied.
    """
    # what a trace or a mode, as that of fake tensors, makes is of no use to others
    if torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack():
        return make(*arguments)
    return _KEPT.get(make, arguments)


def as_tensor(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Real or complex values as a tensor of ``dtype`` or its complex counterpart."""
    tensor = torch.as_tensor(
        np.ascontiguousarray(values) if isinstance(values, np.ndarray) else values
    )
    return tensor.to(device=device, dtype=dtype.to_complex() if tensor.is_complex() else dtype)


def _constant(
    make: Callable[..., Any], arguments: tuple[Any, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    return as_tensor(make(*arguments), dtype, device)


class _Kept:
    """The results asked for last, up to ``limit`` bytes of them: MSBG's filters take 5 MiB a second of signal."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._results: OrderedDict[Any, Any] = OrderedDict()
        self._lock = RLock()  # modules may run in threads

    def get(self, make: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        key = make, arguments
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
            else:
                with lasting():
                    self._results[key] = make(*arguments)
                while len(self._results) > 1 and self.held > self.limit:
                    self._results.popitem(last=False)
            return self._results[key]

    @property
    def held(self) -> int:
        """Bytes of all."""
        return sum(result.nbytes for result in self._results.values())


_KEPT = _Kept(2**28)
