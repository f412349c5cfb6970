"""A pretended device, which finds on a CPU what would fail or wait on a GPU.

Its tensors report the device ``pretend:0`` and keep their values on the CPU. An operation that
mixes them with tensors of the CPU raises an error, as it would on a GPU. Operations that make the
host wait for the device (``.item()``, ``bool(tensor)``, ``.tolist()``, ``nonzero``, ``.cpu()``,
boolean indices, a blocking copy to the device) are counted by the line of hlsim that runs them::

    with PretendDevice() as device:
        output = module.to(DEVICE)(torch.randn(3, device=DEVICE))
    print(device.waits)

Torch's backend for Python (``_setup_privateuseone_for_python_backend``, experimental) makes this
possible without a compiler.
"""

from __future__ import annotations

import traceback
from collections import Counter
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import (
    _DummyBackendModule,
    _setup_privateuseone_for_python_backend,
)

WAITING = {
    "_local_scalar_dense",
    "item",
    "equal",
    "is_nonzero",
    "nonzero",
    "_unique2",
    "masked_select",
}
"""Operations whose result, or its shape, the host reads."""

TAKES_BOTH_DEVICES = {"copy_", "index", "index_put_", "_index_put_impl_"}
"""Operations that accept tensors of the CPU beside those of a device."""

EAGER = {
    torch.ops.aten._conj.default: torch.ops.aten.conj_physical.default,
    torch.ops.aten._neg_view.default: torch.ops.aten.neg.default,
}
"""Operations in place of those that torch puts off, which a wrapped tensor cannot represent."""

PACKAGES = ("hlsim", "compensators")

waits: Counter[str] = Counter()


class _Backend(_DummyBackendModule):
    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16, torch.float32]


_setup_privateuseone_for_python_backend("pretend", backend_module=_Backend())
DEVICE = torch.device("pretend", 0)


class PretendTensor(Tensor):
    """A tensor on the pretended device. Its values are those of ``inner``, a tensor on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor, requires_grad: bool = False) -> PretendTensor:
        tensor = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=DEVICE,
            requires_grad=requires_grad,
        )
        tensor.inner = inner
        return tensor

    def __init__(self, inner: Tensor, requires_grad: bool = False) -> None:
        pass

    def tolist(self) -> Any:
        count_wait("tolist")
        return self.inner.tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("can't convert a tensor on the device to numpy; use .cpu() first")

    def __repr__(self, **options: Any) -> str:
        return f"PretendTensor({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


class PretendDevice(TorchDispatchMode):
    """A context in which tensors can be made on, and moved to, the pretended device."""

    def __enter__(self) -> Self:
        waits.clear()
        return super().__enter__()

    @property
    def waits(self) -> Counter[str]:
        """Number of waits of the host by line of hlsim, since the context was entered."""
        return waits

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(func, args, kwargs or {})


def inner(value: Any) -> Any:
    return value.inner if isinstance(value, PretendTensor) else value


def to_pretend(value: Any) -> Any:
    plain = isinstance(value, Tensor) and not isinstance(value, PretendTensor)
    return PretendTensor(value) if plain else value


def current_line() -> str:
    """The innermost line of hlsim that is being executed."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if "site-packages" not in path.parts and set(PACKAGES) & set(path.parts):
            return f"{path.parent.name}/{path.name}:{frame.lineno} {frame.line}"
    return "outside of hlsim"


def count_wait(reason: str) -> None:
    if any(frame.name == "get_or_compute" for frame in traceback.extract_stack()):
        return  # under a dispatch mode hlsim computes its constants anew, without one it keeps them
    waits[f"{reason} @ {current_line()}"] += 1


def run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run an operation on the CPU, and apply the rules of a device to it."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    on_device = [tensor for tensor in tensors if isinstance(tensor, PretendTensor)]
    on_cpu = [tensor for tensor in tensors if not isinstance(tensor, PretendTensor)]
    name = func.overloadpacket.__name__
    if on_device:
        _refuse_mixed_devices(name, on_cpu)
        _count_waits(name, tensors)
    if name == "copy_":
        return _copy(func, args, kwargs, bool(on_device))
    func = EAGER.get(func, func)
    target = kwargs.get("device")
    cpu_kwargs = tree_map(inner, kwargs)
    if target is not None:
        cpu_kwargs["device"] = "cpu"
    if name in LSTM_CELL:
        return tree_map(to_pretend, LSTM_CELL[name](*tree_map(inner, args)))
    output = func(*tree_map(inner, args), **cpu_kwargs)
    if target is not None:
        if torch.device(target).type != DEVICE.type:
            if on_device:
                count_wait("copy to the host")
            return output
        if on_cpu and not kwargs.get("non_blocking") and any(tensor.ndim for tensor in on_cpu):
            count_wait("blocking copy to the device")
    elif not on_device:
        return output
    wrapped = tree_map(to_pretend, output)
    try:
        return return_and_correct_aliasing(func, args, kwargs, wrapped)
    except Exception:  # it does not know the aliases of a move between devices
        return wrapped


