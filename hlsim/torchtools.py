"""Tools around torch: constants, threads, conversion of arrays, batches, and copies on a GPU.

A *constant* is a tensor that a function designs from its arguments, such as the taps of a filter.
For each type and device, it is computed once, and then comes from a store of limited size.
Thresholds are copied once from the CPU to a GPU, or back.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial, update_wrapper, wraps
from pathlib import Path
from threading import Lock
from typing import Any, Generic, ParamSpec, TypeVar, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.checkpoint import checkpoint
from torch.utils.weak import WeakTensorKeyDictionary

P = ParamSpec("P")
Argument = TypeVar("Argument")
Result = TypeVar("Result")
Values = TypeVar("Values")
Samples = Tensor | NDArray[Any]
"""Samples of a signal as a tensor or as an array."""

Audio = TypeVar("Audio", Tensor, NDArray[Any])
"""Type of a signal and of a result: both are tensors, or both are arrays."""

STORE_BYTES = 2**28
"""Largest size in bytes of the stored constants.

For each severity, MSBG's take 1.5 to 4 MiB per second of signal.
"""

_HOST = torch.device("cpu")

_RESULTS: OrderedDict[Any, Any] = OrderedDict()
"""Results of ``compute_once`` by function and arguments, in order of use."""

_RESULTS_LOCK = Lock()


def not_compiled(function: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a function that ``torch.compile`` must not compile.

    The compiled graph breaks at a call of the function. ``torch.compiler.disable`` does the same,
    but as a decorator it imports the compiler, which takes longer than importing hlsim.

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


def built_in_float32(construct: Callable[P, None]) -> Callable[P, None]:
    """Decorate a constructor so that it uses float32 instead of torch's default dtype.

    The networks compute with complex numbers. Torch has none for bfloat16, and few operations
    for those of float16.

    >>> torch.set_default_dtype(torch.bfloat16)
    >>> class Layer(torch.nn.Linear):
    ...     __init__ = built_in_float32(torch.nn.Linear.__init__)
    >>> Layer(2, 2).weight.dtype
    torch.float32
    >>> torch.set_default_dtype(torch.float32)
    """

    @wraps(construct)
    def call(*args: P.args, **kwargs: P.kwargs) -> None:
        default = torch.get_default_dtype()
        torch.set_default_dtype(torch.float32)
        try:
            construct(*args, **kwargs)
        finally:
            torch.set_default_dtype(default)

    return call


def checkpointed(function: Callable[P, Result]) -> Callable[P, Result]:
    """Wrap a function so that its activations are computed again in the backward pass, not stored.

    Args:
        function: Function that draws no random numbers, because their state is not stored.

    >>> x = torch.tensor(3.0, requires_grad=True)
    >>> torch.autograd.grad(checkpointed(torch.square)(x), x)
    (tensor(6.),)
    """
    return partial(checkpoint, function, use_reentrant=False, preserve_rng_state=False)


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

    Returns:
        Result of the function.

    >>> with torch.inference_mode():
    ...     without_modes(torch.ones, 2).is_inference()
    False
    """
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function, *arguments, **options).result()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread in a ``with`` block or a decorated function.

    For small tasks, waiting for other threads takes longer than the work itself.

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


def map_on_cores(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], signal: Tensor
) -> list[Result]:
    """Call a function for each of several arguments, in up to as many threads as torch uses.

    Each thread computes on one core. Calls one after another, each on all cores, take longer,
    because the cores wait for each other after every operation, and much longer while other
    programs run.

    Args:
        function: Function to call.
        arguments: Arguments of the calls.
        signal: Tensor on which the function depends. If it is not on a CPU, or its gradient is
            recorded, the calls are made in this thread, to which the hooks of autograd belong.
            Other threads record no gradients, so no other tensor may need one.

    Returns:
        Results in the order of the arguments.

    >>> map_on_cores(abs, [-1, -2], torch.zeros(1))
    [1, 2]
    """
    threads = torch.get_num_threads()
    workers = min(threads, len(arguments))
    is_differentiable = signal.requires_grad and torch.is_grad_enabled()
    if workers <= 1 or signal.device.type != "cpu" or is_differentiable:
        return [function(argument) for argument in arguments]
    inference = torch.is_inference_mode_enabled()

    def call(argument: Argument) -> Result:
        with torch.inference_mode(inference), torch.no_grad():
            return function(argument)

    try:
        with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            return list(pool.map(call, arguments))
    finally:
        torch.set_num_threads(threads)  # the workers have changed it for threads to come


