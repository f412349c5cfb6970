"""Tools around torch: constants that are computed once, and functions that are not compiled.

A *constant* is a tensor that a function computes from its arguments, such as the taps of a filter.
It is computed once for each type and device, and then comes from a cache.
"""

from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor

P = ParamSpec("P")
Result = TypeVar("Result")

CACHE_BYTES = 2**28
"""Size of the cache of constants. MSBG's filters take 5 MiB per second of signal."""


def not_compiled(function: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a function that ``torch.compile`` must not compile.

    The compiled graph breaks there. ``torch.compiler.disable`` does the same, but as a decorator it
    imports the compiler, which takes longer than importing hlsim.

    >>> @not_compiled
    ... def square(x):
    ...     return x * x
    >>> square(3)
    9
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return call


def without_modes(
    function: Callable[P, Result], /, *arguments: P.args, **options: P.kwargs
) -> Result:
    """Call a function as if the caller were not in a mode such as ``torch.inference_mode``.

    Modes, among them transforms such as ``torch.func.grad``, are set for each thread, so the
    function runs in another thread. Tensors that it creates are ordinary tensors, which can be kept
    and used in any mode, unlike inference tensors.

    Args:
        function: Function to call.
        arguments: Positional arguments of the function.
        options: Keyword arguments of the function.

    Returns: Result of the function.

    >>> with torch.inference_mode():
    ...     without_modes(torch.ones, 2).is_inference()
    False
    """
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function, *arguments, **options).result()


def constant(
    function: Callable[..., Any], *arguments: Any, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Return the values of ``function(*arguments)`` as a tensor that is computed only once.

    The tensor comes from a cache, so it must not be changed in place.

    Args:
        function: Function at the top level of a module, which returns an array or numbers.
        arguments: Hashable arguments of the function.
        dtype: Type of real values, and of the real and imaginary parts of complex ones.
        device: Device of the tensor.

    >>> constant(np.hanning, 3, dtype=torch.float32, device=torch.device("cpu"))
    tensor([0., 1., 0.])
    """
    tensor: Tensor = compute_once(_constant, function, arguments, dtype, device)
    return tensor


def constant_like(tensor: Tensor, function: Callable[..., Any], *arguments: Any) -> Tensor:
    """Return the values of ``function(*arguments)`` in the precision and on the device of a tensor.

    They are computed only once, see ``constant``, and must not be changed in place.

    Args:
        tensor: Real or complex tensor whose precision and device the result has.
        function: Function at the top level of a module, which returns an array or numbers.
        arguments: Hashable arguments of the function.

    >>> constant_like(torch.zeros(1).double(), np.hanning, 3)
    tensor([0., 1., 0.], dtype=torch.float64)
    """
    dtype = tensor.dtype.to_real() if tensor.is_complex() else tensor.dtype
    return constant(function, *arguments, dtype=dtype, device=tensor.device)


def compute_once(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return ``function(*arguments)``, which is computed once and then comes from a cache.

    The cache drops the least recently used results.

    Args:
        function: Function at the top level of a module, which returns a tensor or another object
            with ``nbytes``.
        arguments: Hashable arguments of the function.

    >>> compute_once(np.hanning, 5) is compute_once(np.hanning, 5)
    True
    """
    if torch.compiler.is_compiling():  # a program that is traced cannot use tensors from outside
        return function(*arguments)
    return _CACHE.get(function, arguments)


def as_tensor(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Convert real or complex values to a tensor, complex values to a complex one.

    Args:
        values: Array, tensor or numbers.
        dtype: Type of real values, and of the real and imaginary parts of complex ones.
        device: Device of the tensor.

    >>> as_tensor(np.array([1j]), torch.float32, torch.device("cpu")).dtype
    torch.complex64
    """
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values)
    tensor = torch.as_tensor(values)
    return tensor.to(device=device, dtype=dtype.to_complex() if tensor.is_complex() else dtype)


def flatten_items(tensor: Tensor, batch: torch.Size, dtype: torch.dtype) -> Tensor:
    """Expand a tensor to the leading dimensions of a batch, and flatten these to one dimension.

    Args:
        tensor: Waveforms, thresholds or other values, (..., n), whose leading dimensions broadcast
            to ``batch``.
        batch: Leading dimensions, whose product is the number of items of the batch.
        dtype: Type of the result.

    Shape: (..., n) -> (items, n).

    >>> flatten_items(torch.zeros(3, 1, 8), torch.Size([3, 2]), torch.float64).shape
    torch.Size([6, 8])
    """
    return tensor.to(dtype).expand(*batch, -1).reshape(-1, tensor.shape[-1])


def differentiable_once(gradient: Tensor, message: str) -> Tensor:
    """Return a gradient that raises an error if it is itself differentiated.

    Args:
        gradient: Result of a hand-written backward pass that is no exact derivative.
        message: Text of the RuntimeError.

    >>> differentiable_once(torch.ones(2), "no second derivative")
    tensor([1., 1.])
    """
    result: Tensor = _DifferentiableOnce.apply(gradient, message)
    return result


class _DifferentiableOnce(torch.autograd.Function):
    """Identity that raises RuntimeError in its backward pass."""

    @staticmethod
    def forward(gradient: Tensor, message: str) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, str], output: Tensor) -> None:
        ctx.message = inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        raise RuntimeError(ctx.message)


def _constant(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    return as_tensor(function(*arguments), dtype, device)


class _Cache:
    """Results by function and arguments, up to a number of bytes and at least the latest one."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._results: OrderedDict[Any, Any] = OrderedDict()
        self._lock = Lock()

    def get(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        key = function, arguments
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                return self._results[key]
        # The lock is open meanwhile, because a function may compute other constants.
        result = without_modes(function, *arguments)
        with self._lock:
            self._results[key] = result
            while len(self._results) > 1 and self.nbytes > self.limit:
                self._results.popitem(last=False)
        return result

    @property
    def nbytes(self) -> int:
        """Bytes of all results."""
        return sum(result.nbytes for result in self._results.values())


_CACHE = _Cache(CACHE_BYTES)