def _refuse_mixed_devices(name: str, on_cpu: list[Tensor]) -> None:
    if name in TAKES_BOTH_DEVICES or all(tensor.ndim == 0 for tensor in on_cpu):
        return
    shapes = [tuple(tensor.shape) for tensor in on_cpu]
    raise RuntimeError(
        f"expected all tensors to be on the same device, got tensors of the CPU with shapes "
        f"{shapes}: {name} @ {current_line()}"
    )


def _count_waits(name: str, tensors: list[Tensor]) -> None:
    if name in WAITING:
        count_wait(name)
    indices = tensors[1:] if name in ("index", "index_put_", "_index_put_impl_") else []
    if any(index.dtype == torch.bool for index in indices):
        count_wait("boolean index")
    if any(index.ndim and not isinstance(index, PretendTensor) for index in indices):
        count_wait("index on the CPU")


def _copy(func: Any, args: Any, kwargs: dict[str, Any], on_device: bool) -> Any:
    target, source, *options = args
    waits_for_it = not (options and options[0]) and not kwargs.get("non_blocking")
    if on_device and not isinstance(target, PretendTensor):
        count_wait("copy to the host")
    elif on_device and not isinstance(source, PretendTensor) and source.ndim and waits_for_it:
        count_wait("blocking copy to the device")
    elif target.ndim == source.ndim == 0:
        count_wait("assignment of a number to one element, which a GPU copies from the host")
    func(*tree_map(inner, args), **tree_map(inner, kwargs))
    return target


def _lstm_cell(
    input_gates: Tensor, hidden_gates: Tensor, cell: Tensor, *biases: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """New hidden state, new cell state and gates."""
    gates = input_gates + hidden_gates
    for bias in biases:
        if bias is not None:
            gates = gates + bias
    into, forget, candidate, out = gates.chunk(4, -1)
    into, forget, candidate, out = into.sigmoid(), forget.sigmoid(), candidate.tanh(), out.sigmoid()
    new_cell = forget * cell + into * candidate
    return out * new_cell.tanh(), new_cell, torch.cat((into, forget, candidate, out), -1)


def _lstm_cell_backward(
    hidden_gradient: Tensor | None,
    cell_gradient: Tensor | None,
    cell: Tensor,
    new_cell: Tensor,
    gates: Tensor,
    has_bias: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Gradients of the gates' inputs, of the cell state and of the biases."""
    into, forget, candidate, out = gates.chunk(4, -1)
    bounded = new_cell.tanh()
    total = torch.zeros_like(new_cell) if cell_gradient is None else cell_gradient
    slope = torch.zeros_like(new_cell) if hidden_gradient is None else hidden_gradient
    total = total + slope * out * (1.0 - bounded.square())
    gradients = torch.cat(
        (
            total * candidate * into * (1.0 - into),
            total * cell * forget * (1.0 - forget),
            total * into * (1.0 - candidate.square()),
            slope * bounded * out * (1.0 - out),
        ),
        -1,
    )
    return gradients, total * forget, gradients.sum(0) if has_bias else None


LSTM_CELL = {
    "_thnn_fused_lstm_cell": _lstm_cell,
    "_thnn_fused_lstm_cell_backward_impl": _lstm_cell_backward,
}
"""Kernels that GPUs alone have."""


# -- what torch calls below the dispatch mode ------------------------------------------------------


def _empty_strided(size: Any, stride: Any, dtype: Any = None, **options: Any) -> Tensor:
    return PretendTensor(torch.empty_strided(size, stride, dtype=dtype, device="cpu"))


def _empty(size: Any, dtype: Any = None, **options: Any) -> Tensor:
    return PretendTensor(torch.empty(size, dtype=dtype, device="cpu"))


def _copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
    if isinstance(source, PretendTensor) and not isinstance(target, PretendTensor):
        count_wait("copy to the host")
    elif not isinstance(source, PretendTensor) and source.ndim and not non_blocking:
        count_wait("blocking copy to the device")
    inner(target).copy_(inner(source))
    return target


_LIBRARY = torch.library.Library("aten", "IMPL")
_LIBRARY.impl("empty_strided", _empty_strided, "PrivateUse1")
_LIBRARY.impl("empty.memory_format", _empty, "PrivateUse1")
_LIBRARY.impl("_copy_from", _copy_from, "PrivateUse1")