class constant(Generic[P, Values]):
    """Decorator of a function that designs a constant, whose tensors are computed once and stored.

    With the additional argument ``like``, a call returns the values as a tensor in the precision
    and on the device of the tensor ``like``. This tensor comes from a store, so it must not be
    changed in place. The other arguments must be positional and hashable. Without ``like``, a call
    returns the values as the function computes them.

    Args:
        design: Function at the top level of a module, which returns an array.

    >>> @constant
    ... def window(points):
    ...     return np.hanning(points)
    >>> window(3, like=torch.zeros(1))
    tensor([0., 1., 0.])
    >>> window(3)
    array([0., 1., 0.])
    """

    def __init__(self, design: Callable[P, Values]) -> None:
        update_wrapper(self, design)
        self._design = design

    @overload
    def __call__(self, *arguments: P.args, **options: P.kwargs) -> Values: ...

    @overload
    def __call__(self, *arguments: Any, like: Tensor) -> Tensor: ...

    def __call__(  # type: ignore[misc]  # a design has no argument ``like``
        self, *arguments: Any, like: Tensor | None = None, **options: Any
    ) -> Any:
        if like is None:
            return self._design(*arguments, **options)
        dtype = like.dtype.to_real() if like.is_complex() else like.dtype
        return _design_tensor(self._design, arguments, dtype, like.device)


def compute_once(function: Callable[P, Result]) -> Callable[P, Result]:
    """Decorate a function whose results are computed once and then come from a store.

    Beyond 256 MiB (``STORE_BYTES``), the store drops the results that were not used for the longest
    time, but never the latest result. All callers get the same object, so it must not be changed.
    A program that torch.compile traces calls the function itself.

    Args:
        function: Function at the top level of a module, with hashable arguments.

    >>> @compute_once
    ... def window(points):
    ...     return np.hanning(points)
    >>> window(5) is window(5)
    True
    """

    @wraps(function)
    def get_or_compute(*arguments: P.args, **options: P.kwargs) -> Result:
        # a program that is traced cannot use tensors from outside
        if torch.compiler.is_compiling():
            return function(*arguments, **options)
        key = function, arguments, tuple(options.items())
        with _RESULTS_LOCK:
            if key in _RESULTS:
                _RESULTS.move_to_end(key)
                stored: Result = _RESULTS[key]
                return stored
        # The lock is open meanwhile, because a function may compute other constants.
        result = without_modes(function, *arguments, **options)
        with _RESULTS_LOCK:
            _RESULTS[key] = result
            while len(_RESULTS) > 1 and _count_bytes([*_RESULTS.values()]) > STORE_BYTES:
                _RESULTS.popitem(last=False)
        return result

    return get_or_compute


def _count_bytes(value: Any) -> int:
    """Count the bytes of a tensor or an array, or of all those in a list, tuple, dict or object."""
    if isinstance(value, Tensor | np.ndarray):
        return value.nbytes
    if hasattr(value, "__dict__"):
        value = vars(value)
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        return 0
    return sum(map(_count_bytes, value))


def as_tensor(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Convert real or complex values to a tensor, complex values to a complex one.

    Args:
        values: Array with one or more dimensions, or tensor.
        dtype: Type of real values, and of the real and imaginary parts of complex ones.
        device: Device of the tensor.

    >>> as_tensor(np.array([1j]), torch.float32, torch.device("cpu")).dtype
    torch.complex64
    """
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values)
    tensor = torch.as_tensor(values)
    return tensor.to(device=device, dtype=dtype.to_complex() if tensor.is_complex() else dtype)


def as_samples(signal: Samples) -> Tensor:
    """Convert samples to a tensor. Arrays are copied.

    Args:
        signal: Tensor, which is returned as it is, or array (or list) of floating-point numbers.

    Raises:
        ValueError: The signal is neither a tensor nor such an array, or samples of it are masked.

    >>> as_samples(np.ones(2, np.float32)[::-1])
    tensor([1., 1.])
    """
    if isinstance(signal, Tensor):
        return signal
    if isinstance(signal, tuple | str | Path):
        kind = "a tuple" if isinstance(signal, tuple) else f"the path {str(signal)!r}"
        raise ValueError(
            f"expected samples, got {kind}; write: speech, rate = hlsim.load_audio(path), and pass "
            "speech and sample_rate=rate"
        )
    if np.ma.is_masked(signal):
        raise ValueError("expected samples without a mask; fill masked ones: x.filled(0.0)")
    samples = np.asarray(signal)
    if not np.issubdtype(samples.dtype, np.floating):
        is_integer = np.issubdtype(samples.dtype, np.integer)
        fix = "; divide 16-bit samples by 32768, then set their level with set_level"
        raise ValueError(
            "expected a tensor or an array of floating-point samples, got "
            f"{type(signal).__name__} of {samples.dtype}{fix if is_integer else ''}"
        )
    # A copy, because torch takes no array that is reversed, read-only or in another byte order.
    size = min(samples.dtype.itemsize, 8)
    return torch.from_numpy(np.array(samples, dtype=f"f{size}", order="C"))


def as_type_of(signal: Audio, result: Tensor) -> Audio:
    """Convert a result to an array or a NumPy number, unless the signal is a tensor.

    Args:
        signal: Signal from which the result was computed.
        result: Tensor, which must be on the CPU if the signal is an array. A gradient is then lost.

    >>> as_type_of(np.ones(2), torch.tensor(0.5))
    np.float32(0.5)
    """
    return result if isinstance(signal, Tensor) else result.detach().numpy()[()]


def flatten_items(tensor: Tensor, batch: torch.Size, dtype: torch.dtype) -> Tensor:
    """Expand a tensor to the leading dimensions of a batch, and flatten these to one dimension.

    Args:
        tensor: Waveforms, thresholds or other values, (..., n), whose leading dimensions broadcast
            to ``batch``.
        batch: Leading dimensions, whose product is the number of items of the batch.
        dtype: Type of the result.

    Shape: (..., n) -> (items, n).

    Raises:
        RuntimeError: The leading dimensions do not broadcast.

    >>> flatten_items(torch.zeros(3, 1, 8), torch.Size([3, 2]), torch.float64).shape
    torch.Size([6, 8])
    """
    return tensor.to(dtype).expand(*batch, -1).reshape(-1, tensor.shape[-1])


def pair_items(
    waveform: Tensor, ears: Tensor, dtype: torch.dtype
) -> tuple[torch.Size, Tensor, Tensor]:
    """Broadcast signals and ears to a batch, and flatten its dimensions to one.

    Args:
        waveform: Signals, (..., time).
        ears: Values of the ear of each signal, (..., n).
        dtype: Type of the results.

    Returns:
        The leading dimensions of the batch; the signals, (items, time); and the ears, (items, n).

    Raises:
        RuntimeError: The leading dimensions do not broadcast.

    >>> batch, signals, ears = pair_items(torch.zeros(3, 1, 9), torch.zeros(2, 8), torch.float32)
    >>> batch, signals.shape, ears.shape
    (torch.Size([3, 2]), torch.Size([6, 9]), torch.Size([6, 8]))
    """
    batch = broadcast_shape(waveform.shape[:-1], ears.shape[:-1])
    return batch, flatten_items(waveform, batch, dtype), flatten_items(ears, batch, dtype)


class DifferentiableFunction(torch.autograd.Function):
    """Base class of functions with a hand-written backward pass, whose ``forward`` has no context.

    torch's ``apply`` prepares for a backward pass even where gradients are disabled, which takes
    0.1 ms, as long as a Fourier transform of some thousand samples. Then ``call`` only calls
    ``forward``.

    >>> class Double(DifferentiableFunction):
    ...     @staticmethod
    ...     def forward(values):
    ...         return 2.0 * values
    >>> with torch.no_grad():
    ...     Double.call(torch.ones(2))
    tensor([2., 2.])
    """

    @classmethod
    def call(cls, *arguments: Any) -> Any:
        """Apply the function to its arguments, by ``forward`` alone where gradients are disabled.

        This method does not replace ``apply``, because torch.compile would fail in it.
        """
        if torch.is_grad_enabled():
            return cls.apply(*arguments)
        return cls.forward(*arguments)


def differentiable_once(gradient: Tensor, message: str) -> Tensor:
    """Return a gradient that raises an error if it is itself differentiated.

    Args:
        gradient: Result of a hand-written backward pass that is no exact derivative.
        message: Text of the RuntimeError.

    >>> differentiable_once(torch.ones(2), "no second derivative")
    tensor([1., 1.])
    """

    def reject(_: Tensor) -> None:
        raise RuntimeError(message)

    if gradient.requires_grad:
        gradient.register_hook(reject)
    return gradient


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """Compute the shape to which tensors with some shapes broadcast.

    ``torch.broadcast_shapes`` does the same, but its first call imports sympy, which takes a third
    of a second.

    Args:
        shapes: Shapes of the tensors.

    Raises:
        RuntimeError: The shapes do not broadcast.

    >>> broadcast_shape((3, 1), (2,))
    torch.Size([3, 2])
    """
    number = torch.empty(())
    return torch.broadcast_tensors(*(number.expand(shape) for shape in shapes))[0].shape


def silence_after(waveform: Tensor, ends: Tensor) -> Tensor:
    """Replace the samples after the end of each item by zeros.

    Shape: (..., time), (...) -> (..., time).

    Args:
        waveform: Padded signals.
        ends: Number of samples of each item before padding.

    >>> silence_after(torch.ones(2, 3), torch.tensor([1, 2]))
    tensor([[1., 0., 0.],
            [1., 1., 0.]])
    """
    samples = torch.arange(waveform.shape[-1], device=waveform.device)
    ends = ends.to(waveform.device, non_blocking=True)
    return torch.where(samples < ends.unsqueeze(-1), waveform, 0.0)


@compute_once
def _design_tensor(
    design: Callable[..., Any],
    arguments: tuple[Any, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:
    return as_tensor(design(*arguments), dtype, device)


# -- copies of thresholds on the CPU and on a GPU --------------------------------------------------

_COPIES = WeakTensorKeyDictionary()
"""Copies by original and device, each with the version number of the original when it was copied.

Copying a tensor to a GPU, or back, synchronises with the GPU: the CPU waits until the GPU has
finished all queued operations. Therefore each copy is made once, and remembered in both directions
as long as the original exists and nobody writes into it.
"""


def on_device(values: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device, without synchronising if it is on the CPU and has no gradient.

    The original is remembered, so that ``on_host`` need not synchronise either.

    Args:
        values: Tensor of any shape.
        device: Device of the result.

    >>> on_device(torch.zeros(8), torch.device("cpu")).device
    device(type='cpu')
    """
    if values.device == device:
        return values
    if values.device != _HOST or values.requires_grad:
        return values.to(device)
    copy = _find_copy(values, device)
    if copy is None:
        copy = values.to(device, non_blocking=True)
        _add_copy(values, copy)
        _add_copy(copy, values)
    return copy


def on_host(values: Tensor) -> Tensor:
    """Return a tensor without a gradient on the CPU.

    This synchronises with a GPU unless a copy of the values on the CPU is remembered. The result
    must not be changed in place: it may be this copy, or share the memory of ``values``.

    Args:
        values: Tensor of any shape on any device.

    >>> on_host(torch.zeros(8)).device
    device(type='cpu')
    """
    copy = known_on_host(values)
    if copy is None:
        copy = values.detach().cpu()
        _add_copy(values, copy)
    return copy


def known_on_host(values: Tensor) -> Tensor | None:
    """Return a tensor without a gradient on the CPU if that needs no waiting for a GPU, else None.

    No waiting is needed if the tensor is on the CPU, or if ``on_device`` or ``on_host`` copied it
    and it has not changed since.

    Args:
        values: Tensor of any shape on any device.

    >>> known_on_host(torch.zeros(2))
    tensor([0., 0.])
    """
    return values.detach() if values.device == _HOST else _find_copy(values, _HOST)


def _find_copy(tensor: Tensor, device: torch.device) -> Tensor | None:
    """Return the copy of a tensor on a device; None if there is none or the tensor has changed."""
    if not _can_be_remembered(tensor):
        return None
    version, copy = _COPIES.get(tensor, {}).get(device, (None, None))
    return copy if version == tensor._version else None


def _add_copy(tensor: Tensor, copy: Tensor) -> None:
    """Remember a copy of a tensor on another device, unless later changes cannot be detected."""
    if _can_be_remembered(tensor):
        _COPIES.setdefault(tensor, {})[copy.device] = tensor._version, copy


def _can_be_remembered(tensor: Tensor) -> bool:
    # a compiled program must not hold values, and inference tensors do not count their changes
    return not (torch.compiler.is_compiling() or tensor.is_inference())
